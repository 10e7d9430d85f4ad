//! A region that was found without labels, with its shape open.
//!
//! A map of the modulus tells where a region is, but not to a voxel where it ends; drawn a tenth too small across, a ball came
//! out a quarter too stiff. So the surface of a region that lies inside another is moved outwards by a sum of nine functions of
//! the direction from its middle: size, place and flatness (spherical harmonics up to the second degree), fitted together
//! with the moduli. What is around it gives way less and less.

use crate::numerics::filters::gaussian;
use crate::numerics::neighbours::Neighbours;
use crate::stiffness::geometry::length;
use crate::types::{Mask, VoxelPoint, WorldPoint};

/// Functions of the direction.
pub const SHAPES: usize = 9;
/// One standard deviation of each offset before anything is known (parts of the radius).
const PRIOR: f64 = 0.25;
/// Least distance (voxels) of a region from the surface of the body.
const CLEAR: f64 = 2.0;
/// Part of the reach that all offsets together may move the surface by at once: beyond, what is around it would fold.
const ONCE: f64 = 0.4;
/// Smoothing before a region is drawn anew (voxels): takes out stairs, and moves the surface of a ball of 14 voxels by 0.02.
const SMOOTHED: f64 = 0.7;

fn apart(p: [f64; 3], q: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|a| p[a] - q[a])
}

/// A region inside the first one.
pub struct Inclusion {
    label: u8,
    middle: [f64; 3],
    /// Of the ball of its volume (mm).
    radius: f64,
    /// How far from its surface things still move (mm).
    reach: f64,
    /// Of its surface from its middle (mm).
    furthest: f64,
    surface: Vec<[f64; 3]>,
    near: Neighbours,
}

impl std::fmt::Debug for Inclusion {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Inclusion").field("label", &self.label).field("middle", &self.middle).finish_non_exhaustive()
    }
}

