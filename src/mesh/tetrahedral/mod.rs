//! A quality tetrahedral mesh of a label map, for elasticity: quadratic, graded, with faces on the
//! body's surface and on the interfaces between its parts.
//!
//! A graded body-centred cubic lattice (`lattice`) is cut along the smooth surface of the body
//! and then along that of each part ([`levels`], `rounding`, `cutting`), its inner vertices are
//! moved where that makes the worst shapes better (`smoothing`), and edges on surfaces are bent
//! onto them ([`curving`]).
//!
//! Promises: neighbours share whole faces; every element lies in one part and has a positive
//! Jacobian determinant at its corners, mid-edges and quadrature points; at least four intervals
//! between nodes lie across the thinnest part, as far as the limit on the number of nodes allows.
//! Needs a body in one piece. Where parts meet at edges thinner than a cell, elements go to the
//! part that holds their centre.

pub mod levels;

mod rounding;

mod lattice;

mod cutting;

mod smoothing;

pub mod curving;

use crate::error::MeshError;
use crate::numerics::tetrahedron::EDGES;
use crate::types::{Grid, Mask, QuadraticMesh, VoxelPoint, WorldPoint};
use cutting::Cut;
use levels::Levels;
use std::collections::{BTreeMap, HashMap};

/// How fine to mesh.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fineness {
    /// Side of a base cube (mm); nodes lie at about half of it.
    pub size: f64,
    /// Cubes across the thinnest part; each holds two elements and four intervals between nodes.
    pub layers: f64,
    /// Nodes at most, estimated; thin parts get coarser cubes beyond.
    pub nodes: usize,
}

impl Fineness {
    /// Base cubes so that a body of `volume` (mm^3) gets about `nodes` nodes (16 a cube inside, 22
    /// with the surface's).
    pub fn for_nodes(volume: f64, nodes: usize) -> Self {
        Self { size: (22.0 * volume / nodes as f64).cbrt(), layers: 2.0, nodes: nodes + nodes / 2 }
    }
}

/// A level function of the place (grid mm: voxel index times spacing).
pub(crate) type Wall<'a> = &'a (dyn Fn([f64; 3]) -> f64 + Sync);

/// The part of a mesh that is finer than the rest.
#[derive(Clone, Copy, Default)]
pub struct Detail<'a> {
    /// Places (grid mm) around which cubes are smaller.
    pub near: &'a [[f64; 3]],
    /// About their side (mm).
    pub size: f64,
    /// Its zero is made of faces, though both sides are of one part.
    pub wall: Option<Wall<'a>>,
}

/// Face-connected pieces of the voxels that are not 0, largest first, as voxel counts.
pub fn pieces(labels: &Mask) -> Vec<usize> {
    let shape = labels.grid().shape();
    let stride = [1, shape[0], shape[0] * shape[1]];
    let values = labels.as_slice();
    let mut seen = vec![false; values.len()];
    let mut found = Vec::new();
    for start in 0..values.len() {
        if values[start] == 0 || seen[start] {
            continue;
        }
        seen[start] = true;
        let (mut stack, mut count) = (vec![start], 0);
        while let Some(o) = stack.pop() {
            count += 1;
            let at = labels.grid().voxel(o);
            for a in 0..3 {
                let up = (at[a] + 1 < shape[a]).then(|| o + stride[a]);
                let down = (at[a] > 0).then(|| o - stride[a]);
                for q in up.into_iter().chain(down) {
                    if values[q] > 0 && !seen[q] {
                        seen[q] = true;
                        stack.push(q);
                    }
                }
            }
        }
        found.push(count);
    }
    found.sort_unstable_by(|a, b| b.cmp(a));
    found
}

/// Meshes the voxels of `labels` that are not 0; each label becomes a region of elements.
///
/// # Errors
/// [`MeshError::TooFew`] when no element fits into the body, [`MeshError::PartLost`] when none fits
/// into a part.
pub fn mesh_labels(labels: &Mask, fineness: &Fineness) -> Result<QuadraticMesh, MeshError> {
    Mesher::new(labels)?.mesh(fineness)
}

/// A label map with its smooth surfaces, to be meshed more than once.
#[derive(Debug, Clone)]
pub struct Mesher {
    grid: Grid,
    levels: Levels,
}

impl Mesher {
    /// Finds the surfaces of `labels`.
    ///
    /// # Errors
    /// [`MeshError::TooFew`] when all are 0.
    pub fn new(labels: &Mask) -> Result<Self, MeshError> {
        let levels = Levels::new(labels).ok_or(MeshError::TooFew { found: 0, needed: 4 })?;
        Ok(Self { grid: *labels.grid(), levels })
    }

