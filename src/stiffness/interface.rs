//! Flat interfaces between labels: like a flat face of the body, one along the voxels' axes lies
//! anywhere within a voxel.
//!
//! Of a curved or slanted interface the voxels' errors go both ways and cancel; of a flat one they
//! are all alike. A layer is that much thicker and its neighbour thinner, which strain answers for:
//! between 20 kPa above and below a layer of 1 kPa, a third of a voxel of 10 made 23 and 18 of
//! the 20. So it is with the walls of a hole in the body, or of a notch: where they were taken for
//! known, a body with a channel came out 5 to 8 % too soft.

use crate::types::{Grid, Mask, VoxelPoint, WorldPoint};
use std::collections::BTreeMap;

/// Which part of the border between two regions is a flat interface.
struct PlaneTest {
    /// Least part of the border's voxel faces in one plane.
    min_fraction: f64,
    /// Faces there over those in the adjacent planes: about one for a ball, 2.4 for a cylinder
    /// along it.
    min_ratio: usize,
    /// Fewest voxel faces in the plane.
    min_faces: usize,
}

const PLANE: PlaneTest = PlaneTest { min_fraction: 0.04, min_ratio: 4, min_faces: 16 };

/// Most borders or planes between regions that are examined, largest first: each takes a solution.
pub(super) const MAX_EXAMINED: usize = 12;

/// A part of the border between two regions, or between one and a hole (label 0), that lies in one
/// plane between voxels.
#[derive(Debug, Clone, PartialEq)]
pub struct Interface {
    labels: [u8; 2],
    /// The voxel axis across it.
    axis: usize,
    /// Where it lies along that axis (voxels).
    plane: f64,
    /// From there to what lies next along the axis, downwards and upwards (voxels): another
    /// interface or the body's end.
    reach: [f64; 2],
    /// First and last place along the other two axes, in order (voxels).
    sides: [[f64; 2]; 2],
}

/// What was met in one plane.
struct Met {
    count: usize,
    sides: [[f64; 2]; 2],
}

impl Interface {
    /// The largest flat ones of a label map.
    pub fn all(labels: &Mask) -> Vec<Self> {
        let (grid, values) = (labels.grid(), labels.as_slice());
        let shape = grid.shape();
        let stride = [1, shape[0], shape[0] * shape[1]];
        let mut met: BTreeMap<([u8; 2], usize, usize), Met> = BTreeMap::new();
        let mut whole: BTreeMap<[u8; 2], usize> = BTreeMap::new();
        let mut ends = [[f64::INFINITY, f64::NEG_INFINITY]; 3];
        // What lies between tissue along an axis, rather than around it.
        let within: [Vec<bool>; 3] = std::array::from_fn(|axis| between(values, shape, axis));
        for o in (0..values.len()).filter(|&o| values[o] > 0 || within.iter().any(|w| w[o])) {
            let v = grid.voxel(o);
            for axis in 0..3 {
                if values[o] > 0 {
                    let end = &mut ends[axis];
                    (end[0], end[1]) = (end[0].min(v[axis] as f64 - 0.5), end[1].max(v[axis] as f64 + 0.5));
                }
                let tissue = |o: usize| values[o] > 0 || within[axis][o];
                if v[axis] + 1 == shape[axis] || !tissue(o) || !tissue(o + stride[axis]) {
                    continue;
                }
                let next = values[o + stride[axis]];
                if next == values[o] {
                    continue;
                }
                let pair = [values[o].min(next), values[o].max(next)];
                let sides = others(axis).map(|a| [v[a] as f64 - 0.5, v[a] as f64 + 0.5]);
                *whole.entry(pair).or_default() += 1;
                let met = met.entry((pair, axis, v[axis])).or_insert(Met { count: 0, sides });
                met.count += 1;
                for (all, one) in met.sides.iter_mut().zip(sides) {
                    *all = [all[0].min(one[0]), all[1].max(one[1])];
                }
            }
        }
        let in_plane = |pair, axis, at| met.get(&(pair, axis, at)).map_or(0, |m| m.count);
        let flat = |&(pair, axis, at): &([u8; 2], usize, usize), m: &Met| {
            let beside =
                in_plane(pair, axis, at + 1).max(at.checked_sub(1).map_or(0, |below| in_plane(pair, axis, below)));
            m.count >= PLANE.min_faces
                && m.count as f64 >= PLANE.min_fraction * whole[&pair] as f64
                && m.count >= PLANE.min_ratio * beside
        };
        let mut kept: Vec<_> = met.iter().filter(|(k, m)| flat(k, m)).collect();
        kept.sort_by_key(|k| std::cmp::Reverse(k.1.count));
        kept.truncate(MAX_EXAMINED);
        let one = |((labels, axis, at), met): &(&([u8; 2], usize, usize), &Met)| {
            let plane = *at as f64 + 0.5;
            let same = |k: &([u8; 2], usize, usize), m: &Met| {
                k.1 == *axis && m.sides.iter().zip(&met.sides).all(|(a, b)| a[0] < b[1] && b[0] < a[1])
            };
            let mut reach = [plane - ends[*axis][0], ends[*axis][1] - plane];
            for apart in kept.iter().filter(|(k, m)| same(k, m)).map(|(k, _)| k.2 as f64 + 0.5 - plane) {
                let side = usize::from(apart > 0.0);
                if apart != 0.0 {
                    reach[side] = reach[side].min(apart.abs());
                }
            }
            Self { labels: *labels, axis: *axis, plane, reach, sides: met.sides }
        };
        kept.iter().map(one).collect()
    }

