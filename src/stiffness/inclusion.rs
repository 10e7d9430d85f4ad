//! A region that was found without labels, with its shape open.
//!
//! A map of the modulus tells where a region is, but not to a voxel where it ends; drawn a tenth
//! too small across, a ball came out a quarter too stiff. So the surface between such a region and
//! the first one is moved along its normal by a sum of nine functions of the direction from its
//! middle: size, place and flatness (spherical harmonics up to the second degree), fitted together
//! with the moduli. What is around it gives way less and less. Where the region reaches the surface
//! of the body, it moves along that surface only.

use crate::numerics::filters::gaussian;
use crate::numerics::neighbours::Neighbours;
use crate::types::space::{dot, length};
use crate::types::{Mask, VoxelPoint, WorldPoint};
use rayon::prelude::*;

/// Functions of the direction that describe a shape.
pub(crate) const SHAPE_FUNCTIONS: usize = 9;
/// Prior standard deviation of each offset (radii).
const PRIOR_SD_RADII: f64 = 0.25;
/// Least distance (voxels) from another region, and from the body's surface for a region inside it.
const MIN_CLEARANCE_VOXELS: f64 = 2.0;
/// Largest move of the surface at once, as a part of the reach: a larger one folds the tissue
/// around.
const MAX_MOVE_FRACTION: f64 = 0.4;
/// Smoothing before a region is redrawn (voxels): removes stairs, and moves the surface of a ball
/// of 14 voxels by 0.02.
const SMOOTHING_VOXELS: f64 = 0.7;
/// How normals of a voxel surface are estimated.
struct SurfaceNormals {
    /// Voxel faces whose mean is the normal without the stairs.
    faces: usize,
    /// The same where the edges of a surface shall not be rounded.
    sharp_faces: usize,
    /// Length of a mean of normals below which a surface has an edge, and above which it has none.
    edge_lengths: [f64; 2],
}

const NORMALS: SurfaceNormals = SurfaceNormals { faces: 32, sharp_faces: 9, edge_lengths: [0.85, 0.95] };

fn apart(p: [f64; 3], q: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|a| p[a] - q[a])
}

/// A surface made of faces of voxels.
struct Sheet {
    /// Middles of the faces (mm, RAS).
    places: Vec<[f64; 3]>,
    /// Unit normals, without the stairs.
    normals: Vec<[f64; 3]>,
    near: Neighbours,
}

impl Sheet {
    /// From the middles of faces and their normals, each as long as its face is large, with a mean
    /// over `count` of these for each.
    fn new(faces: &[([f64; 3], [f64; 3])], count: usize) -> Self {
        let places: Vec<[f64; 3]> = faces.iter().map(|f| f.0).collect();
        let near = Neighbours::new(&places);
        let mut out = Self { near, normals: faces.iter().map(|f| f.1).collect(), places };
        let smooth = |p: &[f64; 3]| {
            let n = out.around(*p, count).1;
            let size = length(n).max(1e-9);
            n.map(|v| v / size)
        };
        out.normals = out.places.par_iter().map(smooth).collect();
        out
    }

    /// Distance (mm) of a place, and the mean of the normals nearest to it: as long as they agree.
    fn at(&self, p: [f64; 3]) -> (f64, [f64; 3]) {
        self.around(p, NORMALS.faces)
    }

    fn around(&self, p: [f64; 3], faces: usize) -> (f64, [f64; 3]) {
        let near = self.near.within(p, f64::INFINITY, faces);
        let Some(&first) = near.first() else { return (f64::INFINITY, [0.0; 3]) };
        let part = 1.0 / near.len() as f64;
        let mean = near.iter().fold([0.0; 3], |m, &i| std::array::from_fn(|a| m[a] + part * self.normals[i][a]));
        (length(apart(self.places[first], p)), mean)
    }
}

/// A region beside the first one only.
pub struct Inclusion {
    label: u8,
    middle: [f64; 3],
    /// Of the ball of its volume (mm).
    radius: f64,
    /// How far from its surface things still move (mm).
    reach: f64,
    /// Of its surface from its middle (mm).
    furthest: f64,
    voxel: f64,
    /// Between it and the first region.
    surface: Sheet,
    /// The surface of the body, where the region reaches it.
    skin: Option<Sheet>,
}

impl std::fmt::Debug for Inclusion {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Inclusion").field("label", &self.label).field("middle", &self.middle).finish_non_exhaustive()
    }
}

impl Inclusion {
    /// All regions of `labels` that lie apart from each other.
    pub fn all(labels: &Mask) -> Vec<Self> {
        let most = labels.as_slice().iter().copied().max().unwrap_or(0);
        (2..=most).filter_map(|label| Self::of(labels, label)).collect()
    }