    /// As [`mesh_labels`].
    ///
    /// # Errors
    /// As [`mesh_labels`].
    pub fn mesh(&self, fineness: &Fineness) -> Result<QuadraticMesh, MeshError> {
        self.mesh_finer(fineness, Detail::default())
    }

    /// With some places in more detail. Where parts get no element, smaller cubes are tried in
    /// these, down to half a voxel.
    ///
    /// # Errors
    /// As [`mesh_labels`].
    pub fn mesh_finer(&self, fineness: &Fineness, detail: Detail<'_>) -> Result<QuadraticMesh, MeshError> {
        let mut halvings = self.halvings(fineness);
        // What does not show in cubes of half a voxel does not show in smaller ones.
        let voxel = self.levels.volume() / self.levels.voxels().count().max(1) as f64;
        let finest = (2.0 * self.cubes(fineness).base() / voxel.cbrt()).log2().max(0.0) as u32;
        let most = finest.min(lattice::MAX_LEVEL);
        loop {
            let lost = match self.meshed(fineness, detail, &halvings) {
                Err(MeshError::PartLost { labels }) => labels,
                done => return done,
            };
            let open: Vec<u8> = lost.iter().copied().filter(|l| halvings[l] < most).collect();
            if open.is_empty() {
                return Err(MeshError::PartLost { labels: lost });
            }
            open.into_iter().for_each(|l| *halvings.entry(l).or_default() += 1);
        }
    }

    /// About how many nodes [`Self::mesh_finer`] makes; none where it makes no mesh with this
    /// fineness itself.
    pub fn nodes(&self, fineness: &Fineness, detail: Detail<'_>) -> Option<usize> {
        let lattice = self.lattice(fineness, detail, &self.halvings(fineness));
        let cut = cut_up(&lattice, &self.levels, detail.wall).ok()?;
        // One in the middle of each edge.
        let mut edges: Vec<[u32; 2]> =
            cut.cells.iter().flat_map(|c| EDGES.map(|[i, j]| [c[i].min(c[j]), c[i].max(c[j])])).collect();
        edges.sort_unstable();
        edges.dedup();
        Some(cut.places.len() + edges.len())
    }

    fn cubes(&self, fineness: &Fineness) -> lattice::Octree {
        lattice::Octree::new(self.levels.bounds(), fineness.size)
    }

    /// How often the cubes of each part are halved: where it is thin, as far as the estimated
    /// number of nodes stays within the limit.
    fn halvings(&self, fineness: &Fineness) -> BTreeMap<u8, u32> {
        halvings(&self.levels, fineness, self.cubes(fineness).base())
    }

    /// Cubes halved so often in each part.
    fn lattice(&self, fineness: &Fineness, detail: Detail<'_>, halvings: &BTreeMap<u8, u32>) -> lattice::Lattice {
        let mut octree = self.cubes(fineness);
        self.levels.voxels().for_each(|(label, p)| octree.refine(p, halvings[&label]));
        let halvings = (octree.base() / detail.size).log2().round().clamp(0.0, f64::from(lattice::MAX_LEVEL)) as u32;
        detail.near.iter().for_each(|p| octree.refine(*p, halvings));
        octree.tetrahedra()
    }

    fn meshed(
        &self,
        fineness: &Fineness,
        detail: Detail<'_>,
        halvings: &BTreeMap<u8, u32>,
    ) -> Result<QuadraticMesh, MeshError> {
        let mut levels = self.levels.clone();
        let lattice = self.lattice(fineness, detail, halvings);
        let mut made = build(&lattice, &levels, detail.wall)?;
        for _ in 0..VOLUME_CALIBRATIONS {
            calibrate(&made, &mut levels);
            made = build(&lattice, &levels, detail.wall)?;
        }
        let Made { places, mut tetrahedra, part } = made;
        let (affine, spacing) = (self.grid.affine(), self.grid.spacing());
        let world = |p: &[f64; 3]| affine.to_world(VoxelPoint(std::array::from_fn(|a| p[a] / spacing[a])));
        if crate::types::space::determinant(affine.linear()) < 0.0 {
            tetrahedra.iter_mut().for_each(mirror);
        }
        let nodes: Vec<WorldPoint> = places.iter().map(world).collect();
        let labels = part.iter().map(|&k| levels.labels()[k as usize]).collect();
        QuadraticMesh::new(nodes, tetrahedra, labels)
    }
}