impl Inclusion {
    /// All regions of `labels` that lie inside region 1, apart from the surface of the body and from each other.
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
        let (mut surface, mut others) = (Vec::new(), Vec::new());
        for o in (0..grid.len()).filter(|&o| all[o] != 0) {
            let at = grid.voxel(o);
            let own = all[o] == label;
            if own {
                let p = world(at.map(|v| v as f64));
                (0..3).for_each(|a| sum[a] += p[a]);
                count += 1;
            }
            for a in 0..3 {
                for up in [false, true] {
                    let outside = if up { at[a] + 1 == shape[a] } else { at[a] == 0 };
                    let beside = match (outside, up) {
                        (true, _) => 0,
                        (_, true) => all[o + stride[a]],
                        (_, false) => all[o - stride[a]],
                    };
                    let mut face = at.map(|v| v as f64);
                    face[a] += if up { 0.5 } else { -0.5 };
                    if own && beside != label {
                        surface.push(world(face));
                    }
                    if beside == 0 || (all[o] != label && all[o] != 1 && beside != all[o]) {
                        others.push(world(face));
                    }
                }
            }
        }
        if count == 0 {
            return None;
        }
        let middle = sum.map(|s| s / count as f64);
        let volume = count as f64 * grid.spacing().iter().product::<f64>();
        let radius = (0.75 * volume / std::f64::consts::PI).cbrt();
        let near = Neighbours::new(&surface);
        let furthest = surface.iter().map(|p| length(apart(*p, middle))).fold(0.0, f64::max);
        let mut out = Self { label, middle, radius, reach: f64::INFINITY, furthest, surface, near };
        let clear = others.iter().map(|p| out.distance(*p)).fold(f64::INFINITY, f64::min);
        out.reach = clear.min(radius);
        (clear > CLEAR * grid.least_spacing()).then_some(out)
    }

    /// One standard deviation of each offset before anything is known (mm).
    pub fn prior(&self) -> f64 {
        PRIOR * self.radius
    }

    /// Distance from its surface (mm), told from the middles of the faces of its voxels.
    fn distance(&self, p: [f64; 3]) -> f64 {
        let nearest = self.near.within(p, f64::INFINITY, 1);
        nearest.first().map_or(f64::INFINITY, |&i| length(apart(self.surface[i], p)))
    }

    /// How far `p` (mm, RAS) moves (mm) for a unit of each offset.
    fn shapes(&self, p: [f64; 3]) -> [[f64; 3]; SHAPES] {
        let d = apart(p, self.middle);
        let from_middle = length(d);
        if from_middle < 1e-9 || from_middle > self.furthest + self.reach {
            return [[0.0; 3]; SHAPES];
        }
        let rest = (1.0 - (self.distance(p) / self.reach).powi(2)).max(0.0).powi(2);
        let [x, y, z] = d.map(|v| v / from_middle);
        let values = [1.0, x, y, z, 2.0 * x * y, 2.0 * y * z, 2.0 * z * x, x * x - y * y, 0.5 * (3.0 * z * z - 1.0)];
        values.map(|v| [x, y, z].map(|n| v * rest * n))
    }

    /// Where `p` (mm, RAS) comes to lie when one offset is `by` (mm).
    pub fn moved(&self, p: [f64; 3], shape: usize, by: f64) -> [f64; 3] {
        let u = self.shapes(p)[shape];
        std::array::from_fn(|a| p[a] + by * u[a])
    }

    /// Draws the region anew with its surface moved by all offsets (mm), as far as it may go at once; the other voxels of region 1 and of its own take each
    /// other's place.
    pub fn draw(&self, labels: &mut Mask, offsets: &[f64; SHAPES]) {
        let grid = *labels.grid();
        let shape = grid.shape();
        let all: f64 = offsets.iter().map(|v| v.abs()).sum();
        let part = (ONCE * self.reach / all.max(1e-9)).min(1.0);
        let own: Vec<f32> = labels.as_slice().iter().map(|&l| f32::from(u8::from(l == self.label))).collect();
        let smooth = gaussian(&own, shape, [SMOOTHED; 3]);
        let read = |p: [f64; 3]| {
            let q = grid.affine().to_voxel(WorldPoint(p)).0;
            let base: [usize; 3] = std::array::from_fn(|a| (q[a].max(0.0) as usize).min(shape[a].saturating_sub(2)));
            (0..8usize).fold(0.0, |sum, c| {
                let up = [c & 1, c >> 1 & 1, c >> 2];
                let weight = (0..3).fold(1.0, |w, a| {
                    let t = (q[a] - base[a] as f64).clamp(0.0, 1.0);
                    w * if up[a] == 1 { t } else { 1.0 - t }
                });
                let [i, j, k] = std::array::from_fn(|a| (base[a] + up[a]).min(shape[a] - 1));
                sum + weight * f64::from(smooth[grid.index(i, j, k)])
            })
        };
        let drawn: Vec<u8> = (0..grid.len())
            .map(|o| {
                let was = labels.as_slice()[o];
                if was != 1 && was != self.label {
                    return was;
                }
                let p = grid.affine().to_world(VoxelPoint(grid.voxel(o).map(|v| v as f64))).0;
                let u = self.shapes(p);
                let from =
                    std::array::from_fn(|a| p[a] - part * (0..SHAPES).map(|k| offsets[k] * u[k][a]).sum::<f64>());
                if read(from) > 0.5 { self.label } else { 1 }
            })
            .collect();
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
        let mut offsets = [0.0; SHAPES];
        // A voxel larger, and a voxel and a half along x.
        (offsets[0], offsets[1]) = (0.5, 0.75);
        let mut drawn = before.clone();
        found[0].draw(&mut drawn, &offsets);
        let wanted = ball([at[0] + 1.5, at[1], at[2]], BALL + 1.0);
        assert!(differ(&before, &wanted) > 0.25, "{}", differ(&before, &wanted));
        // A surface through 1,250 voxels of 4,200 that is off by 0.1 voxel changes 3 % of them.
        assert!(differ(&drawn, &wanted) < 0.05, "{}", differ(&drawn, &wanted));
        let mut same = before.clone();
        found[0].draw(&mut same, &[0.0; SHAPES]);
        assert!(differ(&same, &before) < 0.03, "{}", differ(&same, &before));
    }

    #[test]
    fn a_unit_moves_the_surface_by_a_unit_and_the_rest_less() {
        let found = Inclusion::all(&ball([20.0; 3], BALL));
        let at = |r: f64| [10.0 + r, 10.0, 10.0];
        let moved = |r: f64| found[0].moved(at(r), 0, 0.1)[0] - at(r)[0];
        assert!((moved(0.5 * BALL) - 0.1).abs() < 0.005, "{}", moved(0.5 * BALL));
        assert!(moved(0.2) < 0.01 && moved(8.9) < 0.01, "{} {}", moved(0.2), moved(8.9));
        // Flatness along z takes from x half of what it gives z.
        let z = found[0].moved([10.0, 10.0, 10.0 + 0.5 * BALL], 8, 0.1)[2] - 10.0 - 0.5 * BALL;
        let x = found[0].moved(at(0.5 * BALL), 8, 0.1)[0] - at(0.5 * BALL)[0];
        assert!((z - 0.1).abs() < 0.005 && (x + 0.05).abs() < 0.005, "{z} {x}");
    }

    #[test]
    fn a_region_at_the_surface_of_the_body_keeps_its_shape() {
        assert!(Inclusion::all(&ball([8.0, 20.0, 20.0], BALL)).is_empty());
    }
}
