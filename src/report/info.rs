//! What `palpate info` says about a file.

use crate::report::scale::{short, thousands};
use crate::report::statistics::{quantile, sample};
use crate::types::{DenseField, Grid, Volume, WorldPoint};
use serde_json::{Map, Value, json};

/// A file's name, kind, facts in order, and the commands that take it.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Facts {
    name: String,
    kind: String,
    /// Key, words (none where empty), value.
    facts: Vec<(String, String, Value)>,
    does: Vec<String>,
}

/// Labels listed at most.
const MAX_LABELS_SHOWN: usize = 12;

/// Whether all values are whole numbers from 0 to 255, and few of them.
pub(crate) fn looks_like_labels(volume: &Volume) -> bool {
    let mut seen = [false; 256];
    for &v in volume.as_slice() {
        if !(0.0..=255.0).contains(&v) || v.fract() != 0.0 {
            return false;
        }
        seen[v as usize] = true;
    }
    seen.iter().filter(|s| **s).count() <= 32
}

/// The world direction that each voxel axis runs along most (R or L, A or P, S or I), and how far
/// the axes are off the world's at most (degrees).
///
/// ```
/// use palpate::report::info::orientation;
/// use palpate::{Affine, Grid};
/// let grid = Grid::new(
///     [8; 3],
///     Affine::new([[-1.0, 0.0, 0.0, 7.0], [0.0, 0.0, 2.0, 0.0], [0.0, 1.0, 0.0, 0.0]])?,
/// )?;
/// assert_eq!(orientation(&grid), ("LSA".to_string(), 0.0));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn orientation(grid: &Grid) -> (String, f64) {
    const ENDS: [[char; 2]; 3] = [['L', 'R'], ['P', 'A'], ['I', 'S']];
    let (linear, size) = (grid.affine().linear(), grid.spacing());
    let mut off: f64 = 0.0;
    let code = (0..3).map(|axis| {
        let along = |w: usize| linear[w][axis] / size[axis];
        let world = (1..3).fold(0, |best, w| if along(w).abs() > along(best).abs() + 1e-9 { w } else { best });
        off = off.max(along(world).abs().min(1.0).acos().to_degrees());
        ENDS[world][usize::from(along(world) > 0.0)]
    });
    (code.collect(), off)
}

impl Facts {
    /// About the file called `name`.
    pub fn new(name: &str) -> Self {
        Self { name: name.into(), ..Self::default() }
    }

    /// What it is.
    pub fn is(&mut self, kind: &str) {
        self.kind = kind.into();
    }

    /// One fact; without words it is in the JSON alone.
    pub fn add(&mut self, key: &str, words: String, value: Value) {
        self.facts.push((key.into(), words, value));
    }

    /// A command that takes it.
    pub fn does(&mut self, command: &str) {
        self.does.push(command.into());
    }

    /// Shape, spacing, orientation, place.
    pub fn grid(&mut self, grid: &Grid, placed: &str) {
        let s = grid.shape();
        let size = grid.spacing().map(|v| (v * 1e4).round() / 1e4);
        self.add("shape", s.map(|n| n.to_string()).join(" x "), json!(s));
        let voxel = grid.spacing().iter().product::<f64>();
        let words = format!("{} mm, {} mm^3 a voxel", size.map(short).join(" x "), short((voxel * 1e4).round() / 1e4));
        self.add("spacing", words, json!(size));
        let extent: [f64; 3] = std::array::from_fn(|a| s[a] as f64 * size[a]);
        self.add(
            "extent",
            format!("{} mm", extent.map(|v| short((v * 10.0).round() / 10.0)).join(" x ")),
            json!(extent),
        );
        let (code, off) = orientation(grid);
        let oblique = if off > 0.1 { format!(", {off:.1} degrees oblique") } else { String::new() };
        self.add("orientation", format!("{code}{oblique} ({placed})"), json!(code));
        let middle = grid.affine().to_world(crate::types::VoxelPoint(s.map(|n| (n - 1) as f64 / 2.0))).0;
        let words = middle.map(|v| short((v * 10.0).round() / 10.0)).join(", ");
        self.add("centre", format!("{words} mm (RAS)"), json!(middle));
        self.add("affine_ras", String::new(), json!(grid.affine().rows()));
    }