/// The bit of vertices on the wall of a [`Detail`].
const WALL_BIT: u32 = 1 << 31;
/// Times that surfaces are shifted to correct volumes.
const VOLUME_CALIBRATIONS: usize = 2;

/// A mesh in grid mm.
struct Made {
    places: Vec<[f64; 3]>,
    tetrahedra: Vec<[u32; 10]>,
    part: Vec<u8>,
}

/// Tetrahedra along all surfaces, where they were cut.
fn cut_up(lattice: &lattice::Lattice, levels: &Levels, wall: Option<Wall<'_>>) -> Result<Cut, MeshError> {
    let mut cut = Cut::new(lattice.clone());
    let inside = cut.along(|p| levels.body(p), 1, |_, _| false);
    cut.retain(&inside);
    keep_largest(&mut cut);
    mark_boundary(&mut cut);
    let parts = levels.labels().len();
    for k in 0..parts - 1 {
        let edges = boundary_edges(&cut.cells);
        let on = |a: u32, b: u32| cut_edge(&edges, a, b);
        let inside = cut.along(|p| levels.part(k, p), 2 << k.min(29), on);
        for (part, _) in cut.part.iter_mut().zip(&inside).filter(|(p, inside)| **p == cutting::NO_PART && **inside) {
            *part = k as u8;
        }
    }
    cut.part.iter_mut().filter(|p| **p == cutting::NO_PART).for_each(|p| *p = parts as u8 - 1);
    if let Some(wall) = wall {
        let edges = boundary_edges(&cut.cells);
        cut.along(wall, WALL_BIT, |a, b| cut_edge(&edges, a, b));
    }
    if cut.cells.len() < 4 {
        return Err(MeshError::TooFew { found: cut.places.len(), needed: 4 });
    }
    let lost = (0..parts).filter(|&k| !cut.part.contains(&(k as u8)));
    let lost: Vec<u8> = lost.map(|k| levels.labels()[k]).collect();
    if !lost.is_empty() {
        return Err(MeshError::PartLost { labels: lost });
    }
    Ok(cut)
}

fn build(lattice: &lattice::Lattice, levels: &Levels, wall: Option<Wall<'_>>) -> Result<Made, MeshError> {
    let mut cut = cut_up(lattice, levels, wall)?;
    smoothing::smooth(&mut cut);
    let (places, tetrahedra) = curving::quadratic(&cut, &cut.part, levels);
    Ok(Made { places, tetrahedra, part: cut.part })
}

/// Moves the surfaces by the missing volume over their area: chords of curved surfaces lie inside
/// of them.
fn calibrate(made: &Made, levels: &mut Levels) {
    let wanted = levels.volumes();
    let mut volume = vec![0.0; wanted.len()];
    let corners: Vec<[u32; 4]> = made.tetrahedra.iter().map(|t| [t[0], t[1], t[2], t[3]]).collect();
    for (t, &k) in made.tetrahedra.iter().zip(&made.part) {
        volume[k as usize] += curving::volume(t.map(|n| made.places[n as usize]));
    }
    let (mut outer, mut inner) = (0.0, vec![0.0; wanted.len()]);
    // Sums in a fixed order.
    let mut all: Vec<([u32; 3], [u32; 2])> = faces(&corners).into_iter().collect();
    all.sort_unstable();
    for (f, [a, b]) in all {
        let [p, q, r] = f.map(|v| made.places[v as usize]);
        let to = |s: [f64; 3]| std::array::from_fn::<f64, 3, _>(|a| s[a] - p[a]);
        let n = crate::types::space::cross(to(q), to(r));
        let area = 0.5 * crate::types::space::dot(n, n).sqrt();
        if b == u32::MAX {
            outer += area;
        } else if made.part[a as usize] != made.part[b as usize] {
            inner[made.part[a as usize] as usize] += area;
            inner[made.part[b as usize] as usize] += area;
        }
    }
    let limit = |d: f64| d.clamp(-0.3 * levels.voxel(), 0.3 * levels.voxel());
    let missing: f64 = wanted.iter().sum::<f64>() - volume.iter().sum::<f64>();
    let parts: Vec<f64> = (0..wanted.len())
        .map(|k| if inner[k] > 0.0 { limit((wanted[k] - volume[k]) / inner[k]) } else { 0.0 })
        .collect();
    let body = limit(missing / outer);
    levels.grow(body, &parts);
}

/// Exchanges two corners and the mid-edges that go with them.
fn mirror(t: &mut [u32; 10]) {
    t.swap(0, 1);
    t.swap(5, 6);
    t.swap(7, 8);
}

