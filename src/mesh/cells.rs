//! The growing tetrahedralisation: cells, links between them, and the insertion of one point.
//!
//! The space outside the hull is filled with *ghost* cells, one on each hull facet, whose fourth
//! vertex is [`GHOST`]; so every facet has a cell on both sides. A finite cell is in conflict with
//! a point strictly inside its sphere; a ghost with one strictly beyond its facet, or in the
//! facet's plane and strictly inside its circle. All signs are exact. Then the cells in conflict
//! form a region that is star-shaped around the point, no facet of its surface is coplanar with the
//! point, and joining each to the point (Bowyer 1981, Watson 1981) makes a tiling without flat
//! cells again, whatever points lie on one sphere or plane.

use super::edge_map::EdgeMap;
use super::predicates::{StaticBounds, insphere_bounded, orient3d_bounded};

/// The vertex at infinity; always the last of its cell.
pub(super) const GHOST: u32 = u32::MAX;

/// Four vertices, positively oriented, and four links. Link `i` leads through the facet across from
/// vertex `i`; it is the neighbour's number times four plus the facet's number there.
pub(super) type Cell = [[u32; 4]; 2];

/// For each apex, the other three facets, each with the two vertices of its edge across from the
/// apex.
const APEX_FACETS: [[[usize; 3]; 3]; 4] = [
    [[1, 2, 3], [2, 1, 3], [3, 1, 2]],
    [[0, 2, 3], [2, 0, 3], [3, 0, 2]],
    [[0, 1, 3], [1, 0, 3], [3, 0, 1]],
    [[0, 1, 2], [1, 0, 2], [2, 0, 1]],
];

/// A facet of the cavity's surface joined to the new point: the new cell's vertices, which of them
/// is the new point, and the link outwards.
struct Spoke {
    vertices: [u32; 4],
    apex: usize,
    outward: u32,
}

/// A Delaunay tetrahedralisation of the points inserted so far.
pub(super) struct Cells {
    points: Vec<[f64; 3]>,
    bounds: StaticBounds,
    cells: Vec<Cell>,
    dead: Vec<bool>,
    free: Vec<u32>,
    last: u32,
    chance: u32,
    cavity: Vec<u32>,
    spokes: Vec<Spoke>,
    edges: EdgeMap,
}

impl Cells {
    /// One positively oriented tetrahedron `first` of the points, and the ghosts around it.
    pub(super) fn new(points: Vec<[f64; 3]>, first: [u32; 4]) -> Self {
        // Random points make 6.77 tetrahedra a point, and ghosts.
        let capacity = 7 * points.len() + 64;
        let mut cells = Vec::with_capacity(capacity);
        cells.push([first, [0; 4]]);
        for i in 0..4 {
            let mut ghost = first;
            ghost[i] = GHOST;
            // An odd permutation: the ghost is positive when its last vertex lies outside.
            if i == 3 {
                ghost.swap(0, 1)
            } else {
                ghost.swap(i, 3)
            }
            cells.push([ghost, [0; 4]]);
        }
        let facet = |[v, _]: &Cell, i: usize| {
            let mut f = *v;
            f.swap(i, 3);
            f[..3].sort_unstable();
            [f[0], f[1], f[2]]
        };
        let all: Vec<(u32, [u32; 3])> = (0..20).map(|l| (l, facet(&cells[l as usize / 4], l as usize % 4))).collect();
        for &(l, f) in &all {
            if let Some(&(m, _)) = all.iter().find(|&&(m, g)| g == f && m != l) {
                cells[l as usize / 4][1][l as usize % 4] = m;
            }
        }
        let mut dead = Vec::with_capacity(capacity);
        dead.resize(cells.len(), false);
        let bounds = StaticBounds::new(&points);
        Self {
            points,
            bounds,
            cells,
            dead,
            free: Vec::new(),
            last: 0,
            chance: 0x9e37_79b9,
            cavity: Vec::new(),
            spokes: Vec::new(),
            edges: EdgeMap::new(),
        }
    }

    /// Inserts point `vertex`; gives the vertex that lies at the same place, if there is one.
    pub(super) fn insert(&mut self, vertex: u32) -> Option<u32> {
        let p = self.points[vertex as usize];
        let start = self.locate(&p);
        let [corners, _] = self.cells[start as usize];
        if let Some(&same) = corners.iter().find(|&&v| v != GHOST && self.points[v as usize] == p) {
            return Some(same);
        }
        self.dig(start, vertex, &p);
        self.fill();
        None
    }