    /// Those of the walls of holes alone.
    pub fn walls(labels: &Mask) -> Vec<Self> {
        Self::all(&Mask::from_voxels(*labels.grid(), |o, _| u8::from(labels.as_slice()[o] > 0)))
    }

    /// Whether it is the wall of a hole.
    pub(crate) fn is_wall(&self) -> bool {
        self.labels[0] == 0
    }

    /// `1|2 across axis 2 at 34.5`: labels, voxel axis, voxels.
    pub fn name(&self) -> String {
        format!("{}|{} across axis {} at {}", self.labels[0], self.labels[1], self.axis, self.plane)
    }

    /// Where `p` (mm, RAS) comes to lie when the interface moves up its axis by `offset` voxels:
    /// what is between it and what lies next moves less and less.
    pub fn moved(&self, p: [f64; 3], grid: &Grid, offset: f64) -> [f64; 3] {
        let mut q = grid.affine().to_voxel(WorldPoint(p)).0;
        let off = q[self.axis] - self.plane;
        let mut part = fade(off.abs() / self.reach[usize::from(off > 0.0)]);
        let aside = self.reach[0].min(self.reach[1]);
        for (a, [first, last]) in others(self.axis).into_iter().zip(self.sides) {
            part *= fade((first - q[a]).max(q[a] - last).max(0.0) / aside);
        }
        q[self.axis] += offset * part;
        grid.affine().to_world(VoxelPoint(q)).0
    }
}

/// Whether a voxel without a label has tissue on either side along an axis.
fn between(values: &[u8], shape: [usize; 3], axis: usize) -> Vec<bool> {
    let stride: usize = shape[..axis].iter().product();
    let mut out = vec![false; values.len()];
    for start in (0..values.len()).filter(|o| (o / stride).is_multiple_of(shape[axis])) {
        let tissue = |k: &usize| values[start + k * stride] > 0;
        let ends = (0..shape[axis]).find(&tissue).zip((0..shape[axis]).rev().find(&tissue));
        if let Some((first, last)) = ends {
            (first..last).filter(|k| !tissue(k)).for_each(|k| out[start + k * stride] = true);
        }
    }
    out
}

/// The other two axes, in order.
fn others(axis: usize) -> [usize; 2] {
    [usize::from(axis == 0), 2 - usize::from(axis == 2)]
}

