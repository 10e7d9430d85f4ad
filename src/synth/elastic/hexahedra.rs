//! Hexahedra whose curved surfaces are kept while they are halved.

use std::collections::HashMap;

/// A set of named surfaces, one a bit: which of them a vertex lies on.
pub type Surfaces = u16;

/// The held face.
pub const HELD: Surfaces = 1;
/// The pressed face.
pub const PRESSED: Surfaces = 2;
/// The first of the curved surfaces; the others follow.
pub(crate) const CURVED: Surfaces = 4;

/// Hexahedra with corner `i + 2 j + 4 k` at the local place (i, j, k).
#[derive(Debug, Clone, Default)]
pub struct HexMesh {
    /// Places (world mm).
    pub vertices: Vec<[f64; 3]>,
    /// Surfaces of each vertex.
    pub surfaces: Vec<Surfaces>,
    /// Corners of each hexahedron; the local axes are right-handed.
    pub hexes: Vec<[u32; 8]>,
    /// Tissue region of each hexahedron.
    pub region: Vec<u8>,
    /// The hexahedra that all this was cut from.
    blocks: Vec<Block>,
    /// The block of each hexahedron, and its low corner and side there.
    origin: Vec<(u32, [f64; 3], f64)>,
}

/// A curved hexahedron on [0, 1]^3.
#[derive(Debug, Clone, Copy)]
struct Block {
    corners: [[f64; 3]; 8],
    surfaces: [Surfaces; 8],
}

/// Brings a place onto all of some surfaces.
pub(crate) type Project<'a> = dyn Fn(Surfaces, [f64; 3]) -> [f64; 3] + 'a;

impl Block {
    /// The place at `t`: the transfinite blend (Gordon and Hall 1973) of the faces, those of the
    /// edges, those of the corners; each face and edge that lies on a surface is brought onto it.
    fn at(&self, t: [f64; 3], project: &Project<'_>) -> [f64; 3] {
        let free: Vec<usize> = (0..3).filter(|&a| t[a] != 0.0 && t[a] != 1.0).collect();
        let on_it = |c: usize| (0..3).all(|a| free.contains(&a) || (t[a] == 1.0) == (c >> a & 1 == 1));
        if free.is_empty() {
            return (0..8).find(|&c| on_it(c)).map_or([0.0; 3], |c| self.corners[c]);
        }
        let mut sum = [0.0; 3];
        // Boolean sum over the ends of each set of free axes.
        for set in 1..1usize << free.len() {
            let axes: Vec<usize> = (0..free.len()).filter(|i| set >> i & 1 == 1).map(|i| free[i]).collect();
            let sign = if axes.len() % 2 == 1 { 1.0 } else { -1.0 };
            for ends in 0..1usize << axes.len() {
                let (mut s, mut weight) = (t, sign);
                for (i, &a) in axes.iter().enumerate() {
                    let high = ends >> i & 1 == 1;
                    weight *= if high { t[a] } else { 1.0 - t[a] };
                    s[a] = if high { 1.0 } else { 0.0 };
                }
                let p = self.at(s, project);
                (0..3).for_each(|a| sum[a] += weight * p[a]);
            }
        }
        let surfaces = (0..8).filter(|&c| on_it(c)).fold(Surfaces::MAX, |s, c| s & self.surfaces[c]);
        project(surfaces, sum)
    }
}

/// The lattice `i + 3 j + 9 k` of a halved hexahedron: corners, middles of edges and faces, centre.
pub type Lattice = [u32; 27];

impl HexMesh {
    /// Adds a vertex; its number.
    pub(crate) fn vertex(&mut self, place: [f64; 3], surfaces: Surfaces) -> u32 {
        self.vertices.push(place);
        self.surfaces.push(surfaces);
        (self.vertices.len() - 1) as u32
    }

    /// Adds the hexahedron between two quadrilaterals (corners `i + 2 j` each), turned to be
    /// right-handed.
    pub fn between(&mut self, low: [u32; 4], high: [u32; 4], region: u8) {
        let mut hex = [low[0], low[1], low[2], low[3], high[0], high[1], high[2], high[3]];
        let at = |c: usize| self.vertices[hex[c] as usize];
        let side = |axis: usize| -> [f64; 3] {
            let ends = |high: usize| (0..8).filter(move |c| c >> axis & 1 == high);
            std::array::from_fn(|d| ends(1).map(|c| at(c)[d]).sum::<f64>() - ends(0).map(|c| at(c)[d]).sum::<f64>())
        };
        if crate::types::space::determinant(&[side(0), side(1), side(2)]) < 0.0 {
            hex.swap(1, 2);
            hex.swap(5, 6);
        }
        let corners = hex.map(|v| self.vertices[v as usize]);
        self.blocks.push(Block { corners, surfaces: hex.map(|v| self.surfaces[v as usize]) });
        self.origin.push((self.blocks.len() as u32 - 1, [0.0; 3], 1.0));
        self.hexes.push(hex);
        self.region.push(region);
    }

