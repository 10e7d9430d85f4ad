//! A graded body-centred cubic lattice of tetrahedra: the background of the mesh.
//!
//! Cubes are halved where a finer mesh is wanted, and their neighbours so far that sizes differ at
//! most by two (octree, 2:1 balanced over faces, edges and corners). Each face joins the centres on
//! its two sides with its edges, as Labelle and Shewchuk ("Isosurface stuffing", SIGGRAPH 2007) do;
//! a face between two sizes is cut along the diagonals that lead to its centre.

use std::collections::{BTreeSet, HashMap};

/// Most halvings of a cube.
pub(crate) const MAX_LEVEL: u32 = 5;

/// Vertices (grid mm) and tetrahedra.
pub type Lattice = (Vec<[f64; 3]>, Vec<[u32; 4]>);

/// A cube: halvings, then its number along each axis at that level (the margin of one base cube
/// makes all positive).
type Cube = (u32, [i32; 3]);

/// The base cubes and which of them are divided.
#[derive(Debug, Clone)]
pub(crate) struct Octree {
    low: [f64; 3],
    size: [f64; 3],
    count: [i32; 3],
    divided: BTreeSet<Cube>,
}

impl Octree {
    /// Base cubes of about `size` (mm) that fill the box `[low, high]` exactly, with one more on
    /// each side.
    pub fn new([low, high]: [[f64; 3]; 2], size: f64) -> Self {
        let n: [f64; 3] = std::array::from_fn(|a| ((high[a] - low[a]) / size).round().max(1.0));
        let size: [f64; 3] = std::array::from_fn(|a| (high[a] - low[a]) / n[a]);
        let low = std::array::from_fn(|a| low[a] - size[a]);
        Self { low, size, count: n.map(|n| n as i32 + 2), divided: BTreeSet::new() }
    }

    /// Largest side of a base cube (mm).
    pub fn base(&self) -> f64 {
        self.size.iter().fold(0.0, |m, &v| f64::max(m, v))
    }

    /// Divides the cubes around `p` (mm) down to `level` halvings.
    pub fn refine(&mut self, p: [f64; 3], level: u32) {
        for l in (0..level.min(MAX_LEVEL)).rev() {
            let scale = f64::from(1u32 << l);
            let at = std::array::from_fn(|a| ((p[a] - self.low[a]) / self.size[a] * scale).floor() as i32);
            if !self.divided.insert((l, at)) {
                break;
            }
        }
    }

    fn exists(&self, cube: Cube) -> bool {
        let (level, at) = cube;
        let scale = 1 << level;
        let within = (0..3).all(|a| (0..self.count[a] * scale).contains(&at[a]));
        within && (level == 0 || self.divided.contains(&(level - 1, at.map(|v| v >> 1))))
    }

    fn balance(&mut self) {
        for level in (1..=MAX_LEVEL).rev() {
            let here: Vec<Cube> =
                self.divided.range((level, [i32::MIN; 3])..(level + 1, [i32::MIN; 3])).copied().collect();
            for (_, at) in here {
                for o in 0..27 {
                    let near = [at[0] + o % 3 - 1, at[1] + o / 3 % 3 - 1, at[2] + o / 9 - 1];
                    let scale = 1 << level;
                    if (0..3).all(|a| (0..self.count[a] * scale).contains(&near[a])) {
                        self.divided.insert((level - 1, near.map(|v| v >> 1)));
                    }
                }
            }
        }
    }

    fn leaves(&self) -> Vec<Cube> {
        let mut out = Vec::new();
        for z in 0..self.count[2] {
            for y in 0..self.count[1] {
                for x in 0..self.count[0] {
                    self.descend((0, [x, y, z]), &mut out);
                }
            }
        }
        out
    }

    fn descend(&self, cube: Cube, out: &mut Vec<Cube>) {
        if !self.divided.contains(&cube) {
            return out.push(cube);
        }
        let (level, at) = cube;
        for c in 0..8 {
            self.descend((level + 1, [2 * at[0] + (c & 1), 2 * at[1] + (c >> 1 & 1), 2 * at[2] + (c >> 2)]), out);
        }
    }

