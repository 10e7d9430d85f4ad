//! A meshed body made ready to be solved: elements with their quadrature, unknowns, surface.

use crate::error::StiffnessError;
use crate::numerics::sparse::Pattern;
use crate::numerics::tetrahedron::EDGES;
use crate::stiffness::elements::{Point, points};
use crate::stiffness::saddle::TwoLevel;
use crate::types::QuadraticMesh;
use crate::types::space::cross;
use rayon::prelude::*;
use std::collections::HashMap;
use std::sync::Arc;

/// Nodes of an element: ten with a displacement, four with a pressure.
pub(crate) const ELEMENT_NODES: usize = 14;
/// Unknowns of an element: three displacements at each of ten nodes, a pressure at each of four.
pub(crate) const ELEMENT_UNKNOWNS: usize = 34;

/// Most nodes of a mesh that is solved by factorisation: iterations need less memory, but more time
/// for a plate on a curved body (docs/lab/2026-11-solver.md).
pub(crate) const MAX_DIRECT_NODES: usize = 46_000;

/// A triangle of the surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Facet {
    /// Corners, counter-clockwise from outside, then the middles of the edges 01, 12, 20.
    pub nodes: [u32; 6],
    /// The element behind it.
    pub element: u32,
    /// Outward unit normal of the straight triangle.
    pub normal: [f64; 3],
    /// Its area (mm^2).
    pub area: f64,
    /// Its middle (mm, RAS).
    pub centre: [f64; 3],
}

/// A body ready to be solved.
#[derive(Debug, Clone)]
pub struct Body {
    /// Node places (mm, RAS).
    pub places: Vec<[f64; 3]>,
    /// The ten displacement nodes of each element.
    pub cells: Vec<[u32; 10]>,
    /// The four pressure nodes of each element (numbered after the displacement nodes).
    pub pressures: Vec<[u32; 4]>,
    /// The region of each element, by the order of `labels`.
    pub region: Vec<u16>,
    /// Labels, ascending.
    pub labels: Vec<u8>,
    /// Quadrature points of each element.
    pub quadrature: Vec<[Point; 4]>,
    /// Places of the unknowns in the matrix.
    pub pattern: Arc<Pattern>,
    /// Where a factor would be too large, what equations are solved with instead.
    pub levels: Option<Arc<TwoLevel>>,
    /// The surface.
    pub surface: Vec<Facet>,
    /// Volume of each region (mm^3).
    pub volumes: Vec<f64>,
}

impl Body {
    /// Prepares a mesh.
    ///
    /// # Errors
    /// [`StiffnessError::Unsolvable`] when the matrix does not fit in memory.
    pub fn new(mesh: &QuadraticMesh) -> Result<Self, StiffnessError> {
        let places: Vec<[f64; 3]> = mesh.nodes().iter().map(|p| p.0).collect();
        let cells = mesh.tetrahedra().to_vec();
        let mut labels = mesh.labels().to_vec();
        labels.sort_unstable();
        labels.dedup();
        let region: Vec<u16> = mesh.labels().iter().map(|l| labels.partition_point(|m| m < l) as u16).collect();
        let mut numbers: HashMap<(u32, u16), u32> = HashMap::new();
        let mut all = places.clone();
        let mut width = vec![3u8; places.len()];
        let mut pressures = Vec::with_capacity(cells.len());
        let mut flat = Vec::with_capacity(cells.len() * ELEMENT_NODES);
        for (cell, &r) in cells.iter().zip(&region) {
            let p: [u32; 4] = std::array::from_fn(|i| {
                *numbers.entry((cell[i], r)).or_insert_with(|| {
                    all.push(places[cell[i] as usize]);
                    width.push(1);
                    all.len() as u32 - 1
                })
            });
            flat.extend_from_slice(cell);
            flat.extend_from_slice(&p);
            pressures.push(p);
        }
        let pattern = Arc::new(Pattern::unfactorised(flat, ELEMENT_NODES, &all, width));
        let quadrature: Vec<[Point; 4]> = cells.par_iter().map(|c| points(&c.map(|n| places[n as usize]))).collect();
        let mut volumes = vec![0.0; labels.len()];
        for (q, &r) in quadrature.iter().zip(&region) {
            volumes[r as usize] += q.iter().map(|p| p.weight).sum::<f64>();
        }
        let surface = surface(&cells, &places);
        let large = places.len() > MAX_DIRECT_NODES;
        let out =
            Self { places, cells, pressures, region, labels, quadrature, pattern, levels: None, surface, volumes };
        if large { out.iterated() } else { Ok(out) }
    }