    fn of(labels: &Mask, label: u8) -> Option<Self> {
        let (grid, all) = (labels.grid(), labels.as_slice());
        let shape = grid.shape();
        let world = |p: [f64; 3]| grid.affine().to_world(VoxelPoint(p)).0;
        let stride = [1, shape[0], shape[0] * shape[1]];
        let (mut sum, mut count) = ([0.0; 3], 0usize);
        let (mut surface, mut skin, mut others) = (Vec::new(), Vec::new(), Vec::new());
        for o in (0..grid.len()).filter(|&o| all[o] != 0) {
            let at = grid.voxel(o).map(|v| v as f64);
            let middle = world(at);
            let own = all[o] == label;
            if own {
                (0..3).for_each(|a| sum[a] += middle[a]);
                count += 1;
            }
            for a in 0..3 {
                for up in [false, true] {
                    let end = if up { grid.voxel(o)[a] + 1 == shape[a] } else { grid.voxel(o)[a] == 0 };
                    let beside = match (end, up) {
                        (true, _) => 0,
                        (_, true) => all[o + stride[a]],
                        (_, false) => all[o - stride[a]],
                    };
                    if beside == all[o] {
                        continue;
                    }
                    let mut face = at;
                    face[a] += if up { 0.5 } else { -0.5 };
                    let face = world(face);
                    let out = apart(face, middle);
                    let size = length(out);
                    // As large as the face is: a voxel over its edge along the normal.
                    let face = (face, out.map(|v| v / (size * size)));
                    match beside {
                        0 => skin.push(face),
                        1 if own => surface.push(face),
                        _ if all[o] == 1 && beside == label => {}
                        _ => others.push(face.0),
                    }
                }
            }
        }
        if surface.len() < NORMALS.faces {
            return None;
        }
        let middle = sum.map(|s| s / count as f64);
        let volume = count as f64 * grid.spacing().iter().product::<f64>();
        let radius = (0.75 * volume / std::f64::consts::PI).cbrt();
        let voxel = grid.least_spacing();
        let surface = Sheet::new(&surface, NORMALS.faces);
        let clear = |p: &[f64; 3]| surface.around(*p, 1).0;
        let within = skin.par_iter().map(|f| clear(&f.0)).reduce(|| f64::INFINITY, f64::min);
        let beside = others.par_iter().map(clear).reduce(|| f64::INFINITY, f64::min);
        let open = within <= MIN_CLEARANCE_VOXELS * voxel;
        let reach = radius.min(beside).min(if open { f64::INFINITY } else { within });
        let skin = open.then(|| Sheet::new(&skin, NORMALS.sharp_faces));
        let furthest = surface.places.iter().map(|p| length(apart(*p, middle))).fold(0.0, f64::max);
        (beside > MIN_CLEARANCE_VOXELS * voxel).then_some(Self {
            label,
            middle,
            radius,
            reach,
            furthest,
            voxel,
            surface,
            skin,
        })
    }

    /// Its label.
    pub fn label(&self) -> u8 {
        self.label
    }

    /// One standard deviation of each offset before anything is known (mm).
    pub(crate) fn prior(&self) -> f64 {
        PRIOR_SD_RADII * self.radius
    }

    /// How far each place (mm, RAS) moves (mm) for a unit of each offset.
    pub fn shapes(&self, places: &[[f64; 3]]) -> Vec<[[f64; 3]; SHAPE_FUNCTIONS]> {
        places.par_iter().map(|p| self.shape(*p)).collect()
    }

    fn shape(&self, p: [f64; 3]) -> [[f64; 3]; SHAPE_FUNCTIONS] {
        let d = apart(p, self.middle);
        let from_middle = length(d);
        if from_middle < 1e-9 || from_middle > self.furthest + self.reach {
            return [[0.0; 3]; SHAPE_FUNCTIONS];
        }
        let (distance, normal) = self.surface.at(p);
        if distance >= self.reach {
            return [[0.0; 3]; SHAPE_FUNCTIONS];
        }
        let rest = (1.0 - (distance / self.reach).powi(2)).powi(2);
        let mut step = normal.map(|v| rest * v);
        if let Some(skin) = &self.skin {
            let (depth, out) = skin.at(p);
            let size = length(out);
            let bound = 1.0 - ((depth - self.voxel) / (0.5 * self.reach)).clamp(0.0, 1.0);
            let smooth = ((size - NORMALS.edge_lengths[0]) / (NORMALS.edge_lengths[1] - NORMALS.edge_lengths[0]))
                .clamp(0.0, 1.0);
            let across = bound * dot(step, out) / (size * size).max(1e-9);
            let free = 1.0 - bound * (1.0 - smooth);
            step = std::array::from_fn(|a| free * (step[a] - across * out[a]));
        }
        let [x, y, z] = d.map(|v| v / from_middle);
        let values = [1.0, x, y, z, 2.0 * x * y, 2.0 * y * z, 2.0 * z * x, x * x - y * y, 0.5 * (3.0 * z * z - 1.0)];
        values.map(|v| step.map(|n| v * n))
    }