    /// The tetrahedra, positively oriented.
    pub fn tetrahedra(mut self) -> Lattice {
        self.balance();
        let mut build = Builder { octree: &self, numbers: HashMap::new(), places: Vec::new(), cells: Vec::new() };
        for cube in self.leaves() {
            build.cube(cube);
        }
        (build.places, build.cells)
    }
}

/// Units of the vertices' integer coordinates along the edge of a base cube.
const UNITS_PER_CUBE: i32 = 2 << MAX_LEVEL;

struct Builder<'a> {
    octree: &'a Octree,
    numbers: HashMap<[i32; 3], u32>,
    places: Vec<[f64; 3]>,
    cells: Vec<[u32; 4]>,
}

impl Builder<'_> {
    fn place(&self, p: [i32; 3]) -> [f64; 3] {
        std::array::from_fn(|a| self.octree.low[a] + f64::from(p[a]) / f64::from(UNITS_PER_CUBE) * self.octree.size[a])
    }

    fn vertex(&mut self, p: [i32; 3]) -> u32 {
        if let Some(&n) = self.numbers.get(&p) {
            return n;
        }
        let n = self.places.len() as u32;
        self.places.push(self.place(p));
        self.numbers.insert(p, n);
        n
    }

    fn add(&mut self, corners: [[i32; 3]; 4]) {
        let v: Vec<[i64; 3]> =
            (1..4).map(|k| std::array::from_fn(|a| i64::from(corners[k][a]) - i64::from(corners[0][a]))).collect();
        let (a, b, c) = (v[0], v[1], v[2]);
        let volume = a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0])
            + a[2] * (b[0] * c[1] - b[1] * c[0]);
        let mut cell = corners.map(|p| self.vertex(p));
        if volume < 0 {
            cell.swap(0, 1);
        }
        self.cells.push(cell);
    }

    fn cube(&mut self, cube: Cube) {
        let (level, at) = cube;
        let side = UNITS_PER_CUBE >> level;
        let half = side / 2;
        let centre = at.map(|v| v * side + half);
        for axis in 0..3 {
            for sign in [-1, 1] {
                let mut near = at;
                near[axis] += sign;
                let (b, c) = ((axis + 1) % 3, (axis + 2) % 3);
                let corner = |p: i32, q: i32| {
                    let mut v = centre;
                    v[axis] += sign * half;
                    v[b] += p * half;
                    v[c] += q * half;
                    v
                };
                if self.octree.exists((level, near)) {
                    if sign > 0 && !self.octree.divided.contains(&(level, near)) {
                        let beyond = near.map(|v| v * side + half);
                        for (along, p) in [(b, -1), (b, 1), (c, -1), (c, 1)] {
                            let ends = match along == b {
                                true => [corner(p, -1), corner(p, 1)],
                                false => [corner(-1, p), corner(1, p)],
                            };
                            let (mut first, mut second) = (at, near);
                            first[along] += p;
                            second[along] += p;
                            let split = [first, second].iter().any(|&n| self.octree.divided.contains(&(level, n)));
                            if split {
                                let middle = std::array::from_fn(|a| (ends[0][a] + ends[1][a]) / 2);
                                self.add([centre, beyond, ends[0], middle]);
                                self.add([centre, beyond, middle, ends[1]]);
                            } else {
                                self.add([centre, beyond, ends[0], ends[1]]);
                            }
                        }
                    }
                } else if level > 0 && self.octree.exists((level - 1, near.map(|v| v >> 1))) {
                    let wide = 2 * side;
                    let coarse = near.map(|v| (v >> 1) * wide + side);
                    let corners = [corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
                    let middle = (0..4).find(|&i| corners[i][b] == coarse[b] && corners[i][c] == coarse[c]);
                    let Some(m) = middle else { continue };
                    for turn in [1, 3] {
                        let triangle = [corners[m], corners[(m + 2) % 4], corners[(m + turn) % 4]];
                        self.add([centre, triangle[0], triangle[1], triangle[2]]);
                        self.add([coarse, triangle[0], triangle[1], triangle[2]]);
                    }
                }
            }
        }
    }
}