    /// Each hexahedron cut into eight (child `c` of hexahedron `e` is number `8 e + c`), and its
    /// lattice.
    ///
    /// Vertices keep their numbers; `project` keeps the new ones on the curved surfaces.
    pub fn refined(&self, project: &Project<'_>) -> (HexMesh, Vec<Lattice>) {
        let (vertices, surfaces) = (self.vertices.clone(), self.surfaces.clone());
        let mut out = HexMesh { vertices, surfaces, blocks: self.blocks.clone(), ..Self::default() };
        let mut middles: HashMap<[u32; 4], u32> = HashMap::new();
        let mut lattices = Vec::with_capacity(self.hexes.len());
        for (e, hex) in self.hexes.iter().enumerate() {
            let (block, low, side) = self.origin[e];
            let mut lattice = [u32::MAX; 27];
            for n in 0..27 {
                let place = [n % 3, n / 3 % 3, n / 9];
                let on_it = |c: &usize| (0..3).all(|a| place[a] == 1 || place[a] / 2 == (c >> a & 1));
                let mut corners: Vec<u32> = (0..8).filter(on_it).map(|c| hex[c]).collect();
                if let [corner] = corners[..] {
                    lattice[n] = corner;
                    continue;
                }
                corners.sort_unstable();
                let key = std::array::from_fn(|c| corners.get(c).copied().unwrap_or(u32::MAX));
                let inner = corners.len() == 8;
                lattice[n] = match middles.get(&key) {
                    Some(&known) if !inner => known,
                    _ => {
                        let t = std::array::from_fn(|a| low[a] + side * place[a] as f64 / 2.0);
                        let shared = corners.iter().fold(Surfaces::MAX, |s, &v| s & self.surfaces[v as usize]);
                        out.vertex(self.blocks[block as usize].at(t, project), shared)
                    }
                };
                if !inner {
                    middles.insert(key, lattice[n]);
                }
            }
            for c in 0..8 {
                let octant = [c & 1, c >> 1 & 1, c >> 2];
                let first = octant[0] + 3 * octant[1] + 9 * octant[2];
                out.hexes.push(std::array::from_fn(|d| lattice[first + (d & 1) + 3 * (d >> 1 & 1) + 9 * (d >> 2)]));
                out.region.push(self.region[e]);
                out.origin.push((block, std::array::from_fn(|a| low[a] + side / 2.0 * octant[a] as f64), side / 2.0));
            }
            lattices.push(lattice);
        }
        (out, lattices)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halving_shares_vertices_and_keeps_to_a_sphere() {
        let mut mesh = HexMesh::default();
        let corner = |c: usize, s: f64| std::array::from_fn(|a| if c >> a & 1 == 1 { s } else { -s });
        let inner: [u32; 8] = std::array::from_fn(|c| mesh.vertex(corner(c, 0.3), 0));
        let outer: [u32; 8] = std::array::from_fn(|c| mesh.vertex(corner(c, 3f64.sqrt().recip()), CURVED));
        for axis in 0..3 {
            for side in 0..2 {
                let quad = |v: [u32; 8]| -> [u32; 4] {
                    let face: Vec<u32> = (0..8).filter(|c| c >> axis & 1 == side).map(|c| v[c]).collect();
                    std::array::from_fn(|i| face[i])
                };
                mesh.between(quad(inner), quad(outer), 1);
            }
        }
        let project = |s: Surfaces, p: [f64; 3]| {
            let r = p.iter().map(|v| v * v).sum::<f64>().sqrt();
            if s & CURVED != 0 { p.map(|v| v / r) } else { p }
        };
        let (once, _) = mesh.refined(&project);
        let (twice, lattices) = once.refined(&project);
        // A shell of 6 x 16 faces on the sphere has 98 vertices on each of its 5 layers.
        assert_eq!((twice.vertices.len(), twice.hexes.len(), lattices.len()), (98 * 5, 6 * 64, 48));
        for (p, s) in twice.vertices.iter().zip(&twice.surfaces) {
            let r = p.iter().map(|v| v * v).sum::<f64>().sqrt();
            assert_eq!(*s == CURVED, (r - 1.0).abs() < 1e-12, "{p:?}");
        }
    }
}