/// From 1 at 0 to 0 at 1, smoothly.
pub(super) fn fade(t: f64) -> f64 {
    let t = t.min(1.0);
    (1.0 - t).powi(2) * (1.0 + 2.0 * t)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::types::Affine;

    fn grid(n: usize) -> Grid {
        let affine = Affine::scaled([1.0, 2.0, 0.5], [3.0, -4.0, 5.0]).unwrap();
        Grid::new([n; 3], affine).unwrap()
    }

    fn map(label: impl Fn([usize; 3]) -> u8 + Sync) -> Mask {
        let g = grid(30);
        Mask::from_voxels(g, |o, _| if g.voxel(o).iter().all(|v| (2..28).contains(v)) { label(g.voxel(o)) } else { 0 })
    }

    #[test]
    fn layers_have_one_each_and_reach_to_the_next() {
        let found = Interface::all(&map(|v| {
            if v[2] < 10 {
                1
            } else if v[2] < 14 {
                2
            } else {
                3
            }
        }));
        assert_eq!(found.len(), 2);
        let of = |labels| found.iter().find(|i| i.labels == labels).unwrap();
        let (low, high) = (of([1, 2]), of([2, 3]));
        assert_eq!((low.axis, low.plane, low.reach), (2, 9.5, [8.0, 4.0]));
        assert_eq!((high.axis, high.plane, high.reach), (2, 13.5, [4.0, 14.0]));
        assert_eq!(low.sides, [[1.5, 27.5]; 2]);
        let at = |z: f64| grid(30).affine().to_world(VoxelPoint([15.0, 15.0, z])).0;
        for (z, by) in [(9.5, 0.3), (13.5, 0.0), (1.5, 0.0), (11.5, 0.15), (20.0, 0.0)] {
            let (from, to) = (at(z), low.moved(at(z), &grid(30), 0.3));
            assert!((to[2] - from[2] - 0.5 * by).abs() < 1e-12 && to[..2] == from[..2], "{z}: {from:?} {to:?}");
        }
    }

    #[test]
    fn walls_of_holes_count_and_the_outside_does_not() {
        let channel = Interface::all(&map(|v| u8::from(!(v[0] >= 9 && v[0] < 15 && v[1] >= 11 && v[1] < 20))));
        let mut walls: Vec<_> = channel.iter().map(|i| (i.labels, i.axis, i.plane)).collect();
        walls.sort_by(|a, b| a.partial_cmp(b).unwrap());
        let expected = [([0, 1], 0, 8.5), ([0, 1], 0, 14.5), ([0, 1], 1, 10.5), ([0, 1], 1, 19.5)];
        assert_eq!(walls, expected);
        // The reach is to the wall across, or to the body's end.
        assert!(channel.iter().filter(|i| i.axis == 0).all(|i| i.reach.contains(&6.0)), "{channel:?}");
        // A step at the outside is no hole.
        assert_eq!(Interface::all(&map(|v| u8::from(v[0] < 12 || v[2] < 10))), []);
    }

    #[test]
    fn a_box_has_six_and_what_is_round_none() {
        let cube = Interface::all(&map(|v| 1 + u8::from(v.iter().all(|v| (10..20).contains(v)))));
        assert_eq!(cube.len(), 6);
        assert!(cube.iter().all(|i| i.sides == [[9.5, 19.5]; 2] && i.reach.contains(&10.0)));
        for radius in [3.0, 5.0, 9.0] {
            let within = |v: [usize; 3]| v.iter().map(|v| (*v as f64 - 14.7).powi(2)).sum::<f64>() < radius * radius;
            let g = Grid::new([30; 3], Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap();
            let ball = Mask::from_voxels(g, |o, _| 1 + u8::from(within(g.voxel(o))));
            assert_eq!(Interface::all(&ball), [], "{radius}");
            let across =
                |v: [usize; 3]| v[..2].iter().map(|v| (*v as f64 - 14.7).powi(2)).sum::<f64>() < radius * radius;
            let rod = Mask::from_voxels(g, |o, _| 1 + u8::from(across(g.voxel(o))));
            assert_eq!(Interface::all(&rod), [], "{radius}");
            let pin = Mask::from_voxels(g, |o, _| 1 + u8::from(across(g.voxel(o)) && g.voxel(o)[2] < 20));
            let found = Interface::all(&pin);
            assert!(found.len() == 1 && found[0].axis == 2 && found[0].plane == 19.5, "{radius}: {found:?}");
        }
        assert_eq!(Interface::all(&map(|_| 7)), []);
    }
}
