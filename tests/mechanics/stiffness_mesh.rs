//! The mesh of a label map: volumes, conformity, shapes, grading.

use palpate::mesh::quality::{quality, volume};
use palpate::mesh::tetrahedral::{Detail, Fineness, Mesher, curving, mesh_labels, pieces};
use palpate::types::{Affine, Grid, Mask, QuadraticMesh, WorldPoint};
use std::collections::HashMap;

fn labels(shape: [usize; 3], spacing: f64, f: impl Fn([f64; 3]) -> u8 + Sync) -> Mask {
    let grid = Grid::new(shape, Affine::scaled([spacing; 3], [0.0; 3]).unwrap()).unwrap();
    Mask::from_voxels(grid, |_, p| f(p.0))
}

/// Volume of each region's curved elements.
fn volumes(mesh: &QuadraticMesh) -> HashMap<u8, f64> {
    let mut out = HashMap::new();
    for (t, &label) in mesh.tetrahedra().iter().zip(mesh.labels()) {
        let p = t.map(|n| mesh.nodes()[n as usize].0);
        *out.entry(label).or_insert(0.0) += curving::volume(p);
    }
    out
}

fn report(name: &str, mesh: &QuadraticMesh) -> f64 {
    let mut faces: HashMap<[u32; 3], u32> = HashMap::new();
    let mut least = f64::INFINITY;
    let mut determinant = f64::INFINITY;
    let mut angles = Vec::new();
    for t in mesh.tetrahedra() {
        let p = t.map(|n| mesh.nodes()[n as usize]);
        let corners: [WorldPoint; 4] = [p[0], p[1], p[2], p[3]];
        assert!(volume(corners) > 0.0);
        angles.push(quality(corners).min_dihedral_angle.to_degrees());
        least = least.min(quality(corners).min_dihedral_angle.to_degrees());
        determinant = determinant.min(curving::least_determinant(p.map(|q| q.0)));
        for i in 0..4 {
            let mut f = [t[(i + 1) % 4], t[(i + 2) % 4], t[(i + 3) % 4]];
            f.sort_unstable();
            *faces.entry(f).or_default() += 1;
        }
    }
    assert!(faces.values().all(|&n| n <= 2));
    angles.sort_by(f64::total_cmp);
    println!(
        "{name}: {} nodes, {} elements, least dihedral angle {least:.1} (hundredth {:.1}) degrees, least determinant {determinant:.2}",
        mesh.nodes().len(),
        mesh.tetrahedra().len(),
        angles[angles.len() / 100]
    );
    assert!(determinant > 0.1);
    least
}

#[test]
fn a_ball_in_a_block_keeps_its_volume() {
    let r = 7.0;
    let c = [24.2, 23.7, 16.1];
    let map = labels([96, 96, 64], 0.5, |p| {
        let inside = (2.0..46.0).contains(&p[0]) && (2.0..46.0).contains(&p[1]) && (2.0..30.0).contains(&p[2]);
        let d: f64 = (0..3).map(|a| (p[a] - c[a]).powi(2)).sum();
        if !inside {
            0
        } else if d < r * r {
            2
        } else {
            1
        }
    });
    let count = map.as_slice().iter().filter(|&&v| v == 2).count() as f64 * 0.125;
    for (nodes, tolerance) in [(6000, 0.03), (20_000, 0.005)] {
        let mesh = mesh_labels(&map, &Fineness::for_nodes(44.0 * 44.0 * 28.0, nodes)).unwrap();
        let least = report("ball in block", &mesh);
        let v = volumes(&mesh);
        let exact = 4.0 / 3.0 * std::f64::consts::PI * r * r * r;
        println!("ball {:.1} of {exact:.1} (voxels {count:.1}), all {:.0} of {}", v[&2], v[&1] + v[&2], 44 * 44 * 28);
        assert!(least > 5.0);
        assert!((v[&2] / exact - 1.0).abs() < tolerance);
        assert!(((v[&1] + v[&2]) / (44.0 * 44.0 * 28.0) - 1.0).abs() < 0.003);
    }
}