    /// The same, solved by iterations whatever its size.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn iterated(self) -> Result<Self, StiffnessError> {
        let levels = TwoLevel::new(&self.cells, &self.pressures, &self.places, &self.pattern);
        Ok(Self { levels: Some(Arc::new(levels.map_err(|_| StiffnessError::Unsolvable)?)), ..self })
    }

    /// Has the displacements of some nodes eliminated last, which makes matrices that differ at
    /// these alone cheap to factorise in turn; not where there are too many for that. Unknowns are
    /// numbered anew.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub(crate) fn eliminate_last(&mut self, nodes: &[u32]) -> Result<(), StiffnessError> {
        if self.levels.is_some() {
            return Ok(());
        }
        let pattern = self.pattern.eliminating_last(nodes).map_err(|_| StiffnessError::Unsolvable)?;
        if pattern.renews() {
            self.pattern = Arc::new(pattern);
        }
        Ok(())
    }

    /// The same elements with their nodes elsewhere.
    pub fn with_places(&self, places: Vec<[f64; 3]>) -> Self {
        let quadrature = self.cells.par_iter().map(|c| points(&c.map(|n| places[n as usize]))).collect();
        let surface = surface(&self.cells, &places);
        Self { places, quadrature, surface, ..self.clone() }
    }

    /// Mean side of an element (mm).
    pub(crate) fn element_size(&self) -> f64 {
        (self.volumes.iter().sum::<f64>() / self.cells.len() as f64).cbrt()
    }

    /// Nodes of some facets, ascending.
    pub fn nodes_on(&self, facets: impl IntoIterator<Item = usize>) -> Vec<u32> {
        sorted(facets.into_iter().flat_map(|f| self.surface[f].nodes))
    }

    /// Nodes of the elements of some regions, ascending.
    pub(crate) fn nodes_in(&self, region: impl Fn(usize) -> bool) -> Vec<u32> {
        let inside = self.cells.iter().zip(&self.region).filter(|(_, r)| region(**r as usize));
        sorted(inside.flat_map(|(c, _)| *c))
    }

    /// The displacement (mm) of a node in a vector of unknowns.
    #[inline]
    pub fn displacement(&self, x: &[f64], node: u32) -> [f64; 3] {
        let at = self.pattern.first(node);
        [x[at], x[at + 1], x[at + 2]]
    }

    /// The unknowns of an element: thirty displacements, four pressures.
    pub(crate) fn gather(&self, x: &[f64], e: usize) -> [f64; ELEMENT_UNKNOWNS] {
        let mut out = [0.0; ELEMENT_UNKNOWNS];
        for (i, &n) in self.cells[e].iter().enumerate() {
            let at = self.pattern.first(n);
            out[3 * i..3 * i + 3].copy_from_slice(&x[at..at + 3]);
        }
        for (i, &n) in self.pressures[e].iter().enumerate() {
            out[30 + i] = x[self.pattern.first(n)];
        }
        out
    }

    /// Adds an element's vector to one of unknowns.
    pub fn scatter(&self, x: &mut [f64], e: usize, values: &[f64; ELEMENT_UNKNOWNS]) {
        for (i, &n) in self.cells[e].iter().enumerate() {
            let at = self.pattern.first(n);
            for a in 0..3 {
                x[at + a] += values[3 * i + a];
            }
        }
        for (i, &n) in self.pressures[e].iter().enumerate() {
            x[self.pattern.first(n)] += values[30 + i];
        }
    }
}

/// Each once, ascending.
pub(super) fn sorted(nodes: impl Iterator<Item = u32>) -> Vec<u32> {
    let mut nodes: Vec<u32> = nodes.collect();
    nodes.sort_unstable();
    nodes.dedup();
    nodes
}

fn surface(cells: &[[u32; 10]], places: &[[f64; 3]]) -> Vec<Facet> {
    // Corners across from each corner, counter-clockwise from outside.
    const FACES: [[usize; 3]; 4] = [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]];
    let mut seen: HashMap<[u32; 3], (u32, u8, bool)> = HashMap::with_capacity(2 * cells.len());
    for (e, c) in cells.iter().enumerate() {
        for (i, f) in FACES.iter().enumerate() {
            let mut key = f.map(|k| c[k]);
            key.sort_unstable();
            seen.entry(key).and_modify(|s| s.2 = false).or_insert((e as u32, i as u8, true));
        }
    }
    let mut outer: Vec<(u32, u8)> = seen.into_values().filter(|s| s.2).map(|s| (s.0, s.1)).collect();
    outer.sort_unstable();
    let middle = |c: &[u32; 10], i: usize, j: usize| {
        let at = EDGES.iter().position(|e| *e == [i.min(j), i.max(j)] || *e == [i.max(j), i.min(j)]);
        c[4 + at.unwrap_or(0)]
    };
    let facet = |(e, i): (u32, u8)| {
        let c = &cells[e as usize];
        let f = FACES[i as usize];
        let m = [middle(c, f[0], f[1]), middle(c, f[1], f[2]), middle(c, f[2], f[0])];
        let p = f.map(|k| places[c[k] as usize]);
        let to = |q: [f64; 3]| std::array::from_fn::<f64, 3, _>(|a| q[a] - p[0][a]);
        let n = cross(to(p[1]), to(p[2]));
        let length = n.iter().map(|v| v * v).sum::<f64>().sqrt();
        Facet {
            nodes: [c[f[0]], c[f[1]], c[f[2]], m[0], m[1], m[2]],
            element: e,
            normal: n.map(|v| v / length),
            area: 0.5 * length,
            centre: std::array::from_fn(|a| (p[0][a] + p[1][a] + p[2][a]) / 3.0),
        }
    };
    outer.into_iter().map(facet).collect()
}