    /// Draws the region anew with its surface moved by all offsets (mm), as far as it may go at
    /// once; the other voxels of region 1 and of its own take each other's place.
    pub fn draw(&self, labels: &mut Mask, offsets: &[f64; SHAPE_FUNCTIONS]) {
        let grid = *labels.grid();
        let shape = grid.shape();
        let all: f64 = offsets.iter().map(|v| v.abs()).sum();
        let part = (MAX_MOVE_FRACTION * self.reach / all.max(1e-9)).min(1.0);
        let part_of = |is: &dyn Fn(u8) -> bool| {
            let all: Vec<f32> = labels.as_slice().iter().map(|&l| f32::from(u8::from(is(l)))).collect();
            gaussian(&all, shape, [SMOOTHING_VOXELS; 3])
        };
        let (own, both) = (part_of(&|l| l == self.label), part_of(&|l| l == self.label || l == 1));
        // How much of what is there of the two regions is its own.
        let held = |p: [f64; 3]| {
            let q = grid.affine().to_voxel(WorldPoint(p)).0;
            let base: [usize; 3] = std::array::from_fn(|a| (q[a].max(0.0) as usize).min(shape[a].saturating_sub(2)));
            let sums = (0..8usize).fold([0.0, 1e-9], |sums, c| {
                let up = [c & 1, c >> 1 & 1, c >> 2];
                let weight = (0..3).fold(1.0, |w, a| {
                    let t = (q[a] - base[a] as f64).clamp(0.0, 1.0);
                    w * if up[a] == 1 { t } else { 1.0 - t }
                });
                let [i, j, k] = std::array::from_fn(|a| (base[a] + up[a]).min(shape[a] - 1));
                let o = grid.index(i, j, k);
                [sums[0] + weight * f64::from(own[o]), sums[1] + weight * f64::from(both[o])]
            });
            sums[0] / sums[1]
        };
        let drawn = |o: usize| {
            let was = labels.as_slice()[o];
            if was != 1 && was != self.label {
                return was;
            }
            let p = grid.affine().to_world(VoxelPoint(grid.voxel(o).map(|v| v as f64))).0;
            let u = self.shape(p);
            let from =
                std::array::from_fn(|a| p[a] - part * (0..SHAPE_FUNCTIONS).map(|k| offsets[k] * u[k][a]).sum::<f64>());
            if held(from) > 0.5 { self.label } else { 1 }
        };
        let drawn: Vec<u8> = (0..grid.len()).into_par_iter().map(drawn).collect();
        if drawn.contains(&self.label)
            && let Ok(mask) = Mask::from_vec(grid, drawn)
        {
            *labels = mask;
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::types::{Affine, Grid};

    const BALL: f64 = 9.0;

    /// A ball in a block of 40 voxels of half a millimetre, its middle `at` (voxels).
    fn ball(at: [f64; 3], radius: f64) -> Mask {
        let grid = Grid::new([40; 3], Affine::scaled([0.5; 3], [0.0; 3]).unwrap()).unwrap();
        Mask::from_voxels(grid, |o, _| {
            let v = grid.voxel(o);
            let from = length(apart(v.map(|v| v as f64), at));
            if v.iter().any(|v| !(2..38).contains(v)) { 0 } else { u8::from(from < radius) + 1 }
        })
    }

    fn differ(a: &Mask, b: &Mask) -> f64 {
        let apart = a.as_slice().iter().zip(b.as_slice()).filter(|(a, b)| a != b).count();
        apart as f64 / b.as_slice().iter().filter(|v| **v == 2).count() as f64
    }

    #[test]
    fn offsets_draw_a_ball_larger_and_elsewhere() {
        let at = [19.2, 20.4, 19.7];
        let before = ball(at, BALL);
        let found = Inclusion::all(&before);
        assert_eq!(found.len(), 1);
        let mut offsets = [0.0; SHAPE_FUNCTIONS];
        // A voxel larger, and a voxel and a half along x.
        (offsets[0], offsets[1]) = (0.5, 0.75);
        let mut drawn = before.clone();
        found[0].draw(&mut drawn, &offsets);
        let wanted = ball([at[0] + 1.5, at[1], at[2]], BALL + 1.0);
        assert!(differ(&before, &wanted) > 0.25, "{}", differ(&before, &wanted));
        // A surface through 1,250 voxels of 4,200 that is off by 0.1 voxel changes 3 % of them.
        assert!(differ(&drawn, &wanted) < 0.05, "{}", differ(&drawn, &wanted));
        let mut same = before.clone();
        found[0].draw(&mut same, &[0.0; SHAPE_FUNCTIONS]);
        assert!(differ(&same, &before) < 0.03, "{}", differ(&same, &before));
    }

    #[test]
    fn flat_voxels_do_not_turn_normals() {
        let grid = Grid::new([60, 60, 20], Affine::scaled([0.5, 0.5, 1.5], [0.0; 3]).unwrap()).unwrap();
        let map = Mask::from_voxels(grid, |o, _| {
            let p = grid.affine().to_world(VoxelPoint(grid.voxel(o).map(|v| v as f64))).0;
            u8::from(length(apart(p, [15.0; 3])) < 9.0) + 1
        });
        let found = Inclusion::all(&map);
        for d in [[0.6, 0.0, 0.8], [0.8, 0.0, 0.6], [0.36, 0.48, 0.8], [0.64, 0.48, 0.6]] {
            let n = found[0].shapes(&[std::array::from_fn(|a| 15.0 + 9.0 * d[a])])[0][0];
            let across = dot(n, d) / length(n);
            assert!(across > 0.98, "{d:?} {n:?} {across}");
        }
    }

    #[test]
    fn a_unit_moves_the_surface_by_a_unit_and_the_rest_less() {
        let found = Inclusion::all(&ball([20.0; 3], BALL));
        let shape = |p: [f64; 3], k: usize| found[0].shapes(&[p])[0][k];
        let size = |r: f64| shape([10.0 + r, 10.0, 10.0], 0)[0];
        assert!((size(0.5 * BALL) - 1.0).abs() < 0.05, "{}", size(0.5 * BALL));
        assert!(size(0.2).abs() < 0.1 && size(8.9).abs() < 0.1, "{} {}", size(0.2), size(8.9));
        // Flatness along z takes from x half of what it gives z.
        let z = shape([10.0, 10.0, 10.0 + 0.5 * BALL], 8)[2];
        let x = shape([10.0 + 0.5 * BALL, 10.0, 10.0], 8)[0];
        assert!((z - 1.0).abs() < 0.05 && (x + 0.5).abs() < 0.05, "{z} {x}");
    }

    /// A disc of a radius (voxels) through a plate of 12 voxels of half a millimetre, its axis
    /// `at`.
    fn disc(at: [f64; 2], radius: f64) -> Mask {
        let grid = Grid::new([60, 60, 16], Affine::scaled([0.5; 3], [0.0; 3]).unwrap()).unwrap();
        Mask::from_voxels(grid, |o, _| {
            let v = grid.voxel(o).map(|v| v as f64);
            let from = (v[0] - at[0]).hypot(v[1] - at[1]);
            let inside = v.iter().zip([57.0, 57.0, 13.0]).all(|(v, high)| (2.0..=high).contains(v));
            if inside { u8::from(from < radius) + 1 } else { 0 }
        })
    }

    #[test]
    fn offsets_draw_a_disc_through_a_plate_larger_and_elsewhere() {
        let before = disc([29.3, 30.6], 14.0);
        let found = Inclusion::all(&before);
        assert_eq!(found.len(), 1);
        let mut offsets = [0.0; SHAPE_FUNCTIONS];
        (offsets[0], offsets[2]) = (0.5, -0.75);
        let mut drawn = before.clone();
        found[0].draw(&mut drawn, &offsets);
        let wanted = disc([29.3, 29.1], 15.0);
        assert!(differ(&before, &wanted) > 0.14, "{}", differ(&before, &wanted));
        assert!(differ(&drawn, &wanted) < 0.03, "{}", differ(&drawn, &wanted));
    }

    #[test]
    fn the_surface_of_the_body_stays_where_it_is() {
        let found = Inclusion::all(&disc([29.3, 30.6], 14.0));
        for (x, y) in [(7.6, 15.3), (10.0, 10.0), (14.6, 8.3), (20.0, 12.0)] {
            for z in [0.75, 6.75] {
                let moved = found[0].shapes(&[[x, y, z]])[0];
                assert!(moved.iter().all(|u| u[2].abs() < 1e-9), "{moved:?}");
            }
        }
        // At an edge of the body nothing moves: a disc that comes near to one.
        let found = Inclusion::all(&disc([29.3, 17.0], 14.0));
        let moved = found[0].shapes(&[[14.6, 0.75, 0.75], [14.6, 0.75, 3.0]]);
        assert!(moved[0].iter().flatten().all(|u| u.abs() < 0.05), "{:?}", moved[0]);
        assert!(moved[1].iter().all(|u| u[1].abs() < 0.02), "{:?}", moved[1]);
    }
}
