//! A text of 4 x 4 numbers.

use crate::error::{IoError, SpaceError};
use crate::io::field::Scaled;
use crate::io::format_error::Flaw;
use crate::io::{format, read_text};
use crate::types::{AffineMap, Grid, WorldPoint};
use std::path::Path;

const PLACE: &str = "write the true place of the volume into its header";
const CHECK: &str = "check which file it is: four lines of four numbers, the last one 0 0 0 1";

/// Reads the matrix as it stands.
pub(super) fn read(path: &Path) -> Result<AffineMap, IoError> {
    parse(&read_text(path)?).map_err(|flaw| flaw.at(path))
}

fn parse(text: &str) -> Result<AffineMap, Flaw> {
    let mut rows: Vec<[f64; 4]> = Vec::new();
    for (number, line) in text.lines().enumerate() {
        let words: Vec<&str> = line.split_whitespace().collect();
        if words.is_empty() {
            continue;
        }
        let wrong = |what: String| Flaw::new(format!("line {}: {what}", number + 1), CHECK);
        if rows.len() == 4 {
            return Err(wrong("a fifth line of numbers".into()));
        }
        if words.len() != 4 {
            let flat = if words.len() == 3 { ", as a 2-D transform has" } else { "" };
            return Err(wrong(format!("{} numbers instead of 4{flat}", words.len())));
        }
        let mut row = [0.0; 4];
        for (v, word) in row.iter_mut().zip(&words) {
            let shown: String = word.chars().take(20).collect();
            let read = word.parse().ok().filter(|v: &f64| v.is_finite());
            *v = read.ok_or_else(|| wrong(format!("{shown:?} is no finite number")))?;
        }
        rows.push(row);
    }
    match rows[..] {
        [a, b, c, [0.0, 0.0, 0.0, 1.0]] => AffineMap::new([a, b, c]).map_err(|e| Flaw::new(e.to_string(), CHECK)),
        [_, _, _, last] => Err(Flaw::new(format!("its last line is {last:?}, so it is not affine"), CHECK)),
        _ => Err(Flaw::new(format!("has {} lines of numbers instead of 4", rows.len()), CHECK)),
    }
}

/// FLIRT's matrix takes FSL's coordinates of the moving (deformed) volume to those of the fixed
/// (initial) one; what it stands for in the world, initial to deformed.
pub(super) fn from_flirt(
    path: &Path,
    matrix: &AffineMap,
    initial: Option<&Grid>,
    deformed: Option<&Grid>,
) -> Result<AffineMap, IoError> {
    let (Some(initial), Some(deformed)) = (initial, deformed) else {
        let what = "is a matrix of FSL, whose numbers refer to the grids of two volumes";
        return Err(format(path, what, "name them: --initial (FLIRT's -ref) and --deformed (its -in)"));
    };
    let ends = scaled(initial).and_then(|from| Ok((from, scaled(deformed)?)));
    let (from, to) = ends.map_err(|e| format(path, format!("led to or from a grid of which {e}"), PLACE))?;
    Ok(from.then(&matrix.inverse()).then(&to.inverse()))
}

/// The matrix of FLIRT, to be written to `path`, for a map in the world, initial to deformed.
pub(super) fn to_flirt(path: &Path, map: &AffineMap, initial: &Grid, deformed: &Grid) -> Result<AffineMap, IoError> {
    let ends = scaled(initial).and_then(|from| Ok((from, scaled(deformed)?)));
    let (from, to) = ends.map_err(|e| format(path, format!("leads to or from a grid of which {e}"), PLACE))?;
    Ok(from.inverse().then(map).then(&to).inverse())
}

/// World (mm, RAS) to FSL's coordinates of a grid.
fn scaled(grid: &Grid) -> Result<AffineMap, SpaceError> {
    let scaled = Scaled::of(grid);
    let place = |x: [f64; 3]| scaled.place(WorldPoint(x));
    let origin = place([0.0; 3]);
    let along: [[f64; 3]; 3] = std::array::from_fn(|c| place(std::array::from_fn(|a| f64::from(u8::from(a == c)))));
    AffineMap::new(std::array::from_fn(|r| {
        std::array::from_fn(|c| if c < 3 { along[c][r] - origin[r] } else { origin[r] })
    }))
}
