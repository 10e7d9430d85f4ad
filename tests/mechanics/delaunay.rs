//! The Delaunay meshes against exact predicates, brute force and closed forms.

use palpate::error::MeshError;
use palpate::field::interpolation::interpolate_tetrahedra;
use palpate::mesh::delaunay2::delaunay2;
use palpate::mesh::delaunay3::delaunay3;
use palpate::mesh::locate::{TetrahedronLocator, TriangleLocator};
use palpate::mesh::plane::Plane;
use palpate::mesh::predicates::{insphere, orient3d};
use palpate::mesh::quality::{hull_volume, qualities, quality, total_volume};
use palpate::mesh::{Delaunay, NO_NEIGHBOUR};
use palpate::types::{Affine, Grid, TetMesh, TriMesh, WorldPoint};
use proptest::prelude::*;
use robust::{Coord, Coord3D};
use std::collections::{HashMap, HashSet};

type P = [f64; 3];

fn world(points: &[P]) -> Vec<WorldPoint> {
    points.iter().map(|&p| WorldPoint(p)).collect()
}

/// Uniform numbers in [0, 1) from SplitMix64.
struct Chance(u64);

impl Chance {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut h = self.0;
        h = (h ^ (h >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        h = (h ^ (h >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((h ^ (h >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    fn point(&mut self) -> P {
        [self.next(), self.next(), self.next()]
    }
}

/// The degenerate families; each is a way that image features may lie.
const FAMILIES: usize = 12;

fn family(kind: usize, n: usize, seed: u64) -> Vec<P> {
    let mut chance = Chance(seed);
    let mut points: Vec<P> = (0..n).map(|_| chance.point()).collect();
    let side = (n as f64).cbrt().ceil();
    match kind {
        0 => {}
        // A lattice, in random order.
        1 => {
            let s = side as usize;
            let mut keyed: Vec<(P, P)> =
                (0..s * s * s).map(|i| (chance.point(), [i % s, i / s % s, i / (s * s)].map(|v| v as f64))).collect();
            keyed.sort_by(|a, b| a.0.partial_cmp(&b.0).unwrap());
            points = keyed.into_iter().map(|(_, p)| p).collect();
        }
        // Rounded integers, with many repeats and coplanar points.
        2 => points.iter_mut().flatten().for_each(|v| *v = (*v * side).round()),
        // Five slices.
        3 => points.iter_mut().for_each(|p| p[2] = (p[2] * 5.0).floor() * 6.0),
        // On one sphere up to rounding.
        4 => points.iter_mut().for_each(|p| {
            let d = p.map(|v| v - 0.5);
            let r = d.iter().map(|v| v * v).sum::<f64>().sqrt();
            *p = d.map(|v| 80.0 * v / r);
        }),
        // Exactly on one sphere: integer points of norm 9, repeated, and the centre.
        5 => {
            let on: Vec<P> = (-9..=9)
                .flat_map(|x| (-9..=9).flat_map(move |y| (-9..=9).map(move |z| [x, y, z])))
                .filter(|p: &[i32; 3]| p.iter().map(|v| v * v).sum::<i32>() == 81)
                .map(|p| p.map(f64::from))
                .collect();
            points.iter_mut().for_each(|p| *p = on[(p[0] * on.len() as f64) as usize]);
            points.push([0.0; 3]);
        }
        // Each point about three times.
        6 => {
            let some = points[..n.div_ceil(3).max(6).min(n)].to_vec();
            points.iter_mut().skip(6).for_each(|p| *p = some[(p[0] * some.len() as f64) as usize]);
        }
        // Nearly coplanar.
        7 => points.iter_mut().for_each(|p| p[2] = 3.0 + p[0] - 2.0 * p[1] + 1e-13 * p[2]),
        // An oblique lattice: coplanar and cospherical up to rounding.
        8 => points.iter_mut().for_each(|p| {
            let [x, y, z] = p.map(|v| (v * side).round());
            *p = [0.36 * x + 0.48 * y - 0.8 * z, -0.8 * x + 0.6 * y, 0.48 * x + 0.64 * y + 0.6 * z - 7.3];
        }),
        // All sizes from 1 down to 1e-30.
        9 => points.iter_mut().for_each(|p| {
            let scale = 10f64.powf(-30.0 * p[0]);
            *p = [p[0] * scale, (p[1] - 0.5) * scale, (p[2] - 0.5) * scale];
        }),
        // A wide lattice of whole numbers, some points of it one off.
        10 => points.iter_mut().flatten().for_each(|v| {
            let cell = (*v * side).floor();
            let off = if (*v * side - cell) < 0.1 { 1.0 } else { 0.0 };
            *v = 4_000_037.0 * cell + off;
        }),
        // Two lines that cross in space: a quadratic number of tetrahedra.
        _ => points.iter_mut().enumerate().for_each(|(i, p)| {
            *p = if i % 2 == 0 { [p[0], 0.0, 0.0] } else { [0.5, p[1] - 0.5, 1.0] };
        }),
    }
    points
}

fn sign(v: f64) -> i32 {
    i32::from(v > 0.0) - i32::from(v < 0.0)
}

fn determinant(a: [i128; 3], b: [i128; 3], c: [i128; 3]) -> i128 {
    a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])
}

fn exact_orient(p: [P; 4]) -> f64 {
    let [a, b, c, d] = p.map(|q| Coord3D { x: q[0], y: q[1], z: q[2] });
    -robust::orient3d(a, b, c, d)
}

fn exact_insphere(p: [P; 4], e: P) -> f64 {
    let [a, b, c, d] = p.map(|q| Coord3D { x: q[0], y: q[1], z: q[2] });
    -robust::insphere(a, b, c, d, Coord3D { x: e[0], y: e[1], z: e[2] })
}

/// Everything that makes a Delaunay tetrahedralisation one, with Shewchuk's predicates alone.
/// `points` are the input up to a power of two.
fn check(points: &[P], d: &Delaunay<TetMesh, 4>) {
    let tetrahedra = d.mesh.tetrahedra();
    let nodes: Vec<P> = d.source.iter().map(|&i| points[i as usize]).collect();
    let corners = |t: &[u32; 4]| t.map(|v| nodes[v as usize]);

    // The maps between input and nodes.
    assert!(d.source.windows(2).all(|w| w[0] < w[1]));
    assert_eq!(d.node.len(), points.len());
    assert!(points.iter().zip(&d.node).all(|(p, &n)| *p == nodes[n as usize]));
    let distinct: HashSet<[u64; 3]> = points.iter().map(|p| p.map(|v| (v + 0.0).to_bits())).collect();
    assert_eq!(nodes.len(), distinct.len());

    // No tetrahedron is flat or inside out, none holds its neighbour's corner inside its sphere.
    let mut facets: HashMap<[u32; 3], usize> = HashMap::new();
    let mut edges: HashSet<[u32; 2]> = HashSet::new();
    let mut hull: Vec<([u32; 4], usize)> = Vec::new();
    for (e, (t, across)) in tetrahedra.iter().zip(&d.neighbours).enumerate() {
        assert!(exact_orient(corners(t)) > 0.0, "flat tetrahedron {t:?}");
        for i in 0..4 {
            let mut facet = [t[(i + 1) % 4], t[(i + 2) % 4], t[(i + 3) % 4]];
            facet.sort_unstable();
            *facets.entry(facet).or_default() += 1;
            edges.extend([[facet[0], facet[1]], [facet[0], facet[2]], [facet[1], facet[2]]]);
            if across[i] == NO_NEIGHBOUR {
                hull.push((*t, i));
                continue;
            }
            let other = across[i] as usize;
            let j = d.neighbours[other].iter().position(|&n| n as usize == e).unwrap();
            let far = tetrahedra[other][j];
            assert!(facet.iter().all(|v| tetrahedra[other].contains(v)) && !facet.contains(&far));
            assert!(exact_insphere(corners(t), nodes[far as usize]) <= 0.0, "not Delaunay");
        }
    }

    // A ball: every facet has two sides but those of the hull; Euler's formula; the hull is a
    // sphere.
    let open = facets.values().filter(|&&n| n == 1).count();
    assert_eq!(open, hull.len());
    assert!(facets.values().all(|&n| n <= 2));
    assert_eq!(nodes.len() as i64 - edges.len() as i64 + facets.len() as i64 - tetrahedra.len() as i64, 1);

    // Convex: across each edge of the hull, the next facet's corner is not outside.
    let mut at_edge: HashMap<[u32; 2], Vec<([u32; 4], usize, u32)>> = HashMap::new();
    for &(t, i) in &hull {
        let facet = [t[(i + 1) % 4], t[(i + 2) % 4], t[(i + 3) % 4]];
        for k in 0..3 {
            let mut edge = [facet[k], facet[(k + 1) % 3]];
            edge.sort_unstable();
            at_edge.entry(edge).or_default().push((t, i, facet[(k + 2) % 3]));
        }
    }
    for pair in at_edge.values() {
        assert_eq!(pair.len(), 2);
        for (this, next) in [(0, 1), (1, 0)] {
            let (t, i, _) = pair[this];
            let mut q = corners(&t);
            q[i] = nodes[pair[next].2 as usize];
            assert!(exact_orient(q) >= 0.0, "the hull is not convex");
        }
    }
}

/// That the volumes of all tetrahedra are the hull's, up to the rounding of both sums.
fn check_volume(d: &Delaunay<TetMesh, 4>) {
    let (sum, hull) = (total_volume(&d.mesh), hull_volume(d));
    let size = d.mesh.nodes().iter().flat_map(|p| p.0).fold(0.0, |size: f64, v| size.max(v.abs()));
    let rounding = 8.0 * f64::EPSILON * size.powi(3) * d.mesh.tetrahedra().len() as f64;
    assert!((sum - hull).abs() <= 1e-10 * hull + rounding, "{sum} is not {hull}");
}

/// Four points of an oblique lattice, in one plane up to rounding: exact by the predicates, though
/// a volume of 3e-16 has no digits.
#[test]
fn four_points_in_a_plane_but_for_rounding_are_exact() {
    let points = family(8, 4, 7_956_423_612_311_333_904);
    let d = delaunay3(&world(&points)).unwrap();
    check(&points, &d);
    check_volume(&d);
    assert!(total_volume(&d.mesh) < 1e-14);
}

fn linear_field_comes_back(kind: usize, n: usize, seed: u64) {
    let points = family(kind, n, seed);
    let Ok(d) = delaunay3(&world(&points)) else { return };
    let box_of =
        |f: fn(f64, f64) -> f64| points.iter().copied().reduce(|a, b| [0, 1, 2].map(|k| f(a[k], b[k]))).unwrap();
    let (low, high) = (box_of(f64::min), box_of(f64::max));
    let shape = [11, 10, 9];
    let spacing = [0, 1, 2].map(|k| (high[k] - low[k]) / (shape[k] as f64 - 1.7));
    let grid =
        Grid::new(shape, Affine::scaled(spacing, [0, 1, 2].map(|k| low[k] - 0.3 * spacing[k])).unwrap()).unwrap();
    let linear = |p: WorldPoint| {
        let [x, y, z] = [0, 1, 2].map(|k| (p.0[k] - low[k]) / (high[k] - low[k]));
        [x - 0.5 * y + 1.0, 0.3 * z - y, 0.1 * x + 0.7 * z]
    };
    let u: Vec<[f64; 3]> = d.mesh.nodes().iter().map(|&p| linear(p)).collect();
    let result = interpolate_tetrahedra(&d.mesh, &u, &grid).unwrap();
    let locator = TetrahedronLocator::new(&d);
    let mut inside = 0;
    for v in 0..grid.len() {
        let centre = grid.world(v % 11, v / 11 % 10, v / 110);
        if result.inside.as_slice()[v] == 0 {
            // All of the seventh family is as thin as rounding.
            assert!(kind == 7 || locator.locate(centre, 0).is_none(), "nothing at {centre:?}");
            continue;
        }
        inside += 1;
        let (found, truth) = (result.displacement.at(v), linear(centre));
        for c in 0..3 {
            assert!((f64::from(found[c]) - truth[c]).abs() < 1e-5, "{found:?} for {truth:?}");
        }
    }
    // In a slab of rounding's thickness no voxel need lie.
    assert!(inside > 0 || kind == 7 || kind == 9);
}

/// Elements far smaller than a voxel, some with a height of rounding, were once taken for stout by
/// their volume.
#[test]
fn small_elements_give_a_linear_field_too() {
    linear_field_comes_back(8, 241, 4_913_549_611_782_285_617);
    linear_field_comes_back(11, 233, 6_590_404_653_985_852_895);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 160, failure_persistence: None, ..ProptestConfig::default() })]

    /// Every family and size: an exact Delaunay tiling of the hull, or the error that says why not.
    #[test]
    fn exact_on_all_families(kind in 0..FAMILIES, n in 4usize..400, seed: u64) {
        let points = family(kind, n, seed);
        match delaunay3(&world(&points)) {
            Ok(d) => {
                check(&points, &d);
                if kind != 7 && kind != 9 {
                    check_volume(&d);
                }
            }
            // Only so few points may be flat by chance.
            Err(e) => prop_assert!(n < 60 && e != MeshError::NotFinite { node: 0 }, "{e}"),
        }
    }

    /// Any power of two, from the smallest numbers to the largest, gives the same mesh.
    #[test]
    fn scale_changes_nothing(kind in 0..9usize, n in 60usize..120, seed: u64, exponent in -960i32..960) {
        let points = family(kind, n, seed);
        let scale = 2f64.powi(exponent);
        let scaled: Vec<P> = points.iter().map(|p| p.map(|v| v * scale)).collect();
        let (a, b) = (delaunay3(&world(&points)), delaunay3(&world(&scaled)));
        prop_assert_eq!(a.map(|d| d.mesh.tetrahedra().to_vec()), b.map(|d| d.mesh.tetrahedra().to_vec()));
    }

    /// The sign of the orientation against integer arithmetic, on coordinates of 40 bits and any
    /// scale.
    #[test]
    fn orientation_against_integers(
        p in prop::array::uniform4(prop::array::uniform3(-2i64..=2)),
        off in prop::array::uniform4(prop::array::uniform3(0i64..=1)),
        factor in 1i64..1 << 37,
        exponent in -100i32..100,
    ) {
        let p = [0, 1, 2, 3].map(|i| [0, 1, 2].map(|k| p[i][k] * factor + off[i][k] * (factor % 2)));
        let f = p.map(|q| q.map(|v| v as f64 * 2f64.powi(exponent)));
        let row = |i: usize| [0, 1, 2].map(|k| i128::from(p[i][k] - p[0][k]));
        let expected = determinant(row(1), row(2), row(3)).signum() as i32;
        prop_assert_eq!(sign(orient3d(&f[0], &f[1], &f[2], &f[3])), expected);
    }

    /// The sign of the in-sphere test likewise, on 18 bits.
    #[test]
    fn insphere_against_integers(
        p in prop::array::uniform5(prop::array::uniform3(-2i64..=2)),
        shift in prop::array::uniform3(-200_000i64..200_000),
        factor in 1i64..30_000,
        exponent in -100i32..100,
    ) {
        let p = p.map(|q| [0, 1, 2].map(|k| q[k] * factor + shift[k]));
        let f = p.map(|q| q.map(|v| v as f64 * 2f64.powi(exponent)));
        let r = [0, 1, 2, 3].map(|i| [0, 1, 2].map(|k| i128::from(p[i][k] - p[4][k])));
        let lift = r.map(|v| v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
        let inside = lift[0] * determinant(r[1], r[2], r[3]) - lift[1] * determinant(r[0], r[2], r[3])
            + lift[2] * determinant(r[0], r[1], r[3]) - lift[3] * determinant(r[0], r[1], r[2]);
        prop_assert_eq!(sign(insphere(&f[0], &f[1], &f[2], &f[3], &f[4])), inside.signum() as i32);
    }

    /// In general position the tetrahedra are the four points whose sphere is empty, all of them
    /// and no others.
    #[test]
    fn brute_force_agrees(n in 4usize..14, seed: u64) {
        let points = family(0, n, seed);
        let d = delaunay3(&world(&points)).unwrap();
        let mut found: Vec<[u32; 4]> = d.mesh.tetrahedra().to_vec();
        found.iter_mut().for_each(|t| t.sort_unstable());
        found.sort_unstable();
        let mut expected = Vec::new();
        for a in 0..n { for b in a + 1..n { for c in b + 1..n { for e in c + 1..n {
            let q = [a, b, c, e].map(|i| points[i]);
            let turn = exact_orient(q).signum();
            if (0..n).filter(|i| ![a, b, c, e].contains(i)).all(|i| turn * exact_insphere(q, points[i]) < 0.0) {
                expected.push([a, b, c, e].map(|i| i as u32));
            }
        }}}}
        prop_assert_eq!(found, expected);
    }

    /// Location against all elements: inside the hull the weights give the point back, outside
    /// there is none.
    #[test]
    fn located_like_brute_force(kind in 0..4usize, seed: u64) {
        let points = family(kind, 80, seed);
        let Ok(d) = delaunay3(&world(&points)) else { return Ok(()) };
        let locator = TetrahedronLocator::new(&d);
        let high = points.iter().fold([0.0f64; 3], |m, p| [0, 1, 2].map(|k| m[k].max(p[k])));
        let mut chance = Chance(seed ^ 1);
        let mut hint = 0;
        for _ in 0..60 {
            let q = chance.point();
            let q = [0, 1, 2].map(|k| high[k] * (1.4 * q[k] - 0.2));
            let holds = d.mesh.tetrahedra().iter().any(|t| {
                let c = t.map(|v| d.mesh.nodes()[v as usize].0);
                (0..4).all(|i| { let mut s = c; s[i] = q; exact_orient(s) >= 0.0 })
            });
            let found = locator.locate(WorldPoint(q), hint);
            prop_assert_eq!(found.is_some(), holds);
            if let Some(l) = found {
                hint = l.element;
                let t = d.mesh.tetrahedra()[hint as usize];
                for k in 0..3 {
                    let v: f64 = (0..4).map(|i| l.weights[i] * d.mesh.nodes()[t[i] as usize].0[k]).sum();
                    prop_assert!((v - q[k]).abs() < 1e-9 * high[k]);
                }
            }
        }
    }

    /// A linear displacement of the nodes comes back at every voxel in the hull, however the nodes
    /// lie.
    #[test]
    fn linear_fields_come_back_on_all_families(kind in 0..FAMILIES, n in 60usize..300, seed: u64) {
        linear_field_comes_back(kind, n, seed);
    }

    /// Triangles in a plane anywhere: exact on axis-aligned ones, tiling the hull on all.
    #[test]
    fn triangles_in_any_plane(kind in 0..4usize, n in 3usize..300, seed: u64, oblique: bool, axis in 0..3usize) {
        let flat: Vec<[f64; 2]> = family(kind, n, seed).iter().map(|p| [p[0], p[1]]).collect();
        let place = |p: &[f64; 2]| {
            if oblique {
                [0.36 * p[0] + 0.48 * p[1] + 5.0, -0.8 * p[0] + 0.6 * p[1], 0.48 * p[0] + 0.64 * p[1] - 30.0]
            } else {
                let mut q = [0.0; 3];
                (q[axis], q[(axis + 1) % 3], q[(axis + 2) % 3]) = (-4.5, p[0], p[1]);
                q
            }
        };
        let points: Vec<P> = flat.iter().map(place).collect();
        match delaunay2(&world(&points)) {
            Ok(d) => check_triangles(&points, &flat, &d, oblique),
            Err(e) => prop_assert!(n < 30 && matches!(e, MeshError::TooFew { .. } | MeshError::Collinear), "{e}"),
        }
    }
}

fn check_triangles(points: &[P], flat: &[[f64; 2]], d: &Delaunay<TriMesh, 3>, oblique: bool) {
    let coord = |i: u32| Coord { x: flat[i as usize][0], y: flat[i as usize][1] };
    let at = |v: u32| coord(d.source[v as usize]);
    assert!(points.iter().zip(&d.node).all(|(p, &n)| {
        let q = d.mesh.nodes()[n as usize].0;
        (0..3).all(|k| (p[k] - q[k]).abs() < if oblique { 1e-13 } else { f64::MIN_POSITIVE })
    }));
    let plane = Plane::through(d.mesh.nodes()).unwrap();
    let mut area = 0.0;
    let (mut open, mut edges) = (0.0, 0);
    for (e, (t, across)) in d.mesh.triangles().iter().zip(&d.neighbours).enumerate() {
        let [a, b, c] = t.map(|v| plane.project(d.mesh.nodes()[v as usize]));
        let double = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
        assert!(double > if oblique { -1e-12 } else { 0.0 });
        area += double;
        for i in 0..3 {
            edges += 1;
            if across[i] == NO_NEIGHBOUR {
                edges += 1;
                let [p, q] = [1, 2].map(|k| plane.project(d.mesh.nodes()[t[(i + k) % 3] as usize]));
                open += p[0] * q[1] - p[1] * q[0];
                continue;
            }
            let other = across[i] as usize;
            let j = d.neighbours[other].iter().position(|&n| n as usize == e).unwrap();
            let far = d.mesh.triangles()[other][j];
            assert!(!t.contains(&far));
            if !oblique {
                let turn = robust::orient2d(at(t[0]), at(t[1]), at(t[2])).signum();
                assert!(turn * robust::incircle(at(t[0]), at(t[1]), at(t[2]), at(far)) <= 0.0);
            }
        }
    }
    assert!((area - open).abs() <= 1e-9 * area);
    assert_eq!(d.mesh.nodes().len() as i64 - edges / 2 + d.mesh.triangles().len() as i64, 1);
    let locator = TriangleLocator::new(d).unwrap();
    for t in d.mesh.triangles() {
        let c = t.map(|v| d.mesh.nodes()[v as usize].0);
        let middle = [0, 1, 2].map(|k| (c[0][k] + c[1][k] + c[2][k]) / 3.0);
        let l = locator.locate(WorldPoint(middle), 0).unwrap();
        let t = d.mesh.triangles()[l.element as usize];
        for k in 0..3 {
            let v: f64 = (0..3).map(|i| l.weights[i] * d.mesh.nodes()[t[i] as usize].0[k]).sum();
            assert!((v - middle[k]).abs() < 1e-9 * (1.0 + middle[k].abs()));
        }
    }
    assert_eq!(locator.locate(WorldPoint([1e4; 3]), 0), None);
}

#[test]
fn a_large_lattice_is_tiled() {
    let points = family(1, 27_000, 7);
    let d = delaunay3(&world(&points)).unwrap();
    check(&points, &d);
    assert!((total_volume(&d.mesh) - 29.0f64.powi(3)).abs() < 1e-6);
    check_volume(&d);
}

#[test]
fn large_families_are_exact() {
    for kind in 0..FAMILIES - 1 {
        let points = family(kind, 6000, 11);
        check(&points, &delaunay3(&world(&points)).unwrap());
    }
}

#[test]
fn the_first_of_coinciding_points_stands_for_them() {
    let mut points = family(0, 50, 3);
    points.extend_from_within(10..40);
    points[3] = points[60];
    let d = delaunay3(&world(&points)).unwrap();
    assert_eq!(d.source, (0..50).filter(|&i| i != 20).collect::<Vec<u32>>());
    assert_eq!((d.node[60], d.node[20], d.node[3]), (3, 3, 3));
    // Zero has two signs and one place.
    let d = delaunay3(&world(&[[0.0; 3], [-0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])).unwrap();
    assert_eq!((d.node, d.mesh.tetrahedra().len()), (vec![0, 0, 1, 2, 3], 1));
}

#[test]
fn errors_name_the_degeneracy() {
    let error3 = |p: &[P]| delaunay3(&world(p)).unwrap_err();
    let error2 = |p: &[P]| delaunay2(&world(p)).unwrap_err();
    let line: Vec<P> = (0..9).map(|i| [f64::from(i), 2.0 * f64::from(i), 1.0]).collect();
    let plane: Vec<P> = (0..9).map(|i| [f64::from(i), f64::from(i * i), f64::from(i)]).collect();
    assert_eq!(error3(&[]), MeshError::TooFew { found: 0, needed: 4 });
    assert_eq!(error3(&[[1.0; 3]; 9]), MeshError::TooFew { found: 1, needed: 4 });
    assert_eq!(error3(&line[..3]), MeshError::TooFew { found: 3, needed: 4 });
    assert_eq!(error3(&line), MeshError::Collinear);
    assert_eq!(error3(&plane), MeshError::Coplanar);
    assert_eq!(error3(&[[0.0; 3], [1.0, f64::NAN, 0.0]]), MeshError::NotFinite { node: 1 });
    assert_eq!(error2(&[]), MeshError::TooFew { found: 0, needed: 3 });
    assert_eq!(error2(&[[1.0; 3]; 4]), MeshError::TooFew { found: 1, needed: 3 });
    assert_eq!(error2(&[[1.0; 3], [2.0; 3], [1.0; 3]]), MeshError::TooFew { found: 2, needed: 3 });
    assert_eq!(error2(&line), MeshError::Collinear);
    assert_eq!(error2(&[[0.0; 3], [f64::INFINITY; 3]]), MeshError::NotFinite { node: 1 });
    assert_eq!(delaunay2(&world(&plane)).unwrap().mesh.nodes().len(), 9);
}

/// Points within rounding of the hull are in it, others not, and no number is too strange to ask
/// for.
#[test]
fn the_hull_is_closed() {
    let points = family(8, 600, 5);
    let d = delaunay3(&world(&points)).unwrap();
    let locator = TetrahedronLocator::new(&d);
    for (n, p) in d.mesh.nodes().iter().enumerate() {
        let l = locator.locate(*p, 0).unwrap();
        let t = d.mesh.tetrahedra()[l.element as usize];
        let weight: f64 = (0..4).filter(|&i| t[i] as usize == n).map(|i| l.weights[i]).sum();
        assert!((weight - 1.0).abs() < 1e-9);
    }
    assert_eq!(locator.locate(WorldPoint([f64::NAN; 3]), 0), None);
    assert_eq!(locator.locate(WorldPoint([1e300; 3]), u32::MAX), None);
}

#[test]
fn quality_of_known_tetrahedra() {
    let regular = quality([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]].map(WorldPoint));
    assert!((regular.volume.abs() - 8.0 / 3.0).abs() < 1e-14);
    assert!((regular.radius_edge_ratio - 6f64.sqrt() / 4.0).abs() < 1e-14);
    assert!((regular.min_dihedral_angle - (1.0f64 / 3.0).acos()).abs() < 1e-14);
    let corner = quality([[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(WorldPoint));
    assert!((corner.volume - 1.0 / 6.0).abs() < 1e-15);
    assert!((corner.radius_edge_ratio - 0.75f64.sqrt()).abs() < 1e-14);
    assert!((corner.min_dihedral_angle - (1.0 / 3f64.sqrt()).acos()).abs() < 1e-14);
    let d = delaunay3(&world(&family(0, 200, 2))).unwrap();
    assert!(
        qualities(&d.mesh).iter().all(|q| q.volume > 0.0 && q.radius_edge_ratio > 0.61 && q.min_dihedral_angle < 1.24)
    );
}