    /// Range of the values; voxels and volume of each label.
    pub fn values(&mut self, volume: &Volume) {
        let values = volume.as_slice();
        let (low, high) = values
            .iter()
            .filter(|v| v.is_finite())
            .fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), &v| (l.min(v), h.max(v)));
        let picked = sample(values.len(), None);
        let median = quantile(picked.iter().map(|&o| f64::from(values[o])), 0.5);
        let bad = values.iter().filter(|v| !v.is_finite()).count();
        if bad < values.len() {
            let words = format!("{} to {}, median {}", short(low.into()), short(high.into()), short(median));
            self.add("values", words, json!([low, high]));
        }
        if bad > 0 {
            self.add("not finite", format!("{} voxels, which are not used", thousands(bad)), json!(bad));
        }
        if bad < values.len() && low == high {
            self.add("note", "every voxel has the same value: nothing can be found in it".into(), Value::Null);
        } else if looks_like_labels(volume) {
            let mut counts = [0usize; 256];
            values.iter().for_each(|&v| counts[v as usize] += 1);
            let voxel = volume.grid().spacing().iter().product::<f64>();
            let there: Vec<usize> = (1..256).filter(|&l| counts[l] > 0).collect();
            for &l in there.iter().take(MAX_LABELS_SHOWN) {
                let ml = counts[l] as f64 * voxel / 1000.0;
                let words = format!("{} voxels, {} ml", thousands(counts[l]), short((ml * 100.0).round() / 100.0));
                self.add(&format!("label {l}"), words, json!(counts[l]));
            }
            if there.len() > MAX_LABELS_SHOWN {
                self.add("labels", format!("{} in all", there.len()), json!(there.len()));
            }
        }
    }

    /// Range of the lengths (mm).
    pub fn field(&mut self, field: &DenseField) {
        let lengths: Vec<f64> = sample(field.grid().len(), None)
            .into_iter()
            .map(|o| field.at(o).iter().map(|v| f64::from(v * v)).sum::<f64>().sqrt())
            .collect();
        let at = |q| quantile(lengths.iter().copied(), q);
        let [middle, most] = [at(0.5), at(1.0)].map(|v| (v * 1000.0).round() / 1000.0);
        let words = format!("median {} mm, largest {} mm (read as LPS mm)", short(middle), short(most));
        self.add("length", words, json!({ "median_mm": middle, "largest_mm": most }));
    }

    /// How many points and the box around them.
    pub fn bounds(&mut self, points: &[WorldPoint]) {
        self.add("points", thousands(points.len()), json!(points.len()));
        let range = |a: usize| {
            let all = || points.iter().map(|p| p.0[a]);
            [all().fold(f64::INFINITY, f64::min), all().fold(f64::NEG_INFINITY, f64::max)]
        };
        if !points.is_empty() {
            let ranges = [0, 1, 2].map(range);
            let words = ranges.map(|[l, h]| format!("{} to {}", short(l), short(h))).join(", ");
            self.add("box", format!("{words} mm (RAS)"), json!(ranges));
        }
    }

    /// As text, a line a fact.
    pub fn text(&self) -> String {
        let mut out = format!("{}: {}\n", self.name, self.kind);
        for (key, words, _) in self.facts.iter().filter(|f| !f.1.is_empty()) {
            out.push_str(&format!("  {key:<12} {words}\n"));
        }
        for (i, command) in self.does.iter().enumerate() {
            out.push_str(&format!("  {:<12} {command}\n", if i == 0 { "use" } else { "" }));
        }
        out
    }

    /// As JSON.
    pub fn json(&self) -> Value {
        let mut out = Map::from_iter([("file".into(), json!(self.name)), ("kind".into(), json!(self.kind))]);
        for (key, words, value) in &self.facts {
            let value = if value.is_null() { json!(words) } else { value.clone() };
            out.insert(key.replace(' ', "_"), value);
        }
        out.insert("use".into(), json!(self.does));
        Value::Object(out)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::types::Affine;

    #[test]
    fn axes_are_named_by_where_they_run() {
        let grid = |rows| Grid::new([4, 5, 6], Affine::new(rows).unwrap()).unwrap();
        let plain = grid([[2.0, 0.0, 0.0, 0.0], [0.0, 2.0, 0.0, 0.0], [0.0, 0.0, 3.0, 0.0]]);
        assert_eq!(orientation(&plain), ("RAS".into(), 0.0));
        // x of the voxels runs to the head, y to the left, z to the back.
        let sagittal = grid([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -2.0, 0.0], [3.0, 0.0, 0.0, 0.0]]);
        assert_eq!(orientation(&sagittal).0, "SLP");
        let (s, c) = 20f64.to_radians().sin_cos();
        let (code, off) = orientation(&grid([[c, -s, 0.0, 0.0], [s, c, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]));
        assert_eq!((code.as_str(), (off * 1e6).round() / 1e6), ("RAS", 20.0));
    }

    #[test]
    fn labels_are_counted_and_gray_values_are_not() {
        let grid = Grid::new([3, 1, 1], Affine::scaled([10.0, 10.0, 10.0], [0.0; 3]).unwrap()).unwrap();
        let mut facts = Facts::new("l.nii");
        facts.values(&Volume::from_vec(grid, vec![0.0, 2.0, 2.0]).unwrap());
        assert!(facts.text().contains("label 2      2 voxels, 2 ml"), "{}", facts.text());
        assert!(!looks_like_labels(&Volume::from_vec(grid, vec![0.0, 0.5, 1.0]).unwrap()));
        assert!(!looks_like_labels(&Volume::from_vec(grid, vec![-1.0, 0.0, 1.0]).unwrap()));
    }
}