#[test]
fn layers_are_cut_where_they_meet() {
    let map = labels([64, 64, 48], 0.5, |p| {
        let inside = (2.0..28.0).contains(&p[0]) && (2.0..28.0).contains(&p[1]) && (2.0..20.0).contains(&p[2]);
        if !inside {
            0
        } else if p[2] > 18.2 {
            3
        } else if p[2] > 14.2 {
            2
        } else {
            1
        }
    });
    let mesh = mesh_labels(&map, &Fineness::for_nodes(26.0 * 26.0 * 18.0, 8000)).unwrap();
    let least = report("layers", &mesh);
    let v = volumes(&mesh);
    println!("{v:?}");
    for (label, count) in [
        (1, map.as_slice().iter().filter(|&&v| v == 1).count()),
        (2, map.as_slice().iter().filter(|&&v| v == 2).count()),
        (3, map.as_slice().iter().filter(|&&v| v == 3).count()),
    ] {
        let exact = count as f64 * 0.125;
        assert!((v[&label] / exact - 1.0).abs() < 0.02, "{label}: {} of {exact}", v[&label]);
    }
    assert!(least > 3.0);
}

/// Cubes of 8 mm do not show a ball of 1.6. With all of them smaller, until it showed, the mesh had
/// 7,334 nodes.
#[test]
fn a_small_part_is_meshed_finer_alone() {
    let map = labels([64, 64, 48], 0.5, |p| {
        let inside = (2.0..28.0).contains(&p[0]) && (2.0..28.0).contains(&p[1]) && (2.0..20.0).contains(&p[2]);
        let d: f64 = [14.6, 15.3, 11.2].iter().zip(p).map(|(c, p)| (p - c).powi(2)).sum();
        if inside { 1 + u8::from(d < 0.64) } else { 0 }
    });
    // Too few nodes are allowed for the ball to be divided by its thickness.
    let fineness = Fineness { nodes: 300, ..Fineness::for_nodes(26.0 * 26.0 * 18.0, 500) };
    let mesh = mesh_labels(&map, &fineness).unwrap();
    assert!(report("small ball", &mesh) > 5.0);
    let exact = 4.0 / 3.0 * std::f64::consts::PI * 0.8f64.powi(3);
    assert!(volumes(&mesh)[&2] > 0.4 * exact && mesh.nodes().len() < 5000, "{} nodes", mesh.nodes().len());
}

/// More than a few parts may be too small at once; halved one after the other, not all had their
/// turn.
#[test]
fn many_small_parts_are_all_kept() {
    let ball = |p: [f64; 3]| {
        let (i, j) = (((p[0] - 2.0) / 6.5).floor(), ((p[1] - 2.0) / 6.5).floor());
        let d = (p[0] - 5.2 - 6.5 * i).powi(2) + (p[1] - 5.3 - 6.5 * j).powi(2) + (p[2] - 11.2).powi(2);
        if d < 0.64 { 2 + (4.0 * j + i) as u8 } else { 1 }
    };
    let map = labels([64, 64, 48], 0.5, |p| {
        let inside = (2.0..28.0).contains(&p[0]) && (2.0..28.0).contains(&p[1]) && (2.0..20.0).contains(&p[2]);
        if inside { ball(p) } else { 0 }
    });
    let fineness = Fineness { nodes: 300, ..Fineness::for_nodes(26.0 * 26.0 * 18.0, 500) };
    let mesh = mesh_labels(&map, &fineness).unwrap();
    report("sixteen small balls", &mesh);
    assert_eq!(volumes(&mesh).len(), 17);
}

