//! Barycentric interpolation against linear fields, convergence rates and point location.

use palpate::error::MeshError;
use palpate::field::interpolation::{Interpolated, interpolate_tetrahedra, interpolate_triangles};
use palpate::mesh::delaunay2::delaunay2;
use palpate::mesh::delaunay3::delaunay3;
use palpate::mesh::locate::TetrahedronLocator;
use palpate::types::{Affine, Grid, VoxelPoint, WorldPoint};

/// Uniform numbers in [0, 1) from SplitMix64.
fn chance(state: &mut u64) -> f64 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut h = *state;
    h = (h ^ (h >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    h = (h ^ (h >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((h ^ (h >> 31)) >> 11) as f64 / (1u64 << 53) as f64
}

/// Axis-aligned, flipped and anisotropic, oblique.
fn affines() -> [Affine; 3] {
    [
        Affine::scaled([1.0; 3], [0.0; 3]).unwrap(),
        Affine::scaled([-1.5, 1.5, 6.0], [120.0, -90.0, 7.7]).unwrap(),
        Affine::new([[0.36, 0.96, -0.8, -80.1], [-0.8, 1.2, 0.0, 33.3], [0.48, 1.28, 0.6, 512.7]]).unwrap(),
    ]
}

/// Voxel positions in world mm.
fn world(grid: &Grid, voxels: &[[f64; 3]]) -> Vec<WorldPoint> {
    voxels.iter().map(|&v| grid.affine().to_world(VoxelPoint(v))).collect()
}

fn linear(p: WorldPoint) -> [f64; 3] {
    let [x, y, z] = p.0;
    [0.02 * x - 0.01 * y + 3.0, 0.03 * z - 1.0, 0.01 * x + 0.015 * y - 0.02 * z]
}

/// The field at the inside voxels is `truth` to f32 rounding; gives their number.
fn assert_field(grid: &Grid, result: &Interpolated, truth: impl Fn(WorldPoint) -> [f64; 3], tolerance: f64) -> usize {
    let s = grid.shape();
    for n in 0..grid.len() {
        let (i, j, k) = (n % s[0], n / s[0] % s[1], n / (s[0] * s[1]));
        let (value, u) = (result.displacement.at(n), truth(grid.world(i, j, k)));
        let inside = result.inside.as_slice()[n] == 1;
        for c in 0..3 {
            let expected = if inside { u[c] } else { 0.0 };
            assert!((f64::from(value[c]) - expected).abs() <= tolerance, "{value:?} at {i} {j} {k}, not {u:?}");
        }
    }
    result.inside.as_slice().iter().map(|&v| usize::from(v)).sum()
}

/// Nodes at scattered places, on all grids; the mask is the hull.
#[test]
fn linear_fields_come_back() {
    for (seed, affine) in affines().into_iter().enumerate() {
        let grid = Grid::new([23, 19, 21], affine).unwrap();
        let mut state = seed as u64;
        let voxels: Vec<[f64; 3]> =
            (0..400).map(|_| [23.0, 19.0, 21.0].map(|s| (s + 4.0) * chance(&mut state) - 2.0)).collect();
        let d = delaunay3(&world(&grid, &voxels)).unwrap();
        let u: Vec<[f64; 3]> = d.mesh.nodes().iter().map(|&p| linear(p)).collect();
        let result = interpolate_tetrahedra(&d.mesh, &u, &grid).unwrap();
        let count = assert_field(&grid, &result, linear, 2e-6);
        assert!(count > grid.len() / 2 && count < grid.len());
        let locator = TetrahedronLocator::new(&d);
        for k in 0..21 {
            for j in 0..19 {
                for i in 0..23 {
                    let holds = locator.locate(grid.world(i, j, k), 0).is_some();
                    assert_eq!(result.inside.array()[[i, j, k]] == 1, holds, "{i} {j} {k}");
                }
            }
        }
    }
}

/// Nodes at voxel centres, so that voxels lie on corners, edges, facets and in slivers made by
/// rounding.
#[test]
fn lattice_nodes_leave_no_gap() {
    for affine in affines() {
        for step in [1, 2, 4] {
            let grid = Grid::new([13, 13, 13], affine).unwrap();
            let voxels: Vec<[f64; 3]> = (0..13 * 13 * 13)
                .map(|n| [n % 13, n / 13 % 13, n / 169])
                .filter(|v| v.iter().all(|c| c % step == 0))
                .map(|v| v.map(|c| c as f64))
                .collect();
            let d = delaunay3(&world(&grid, &voxels)).unwrap();
            let u: Vec<[f64; 3]> = d.mesh.nodes().iter().map(|&p| linear(p)).collect();
            let result = interpolate_tetrahedra(&d.mesh, &u, &grid).unwrap();
            assert_eq!(assert_field(&grid, &result, linear, 4e-6), grid.len());
        }
    }
}

/// At a node its own value comes back, and nothing leaves the range of the values.
#[test]
fn nodes_keep_their_values() {
    let grid = Grid::new([16, 16, 16], affines()[2]).unwrap();
    let voxels: Vec<[f64; 3]> = (0..512).map(|n| [n % 8 * 2, n / 8 % 8 * 2, n / 64 * 2].map(f64::from)).collect();
    let d = delaunay3(&world(&grid, &voxels)).unwrap();
    let mut state = 9;
    let u: Vec<[f64; 3]> = voxels.iter().map(|_| [0; 3].map(|_| chance(&mut state))).collect();
    let result = interpolate_tetrahedra(&d.mesh, &u, &grid).unwrap();
    for (v, u) in voxels.iter().zip(&u) {
        let [i, j, k] = v.map(|c| c as usize);
        for c in 0..3 {
            assert!((f64::from(result.displacement.array()[[i, j, k, c]]) - u[c]).abs() < 1e-6);
        }
    }
    assert!(result.displacement.as_slice().iter().all(|v| (0.0..=1.0).contains(v)));
}

/// The error of a quadratic field falls with the square of the node distance.
#[test]
fn quadratic_fields_converge() {
    let grid = Grid::new([33, 33, 33], Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap();
    let field = |p: WorldPoint| {
        let [x, y, z] = p.0.map(|v| v / 32.0);
        [x * x + y * z, y * y - x * z, z * z + x * y]
    };
    let error = |cells: i32| {
        let mut state = 4;
        let h = 32.0 / f64::from(cells);
        let voxels: Vec<[f64; 3]> = (0..(cells + 1).pow(3))
            .map(|n| [n % (cells + 1), n / (cells + 1) % (cells + 1), n / (cells + 1).pow(2)])
            // Inner nodes moved at random by up to a fifth of the distance.
            .map(|v| v.map(|c| h * (f64::from(c) + if c % cells == 0 { 0.0 } else { 0.4 * chance(&mut state) - 0.2 })))
            .collect();
        let d = delaunay3(&world(&grid, &voxels)).unwrap();
        let u: Vec<[f64; 3]> = d.mesh.nodes().iter().map(|&p| field(p)).collect();
        let result = interpolate_tetrahedra(&d.mesh, &u, &grid).unwrap();
        let mut sum = 0.0;
        for n in 0..grid.len() {
            assert_eq!(result.inside.as_slice()[n], 1);
            let (value, u) = (result.displacement.at(n), field(grid.world(n % 33, n / 33 % 33, n / 1089)));
            sum += (0..3).map(|c| (f64::from(value[c]) - u[c]).powi(2)).sum::<f64>();
        }
        (sum / grid.len() as f64).sqrt()
    };
    let errors = [2, 4, 8].map(error);
    for pair in errors.windows(2) {
        let rate = (pair[0] / pair[1]).log2();
        assert!((1.7..2.4).contains(&rate), "rate {rate} from {errors:?}");
    }
}

#[test]
fn threads_change_nothing() {
    let grid = Grid::new([40, 30, 50], affines()[2]).unwrap();
    let mut state = 1;
    let voxels: Vec<[f64; 3]> = (0..3000).map(|_| [40.0, 30.0, 50.0].map(|s| s * chance(&mut state))).collect();
    let d = delaunay3(&world(&grid, &voxels)).unwrap();
    let u: Vec<[f64; 3]> = d.mesh.nodes().iter().map(|_| [0; 3].map(|_| chance(&mut state))).collect();
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| interpolate_tetrahedra(&d.mesh, &u, &grid).unwrap())
    };
    assert_eq!(run(1), run(5));
}

/// One slice along any axis, on any affine.
#[test]
fn triangles_fill_a_slice() {
    for affine in affines() {
        for axis in 0..3 {
            let mut shape = [24, 18, 30];
            shape[axis] = 1;
            let grid = Grid::new(shape, affine).unwrap();
            let mut state = 3;
            let mut scattered: Vec<[f64; 3]> =
                (0..200).map(|_| shape.map(|s| (s - 1) as f64).map(|s| s * chance(&mut state))).collect();
            // The corners, so that the hull is the slice.
            for c in 0..8 {
                scattered.push([0, 1, 2].map(|a| if c >> a & 1 == 1 { (shape[a] - 1) as f64 } else { 0.0 }));
            }
            let d = delaunay2(&world(&grid, &scattered)).unwrap();
            let u: Vec<[f64; 3]> = d.mesh.nodes().iter().map(|&p| linear(p)).collect();
            let result = interpolate_triangles(&d.mesh, &u, &grid).unwrap();
            assert_eq!(assert_field(&grid, &result, linear, 4e-6), grid.len());
            // Half of the triangles fill a part, and leave the rest at zero.
            let half = d.mesh.triangles()[..d.mesh.triangles().len() / 2].to_vec();
            let part = palpate::types::TriMesh::new(d.mesh.nodes().to_vec(), half).unwrap();
            let count = assert_field(&grid, &interpolate_triangles(&part, &u, &grid).unwrap(), linear, 4e-6);
            assert!(count > 0 && count < grid.len());
        }
    }
}

#[test]
fn wrong_input_is_refused() {
    let grid = Grid::new([4, 4, 4], affines()[0]).unwrap();
    let nodes = world(&grid, &[[0.0; 3], [3.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 3.0]]);
    let d = delaunay3(&nodes).unwrap();
    let error = interpolate_tetrahedra(&d.mesh, &[[0.0; 3]; 3], &grid).unwrap_err();
    assert_eq!(error, MeshError::Length { expected: 4, found: 3 });
    let t = delaunay2(&nodes[..3]).unwrap();
    let error = interpolate_triangles(&t.mesh, &[[0.0; 3]; 3], &grid).unwrap_err();
    assert_eq!(error, MeshError::NotOneSlice { shape: [4, 4, 4] });
    // Far outside of the grid, on both sides: nothing is filled.
    for shift in [-1e6, 1e6, 1e18] {
        let far: Vec<WorldPoint> = nodes.iter().map(|p| p.moved([shift, 0.0, 0.0])).collect();
        let mesh = palpate::types::TetMesh::new(far, d.mesh.tetrahedra().to_vec()).unwrap();
        let result = interpolate_tetrahedra(&mesh, &[[1.0; 3]; 4], &grid).unwrap();
        assert!(result.inside.as_slice().iter().all(|&v| v == 0));
    }
}
