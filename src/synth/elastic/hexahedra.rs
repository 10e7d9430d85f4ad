//! Hexahedra whose curved surfaces are kept while they are halved.

use std::collections::HashMap;

/// A set of named surfaces, one a bit: which of them a vertex lies on.
pub type Surfaces = u16;

/// The held face.
pub const HELD: Surfaces = 1;
/// The pressed face.
pub const PRESSED: Surfaces = 2;
/// The first of the curved surfaces; the others follow.
pub const CURVED: Surfaces = 4;

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
}

/// The lattice `i + 3 j + 9 k` of a halved hexahedron: corners, middles of edges and faces, centre.
pub type Lattice = [u32; 27];

impl HexMesh {
    /// Adds a vertex; its number.
    pub fn vertex(&mut self, place: [f64; 3], surfaces: Surfaces) -> u32 {
        self.vertices.push(place);
        self.surfaces.push(surfaces);
        (self.vertices.len() - 1) as u32
    }

    /// Adds the hexahedron between two quadrilaterals (corners `i + 2 j` each), turned to be right-handed.
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
        self.hexes.push(hex);
        self.region.push(region);
    }

    /// Each hexahedron cut into eight (child `c` of hexahedron `e` is number `8 e + c`), and its lattice.
    ///
    /// Vertices keep their numbers. New ones lie at the transfinite middle of their edge, face or cell (Gordon and Hall
    /// 1973); `project` brings one that lies on all of the given surfaces onto them.
    pub fn refined(&self, project: &dyn Fn(Surfaces, [f64; 3]) -> [f64; 3]) -> (HexMesh, Vec<Lattice>) {
        let mut out = HexMesh { vertices: self.vertices.clone(), surfaces: self.surfaces.clone(), ..Self::default() };
        let mut middles: HashMap<[u32; 4], u32> = HashMap::new();
        let mut lattices = Vec::with_capacity(self.hexes.len());
        for (hex, &region) in self.hexes.iter().zip(&self.region) {
            let mut lattice = [u32::MAX; 27];
            for (c, &v) in hex.iter().enumerate() {
                lattice[2 * (c & 1) + 6 * (c >> 1 & 1) + 18 * (c >> 2)] = v;
            }
            // Edges have one odd index, faces two, the centre three: each is made from those before.
            for odd in 1..=3 {
                for n in 0..27 {
                    let place = [n % 3, n / 3 % 3, n / 9];
                    if place.iter().filter(|&&p| p == 1).count() == odd {
                        lattice[n] = out.middle(&lattice, place, &mut middles, project);
                    }
                }
            }
            for c in 0..8 {
                let corner = (c & 1) + 3 * (c >> 1 & 1) + 9 * (c >> 2);
                out.hexes.push(std::array::from_fn(|d| lattice[corner + (d & 1) + 3 * (d >> 1 & 1) + 9 * (d >> 2)]));
                out.region.push(region);
            }
            lattices.push(lattice);
        }
        (out, lattices)
    }

    /// The vertex at the lattice's `place`, made if no neighbour has made it.
    fn middle(
        &mut self,
        lattice: &Lattice,
        place: [usize; 3],
        middles: &mut HashMap<[u32; 4], u32>,
        project: &dyn Fn(Surfaces, [f64; 3]) -> [f64; 3],
    ) -> u32 {
        // All lattice places where the odd indices are replaced by 0, 1 or 2.
        let choices = |p: usize| if p == 1 { 0..3 } else { p..p + 1 };
        let mut corners = Vec::with_capacity(8);
        let mut sum = [0.0; 3];
        let odd = place.iter().filter(|&&p| p == 1).count();
        for k in choices(place[2]) {
            for j in choices(place[1]) {
                for i in choices(place[0]) {
                    let moved = [i, j, k].iter().zip(place).filter(|(a, b)| **a != *b).count();
                    if moved == 0 {
                        continue;
                    }
                    let v = lattice[i + 3 * j + 9 * k];
                    // Boolean sum of the linear blends: sides half, their edges minus a quarter, corners an eighth.
                    let weight = [0.5, -0.25, 0.125][moved - 1];
                    let p = self.vertices[v as usize];
                    (0..3).for_each(|a| sum[a] += weight * p[a]);
                    if moved == odd {
                        corners.push(v);
                    }
                }
            }
        }
        corners.sort_unstable();
        let key = std::array::from_fn(|c| corners.get(c).copied().unwrap_or(u32::MAX));
        if odd < 3
            && let Some(&known) = middles.get(&key)
        {
            return known;
        }
        let surfaces = corners.iter().fold(Surfaces::MAX, |s, &v| s & self.surfaces[v as usize]);
        let made = self.vertex(project(surfaces, sum), surfaces);
        if odd < 3 {
            middles.insert(key, made);
        }
        made
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