fn cut_edge(edges: &std::collections::HashSet<(u32, u32)>, a: u32, b: u32) -> bool {
    edges.contains(&(a.min(b), a.max(b)))
}

/// How often cubes of side `base` (mm) are halved in each part: where it is thin, as far as the
/// estimated number of nodes stays within the limit.
fn halvings(levels: &Levels, fineness: &Fineness, base: f64) -> BTreeMap<u8, u32> {
    let wanted: BTreeMap<u8, f64> =
        levels.labels().iter().copied().zip(levels.thickness().iter().map(|t| t / fineness.layers)).collect();
    let mut volume: BTreeMap<u8, f64> = BTreeMap::new();
    let voxel = levels.volume() / levels.voxels().count().max(1) as f64;
    levels.voxels().for_each(|(label, _)| *volume.entry(label).or_default() += voxel);
    let halvings = |label: u8, slack: f64| {
        let ratio = base / (wanted[&label] * slack);
        if ratio <= 1.0 { 0 } else { (ratio.log2().ceil() as u32).min(lattice::MAX_LEVEL) }
    };
    // Twice for the cubes between sizes.
    let estimate = |label: u8, slack: f64| {
        let h = halvings(label, slack);
        16.0 * volume[&label] / base.powi(3) * f64::from(8u32.pow(h)) * if h > 0 { 2.0 } else { 1.0 }
    };
    let mut slack: BTreeMap<u8, f64> = wanted.keys().map(|&l| (l, 1.15)).collect();
    for _ in 0..200 {
        let cost: Vec<(u8, f64)> = slack.iter().map(|(&l, &s)| (l, estimate(l, s))).collect();
        if cost.iter().map(|c| c.1).sum::<f64>() <= fineness.nodes as f64 {
            break;
        }
        // The dearest part that is still divided gives way.
        let divided = cost.into_iter().filter(|&(l, _)| halvings(l, slack[&l]) > 0);
        let Some((dearest, _)) = divided.max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0))) else { break };
        slack.entry(dearest).and_modify(|s| *s *= 1.2);
    }
    slack.into_iter().map(|(label, slack)| (label, halvings(label, slack))).collect()
}

/// Faces by their sorted vertices, each with the cells that have it.
fn faces(cells: &[[u32; 4]]) -> HashMap<[u32; 3], [u32; 2]> {
    let mut out: HashMap<[u32; 3], [u32; 2]> = HashMap::with_capacity(2 * cells.len());
    for (e, c) in cells.iter().enumerate() {
        for i in 0..4 {
            let mut f = [c[(i + 1) % 4], c[(i + 2) % 4], c[(i + 3) % 4]];
            f.sort_unstable();
            out.entry(f).and_modify(|s| s[1] = e as u32).or_insert([e as u32, u32::MAX]);
        }
    }
    out
}

fn boundary_edges(cells: &[[u32; 4]]) -> std::collections::HashSet<(u32, u32)> {
    let mut out = std::collections::HashSet::new();
    for (f, sides) in faces(cells) {
        if sides[1] == u32::MAX {
            out.extend([(f[0], f[1]), (f[1], f[2]), (f[0], f[2])]);
        }
    }
    out
}

fn mark_boundary(cut: &mut Cut) {
    for (f, sides) in faces(&cut.cells) {
        if sides[1] == u32::MAX {
            f.iter().for_each(|&v| cut.surfaces[v as usize] |= 1);
        }
    }
}

/// Cutting may leave crumbs where the body is thinner than a cell.
fn keep_largest(cut: &mut Cut) {
    let mut parent: Vec<u32> = (0..cut.cells.len() as u32).collect();
    fn top(parent: &mut [u32], mut v: u32) -> u32 {
        while parent[v as usize] != v {
            parent[v as usize] = parent[parent[v as usize] as usize];
            v = parent[v as usize];
        }
        v
    }
    for sides in faces(&cut.cells).values().filter(|s| s[1] != u32::MAX) {
        let (a, b) = (top(&mut parent, sides[0]), top(&mut parent, sides[1]));
        parent[a.max(b) as usize] = a.min(b);
    }
    let roots: Vec<u32> = (0..cut.cells.len() as u32).map(|e| top(&mut parent, e)).collect();
    let mut count: BTreeMap<u32, usize> = BTreeMap::new();
    roots.iter().for_each(|&r| *count.entry(r).or_default() += 1);
    let largest = count.iter().fold((0, 0), |m, (&r, &n)| if n > m.1 { (r, n) } else { m }).0;
    let keep: Vec<bool> = roots.iter().map(|&r| r == largest).collect();
    cut.retain(&keep);
}
