//! Exact Delaunay tetrahedralisation of points in space.
//!
//! Promises: the tetrahedra tile the convex hull, none is flat, each is positively oriented, and no
//! point lies strictly inside the sphere through any (where more than four lie on one sphere, it is
//! one of the valid choices, always the same). Needs finite points that do not all lie in one
//! plane; points that coincide become one node. Time grows as n log n on points of bounded density;
//! up to about 150 million points fit. Fails on fewer than four points, and on points in one plane
//! or on one line.

use super::cells::Cells;
use super::hilbert::insertion_order;
use super::normalise::normalise;
use super::predicates::{orient2d, orient3d};
use super::{Delaunay, NO_NEIGHBOUR};
use crate::error::MeshError;
use crate::types::{TetMesh, WorldPoint};

/// The Delaunay tetrahedralisation of `points` (world mm, RAS).
///
/// # Errors
/// [`MeshError::NotFinite`]; [`MeshError::TooFew`] under four distinct points;
/// [`MeshError::Collinear`] and [`MeshError::Coplanar`] (exactly so; then see
/// [`delaunay2`](super::delaunay2::delaunay2)).
///
/// Source: Bowyer (1981) and Watson (1981) with exact predicates and biased random insertion.
///
/// ```
/// use palpate::mesh::delaunay3::delaunay3;
/// use palpate::mesh::quality::total_volume;
/// use palpate::{MeshError, WorldPoint};
/// let mut points: Vec<WorldPoint> =
///     (0..8).map(|i| WorldPoint([0, 1, 2].map(|a| f64::from(i >> a & 1)))).collect();
/// points.push(points[0]);
/// let delaunay = delaunay3(&points)?;
/// // The cube is filled, and the repeated point is one node.
/// assert!((total_volume(&delaunay.mesh) - 1.0).abs() < 1e-12);
/// assert_eq!((delaunay.mesh.nodes().len(), delaunay.node[8]), (8, 0));
/// // Four points of one plane need the other function.
/// let flat = [0.0, 1.0, 2.0, 4.0].map(|x| WorldPoint([x, x * x, 0.0]));
/// assert_eq!(delaunay3(&flat), Err(MeshError::Coplanar));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn delaunay3(points: &[WorldPoint]) -> Result<Delaunay<TetMesh, 4>, MeshError> {
    let scaled = normalise(points)?;
    let order = insertion_order(&scaled);
    let sorted: Vec<[f64; 3]> = order.iter().map(|&i| scaled[i as usize]).collect();
    drop(scaled);
    let first = first_tetrahedron(&sorted)?;

    // For each place in the order, the place of the vertex that stands for it.
    let mut vertex: Vec<u32> = (0..sorted.len() as u32).collect();
    let mut cells = Cells::new(sorted, first);
    for k in 0..vertex.len() as u32 {
        if !first.contains(&k)
            && let Some(same) = cells.insert(k)
        {
            vertex[k as usize] = same;
        }
    }
    let (mut tetrahedra, neighbours) = cells.finish(NO_NEIGHBOUR);

    let mut place = vec![0; order.len()];
    for (k, &i) in order.iter().enumerate() {
        place[i as usize] = vertex[k];
    }
    drop((order, vertex));
    let (source, node, number) = number_nodes(place);
    for t in &mut tetrahedra {
        *t = t.map(|v| number[v as usize]);
    }
    let nodes = source.iter().map(|&i| points[i as usize]).collect();
    Ok(Delaunay { mesh: TetMesh::new(nodes, tetrahedra)?, neighbours, source, node })
}

/// Numbers the nodes in the order of the input. `place[i]` is a number that input points at the
/// same place share.
///
/// Gives node to first input point, input point to node, and place to node.
pub(super) fn number_nodes(place: Vec<u32>) -> (Vec<u32>, Vec<u32>, Vec<u32>) {
    let mut number = vec![u32::MAX; place.len()];
    let mut source = Vec::with_capacity(place.len());
    let mut node = place;
    for (i, entry) in node.iter_mut().enumerate() {
        let slot = &mut number[*entry as usize];
        if *slot == u32::MAX {
            *slot = source.len() as u32;
            source.push(i as u32);
        }
        *entry = *slot;
    }
    (source, node, number)
}

/// The first four points that are not coplanar, positively oriented.
fn first_tetrahedron(p: &[[f64; 3]]) -> Result<[u32; 4], MeshError> {
    let find = |from: usize, apart: &dyn Fn(&[f64; 3]) -> bool| (from..p.len()).find(|&i| apart(&p[i]));
    let (mut b, mut c) = (None, None);
    if !p.is_empty() {
        b = find(1, &|q| *q != p[0]);
    }
    if let Some(b) = b {
        c = find(b + 1, &|q| !collinear(&p[0], &p[b], q));
    }
    if let (Some(b), Some(c)) = (b, c)
        && let Some(d) = find(c + 1, &|q| orient3d(&p[0], &p[b], &p[c], q) != 0.0)
    {
        let flip = orient3d(&p[0], &p[b], &p[c], &p[d]) < 0.0;
        let (b, c) = if flip { (c, b) } else { (b, c) };
        return Ok([0, b as u32, c as u32, d as u32]);
    }
    let mut distinct: Vec<[f64; 3]> = p.to_vec();
    distinct.sort_unstable_by(|a, b| a.partial_cmp(b).unwrap_or(std::cmp::Ordering::Equal));
    distinct.dedup();
    Err(match (distinct.len(), c) {
        (found @ 0..4, _) => MeshError::TooFew { found, needed: 4 },
        (_, None) => MeshError::Collinear,
        (_, Some(_)) => MeshError::Coplanar,
    })
}

/// Whether three points lie on one line: so they do in all three projections.
fn collinear(a: &[f64; 3], b: &[f64; 3], c: &[f64; 3]) -> bool {
    (0..3).all(|k| {
        let flat = |p: &[f64; 3]| [p[k], p[(k + 1) % 3]];
        orient2d(flat(a), flat(b), flat(c)) == 0.0
    })
}