/// The edge of a punch lies within a side of a body, and no element may lie on both sides of it.
#[test]
fn a_wall_is_made_of_faces() {
    let map = labels([64, 64, 48], 0.5, |p| {
        let inside = (2.0..28.0).contains(&p[0]) && (2.0..28.0).contains(&p[1]) && (2.0..20.0).contains(&p[2]);
        if inside { 1 + u8::from(p[2] > 16.2) } else { 0 }
    });
    let round = |p: [f64; 3]| 6.3 - (p[0] - 15.1).hypot(p[1] - 14.4);
    let square = |p: [f64; 3]| (6.1 - (p[0] - 15.1).abs()).min(5.2 - (p[1] - 14.4).abs());
    let walls: [(&str, f64, &(dyn Fn([f64; 3]) -> f64 + Sync)); 2] =
        [("round", std::f64::consts::PI * 6.3 * 6.3, &round), ("square", 12.2 * 10.4, &square)];
    for (name, exact, wall) in walls {
        let near: Vec<[f64; 3]> = (0..64 * 64)
            .map(|c| [0.5 * f64::from(c % 64), 0.5 * f64::from(c / 64), 19.5])
            .filter(|p| wall(*p).abs() < 0.5)
            .collect();
        let fineness = Fineness::for_nodes(26.0 * 26.0 * 18.0, 4000);
        let mesh = Mesher::new(&map)
            .unwrap()
            .mesh_finer(&fineness, Detail { near: &near, size: 1.0, wall: Some(wall) })
            .unwrap();
        assert!(report(name, &mesh) > 2.0);
        let v = volumes(&mesh);
        for label in [1, 2] {
            let voxels = map.as_slice().iter().filter(|&&v| v == label).count() as f64 * 0.125;
            assert!((v[&label] / voxels - 1.0).abs() < 0.02, "{label}: {} of {voxels}", v[&label]);
        }
        let mut top = 0.0;
        for t in mesh.tetrahedra() {
            let corners = [0, 1, 2, 3].map(|i| mesh.nodes()[t[i] as usize].0);
            let levels = corners.map(wall);
            let (low, high) = levels.iter().fold((0.0f64, 0.0f64), |(a, b), l| (a.min(*l), b.max(*l)));
            // Corners of a square are cut off by an element's chord.
            let off = if name == "round" { 0.15 } else { 0.45 };
            assert!(low > -off || high < off || corners.iter().any(|p| p[2] < 17.5), "{name}: {levels:?}");
            for i in 0..4 {
                let f = [0, 1, 2].map(|k| corners[(i + 1 + k) % 4]);
                let middle = [0, 1, 2].map(|a| (f[0][a] + f[1][a] + f[2][a]) / 3.0);
                if f.iter().all(|p| p[2] > 19.5) && wall(middle) > 0.0 {
                    let [u, v] = [1, 2].map(|k| [0, 1].map(|a| f[k][a] - f[0][a]));
                    top += 0.5 * (u[0] * v[1] - u[1] * v[0]).abs();
                }
            }
        }
        assert!((top / exact - 1.0).abs() < 0.02, "{name}: {top} of {exact}");
    }
}

#[test]
fn a_ball_is_round() {
    let map = labels([50, 50, 50], 0.5, |p| {
        let d: f64 = (0..3).map(|a| (p[a] - 12.3).powi(2)).sum();
        u8::from(d < 100.0)
    });
    let exact = 4.0 / 3.0 * std::f64::consts::PI * 1000.0;
    let mesh = mesh_labels(&map, &Fineness::for_nodes(exact, 6000)).unwrap();
    let least = report("ball", &mesh);
    let v = volumes(&mesh);
    println!("ball {:.1} of {exact:.1}", v[&1]);
    assert!((v[&1] / exact - 1.0).abs() < 0.005);
    assert!(least > 8.0);
    let far =
        mesh.nodes().iter().map(|p| p.0.iter().map(|v| (v - 12.3).powi(2)).sum::<f64>().sqrt()).fold(0.0, f64::max);
    assert!((far - 10.0).abs() < 0.25, "{far}");
    assert_eq!(pieces(&map).len(), 1);
}