    /// The finite cell that holds `p` in its closure, or a ghost that `p` lies strictly beyond.
    ///
    /// Walks through any facet that separates, the first one drawn by chance: on points of one
    /// sphere a fixed choice could go round for ever (Devillers, Pion, Teillaud, "Walking in a
    /// triangulation", 2002).
    fn locate(&mut self, p: &[f64; 3]) -> u32 {
        let (points, cells) = (self.points.as_slice(), self.cells.as_slice());
        let mut at = self.last;
        if cells[at as usize][0][3] == GHOST {
            at = cells[at as usize][1][3] >> 2;
        }
        let mut came = 4;
        'walk: loop {
            let [v, links] = &cells[at as usize];
            if v[3] == GHOST {
                return at;
            }
            self.chance ^= self.chance << 13;
            self.chance ^= self.chance >> 17;
            self.chance ^= self.chance << 5;
            let corners = corners(points, v);
            for turn in 0..4 {
                let i = (self.chance + turn) as usize & 3;
                if i == came {
                    continue;
                }
                let mut q = corners;
                q[i] = p;
                if orient3d_bounded(&self.bounds, q) < 0.0 {
                    at = links[i] >> 2;
                    came = links[i] as usize & 3;
                    continue 'walk;
                }
            }
            return at;
        }
    }

    /// Collects the cells in conflict with `p`, and the facets around them joined to it.
    fn dig(&mut self, start: u32, vertex: u32, p: &[f64; 3]) {
        let (points, cells, dead) = (self.points.as_slice(), self.cells.as_slice(), self.dead.as_mut_slice());
        self.cavity.clear();
        self.spokes.clear();
        self.cavity.push(start);
        dead[start as usize] = true;
        let mut next = 0;
        while let Some(&cell) = self.cavity.get(next) {
            next += 1;
            let [v, links] = &cells[cell as usize];
            for (i, &link) in links.iter().enumerate() {
                let beyond = link >> 2;
                if dead[beyond as usize] {
                    continue;
                }
                if conflicts(points, cells, &self.bounds, beyond, p) {
                    dead[beyond as usize] = true;
                    self.cavity.push(beyond);
                } else {
                    let mut vertices = *v;
                    vertices[i] = vertex;
                    self.spokes.push(Spoke { vertices, apex: i, outward: link });
                }
            }
        }
    }

    /// Puts the new cells into the cavity's slots, and more as needed, and links them.
    fn fill(&mut self) {
        while self.cavity.len() < self.spokes.len() {
            let slot = self.free.pop().unwrap_or_else(|| {
                self.cells.push([[0; 4]; 2]);
                self.dead.push(true);
                self.cells.len() as u32 - 1
            });
            self.cavity.push(slot);
        }
        self.free.extend(self.cavity.drain(self.spokes.len()..));
        self.last = self.cavity[0];
        let (cells, dead) = (self.cells.as_mut_slice(), self.dead.as_mut_slice());
        // A surface of f triangles has 3 f / 2 edges.
        let mut edges = self.edges.start(self.spokes.len() * 3 / 2);
        for (spoke, &slot) in self.spokes.iter().zip(&self.cavity) {
            let mut links = [0; 4];
            links[spoke.apex] = spoke.outward;
            cells[(spoke.outward >> 2) as usize][1][spoke.outward as usize & 3] = slot << 2 | spoke.apex as u32;
            for &[j, k, l] in &APEX_FACETS[spoke.apex] {
                let here = slot << 2 | j as u32;
                if let Some(there) = edges.pair(spoke.vertices[k], spoke.vertices[l], here) {
                    links[j] = there;
                    cells[(there >> 2) as usize][1][there as usize & 3] = here;
                }
            }
            cells[slot as usize] = [spoke.vertices, links];
            dead[slot as usize] = false;
        }
    }

    /// Vertices and neighbours of the finite cells; `none` stands for no neighbour.
    pub(super) fn finish(self, none: u32) -> (Vec<[u32; 4]>, Vec<[u32; 4]>) {
        let Self { mut cells, dead, points, .. } = self;
        drop(points);
        let finite = |i: usize, cells: &[Cell]| !dead[i] && cells[i][0][3] != GHOST;
        // The number that each finite cell will have, kept where a dead or ghost cell holds `none`.
        let mut number = vec![none; cells.len()];
        let mut count = 0;
        for i in 0..cells.len() {
            if finite(i, &cells) {
                number[i] = count;
                count += 1;
            }
        }
        let mut vertices = Vec::with_capacity(count as usize);
        for i in 0..cells.len() {
            if number[i] != none {
                let [v, links] = cells[i];
                // At or before `i`: one half of this memory becomes the neighbour table.
                cells[vertices.len()][1] = links.map(|l| number[(l >> 2) as usize]);
                vertices.push(v);
            }
        }
        let mut neighbours = cells.into_flattened();
        for i in 0..vertices.len() {
            neighbours[i] = neighbours[2 * i + 1];
        }
        neighbours.truncate(vertices.len());
        neighbours.shrink_to_fit();
        (vertices, neighbours)
    }
}

/// The corners of a finite cell.
#[inline(always)]
fn corners<'a>(points: &'a [[f64; 3]], v: &[u32; 4]) -> [&'a [f64; 3]; 4] {
    [&points[v[0] as usize], &points[v[1] as usize], &points[v[2] as usize], &points[v[3] as usize]]
}

/// Whether a cell may not stay once `p` is inserted.
#[inline]
fn conflicts(points: &[[f64; 3]], cells: &[Cell], bounds: &StaticBounds, cell: u32, p: &[f64; 3]) -> bool {
    let [v, links] = &cells[cell as usize];
    if v[3] != GHOST {
        return insphere_bounded(bounds, corners(points, v), p) > 0.0;
    }
    let facet = [v[0], v[1], v[2]].map(|i| &points[i as usize]);
    let side = orient3d_bounded(bounds, [facet[0], facet[1], facet[2], p]);
    // In the facet's plane, the circle of the facet is where the inner cell's sphere cuts the
    // plane.
    let inner = &cells[(links[3] >> 2) as usize][0];
    side > 0.0 || side == 0.0 && insphere_bounded(bounds, corners(points, inner), p) > 0.0
}
