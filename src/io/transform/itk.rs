//! ITK's transforms: the text file, and what its kinds and parameters mean.
//!
//! Text: a first line `#Insight Transform File V1.0`, then blocks of `Transform:`, `Parameters:`
//! and `FixedParameters:`. A composite is a block without parameters before all others, and its
//! last block is the first that a point meets (itkCompositeTransform.h).

use crate::error::IoError;
use crate::io::format_error::Flaw;
use crate::io::raw::grid_from_lps;
use crate::io::read_text;
use crate::types::space::{Matrix3, matmul};
use crate::types::{AffineMap, DenseField, Transform};
use std::path::Path;

const EXPORT: &str = "save it again from SimpleITK or ANTs";
/// The kinds that are read, for messages.
const KINDS: &str = "read are affine, Euler, versor, similarity, scale, translation and displacement field transforms";
/// What a file with more transforms than this holds is no chain.
const MAX_TRANSFORMS: usize = 1000;

/// One transform as it is stored.
pub(super) struct Block {
    /// As `AffineTransform_double_3_3`.
    pub(super) name: String,
    pub(super) parameters: Vec<f64>,
    pub(super) fixed: Vec<f64>,
    /// Where it stands in the file, as `line 3`.
    pub(super) place: String,
}

/// Reads the transforms of a text file, in the order in which a point travels.
pub(super) fn read(path: &Path) -> Result<Vec<Transform>, IoError> {
    let text = read_text(path)?;
    blocks(&text).and_then(chain).map_err(|flaw| flaw.at(path))
}

/// The blocks of a text file, in its order.
fn blocks(text: &str) -> Result<Vec<Block>, Flaw> {
    let mut blocks: Vec<Block> = Vec::new();
    for (number, line) in text.lines().enumerate() {
        let (place, line) = (format!("line {}", number + 1), line.trim());
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let (key, value) = line.split_once(':').ok_or_else(|| odd(&place, line))?;
        let full = blocks.len() == MAX_TRANSFORMS;
        match (key.trim(), blocks.last_mut()) {
            ("Transform", _) if !full => {
                let name = value.trim().into();
                blocks.push(Block { name, parameters: Vec::new(), fixed: Vec::new(), place });
            }
            ("Transform", _) => {
                return Err(Flaw::new(format!("{place}: more than {MAX_TRANSFORMS} transforms"), EXPORT));
            }
            ("Parameters", Some(block)) => block.parameters = numbers(value, &place)?,
            ("FixedParameters", Some(block)) => block.fixed = numbers(value, &place)?,
            _ => return Err(odd(&place, line)),
        }
    }
    Ok(blocks)
}

fn odd(place: &str, line: &str) -> Flaw {
    Flaw::new(format!("{place} is odd for a transform of ITK: {:?}", line.chars().take(40).collect::<String>()), EXPORT)
}

fn numbers(text: &str, place: &str) -> Result<Vec<f64>, Flaw> {
    text.split_whitespace()
        .map(|word| {
            word.parse().ok().filter(|v: &f64| v.is_finite()).ok_or_else(|| {
                let shown: String = word.chars().take(20).collect();
                Flaw::new(format!("{place}: {shown:?} is no finite number"), EXPORT)
            })
        })
        .collect()
}

/// The transforms of blocks, in the order in which a point travels.
pub(super) fn chain(blocks: Vec<Block>) -> Result<Vec<Transform>, Flaw> {
    let composite = blocks.first().is_some_and(|b| b.name.starts_with("CompositeTransform"));
    let parts = if composite { &blocks[1..] } else { &blocks[..] };
    match parts {
        [] => Err(Flaw::new("holds no transform", EXPORT)),
        [_, second, ..] if !composite => {
            let what = format!("{}: a second transform, but the file is no composite", second.place);
            Err(Flaw::new(what, "ITK takes the first one alone: save a composite, or a file for each"))
        }
        parts => parts.iter().rev().map(transform).collect(),
    }
}

fn transform(block: &Block) -> Result<Transform, Flaw> {
    let Block { name, parameters, fixed, place } = block;
    let mut words = name.rsplitn(4, '_');
    let (to, from, precision) = (words.next(), words.next(), words.next());
    let kind = words.next().unwrap_or(name);
    if to.is_some() && from == Some("2") || to == Some("2") {
        return Err(Flaw::new(format!("{place}: {name} is 2-D"), "give a transform of volumes, in 3-D"));
    }
    if (to, from) != (Some("3"), Some("3")) || !matches!(precision, Some("double" | "float")) {
        return Err(Flaw::new(format!("{place}: {name:?} is no kind of transform in 3-D"), KINDS));
    }
    if kind == "DisplacementFieldTransform" {
        return field(parameters, fixed)
            .map(Transform::Field)
            .map_err(|what| Flaw::new(format!("{place}: {what}"), EXPORT));
    }
    let p = parameters.as_slice();
    let (matrix, shift) = match (kind, p.len()) {
        ("AffineTransform" | "MatrixOffsetTransformBase" | "Rigid3DTransform", 12) => (rows(p), [p[9], p[10], p[11]]),
        ("Euler3DTransform", 6) => {
            (euler([p[0], p[1], p[2]], fixed.get(3).is_some_and(|z| *z != 0.0)), [p[3], p[4], p[5]])
        }
        ("VersorRigid3DTransform", 6) => (versor(p), [p[3], p[4], p[5]]),
        ("VersorTransform", 3) => (versor(p), [0.0; 3]),
        ("QuaternionRigidTransform", 7) => (quaternion([p[0], p[1], p[2], p[3]]), [p[4], p[5], p[6]]),
        ("Similarity3DTransform", 7) => (versor(p).map(|row| row.map(|v| v * p[6])), [p[3], p[4], p[5]]),
        ("ScaleVersor3DTransform", 9) => {
            let mut m = versor(p);
            (0..3).for_each(|a| m[a][a] += p[6 + a] - 1.0);
            (m, [p[3], p[4], p[5]])
        }
        ("TranslationTransform", 3) => (diagonal([1.0; 3]), [p[0], p[1], p[2]]),
        ("ScaleTransform", 3) => (diagonal([p[0], p[1], p[2]]), [0.0; 3]),
        ("IdentityTransform", _) => (diagonal([1.0; 3]), [0.0; 3]),
        (
            "AffineTransform"
            | "MatrixOffsetTransformBase"
            | "Rigid3DTransform"
            | "Euler3DTransform"
            | "VersorRigid3DTransform"
            | "VersorTransform"
            | "QuaternionRigidTransform"
            | "Similarity3DTransform"
            | "ScaleVersor3DTransform"
            | "TranslationTransform"
            | "ScaleTransform",
            found,
        ) => return Err(Flaw::new(format!("{place}: {kind} has {found} parameters"), EXPORT)),
        _ => return Err(Flaw::new(format!("{place}: {kind} is not read"), KINDS)),
    };
    let centre = match fixed[..] {
        [x, y, z] | [x, y, z, _] => [x, y, z],
        [] => [0.0; 3],
        _ => return Err(Flaw::new(format!("{place}: {kind} has {} fixed parameters", fixed.len()), EXPORT)),
    };
    about(&matrix, shift, centre).map(Transform::Affine).map_err(|what| Flaw::new(format!("{place}: {what}"), EXPORT))
}

/// y = M (x - c) + c + t in LPS as a map in RAS.
fn about(m: &Matrix3, shift: [f64; 3], centre: [f64; 3]) -> Result<AffineMap, String> {
    let sign = [-1.0, -1.0, 1.0];
    AffineMap::new(std::array::from_fn(|r| {
        let turned: f64 = (0..3).map(|c| m[r][c] * centre[c]).sum();
        std::array::from_fn(|c| match c {
            3 => sign[r] * (shift[r] + centre[r] - turned) + 0.0,
            c => sign[r] * sign[c] * m[r][c] + 0.0,
        })
    }))
    .map_err(|e| e.to_string())
}

fn rows(p: &[f64]) -> Matrix3 {
    std::array::from_fn(|r| std::array::from_fn(|c| p[3 * r + c]))
}

fn diagonal(d: [f64; 3]) -> Matrix3 {
    std::array::from_fn(|r| std::array::from_fn(|c| if r == c { d[r] } else { 0.0 }))
}

/// Rotations about x, y and z (radians): Z X Y, or Z Y X (itkEuler3DTransform.hxx).
fn euler([x, y, z]: [f64; 3], zyx: bool) -> Matrix3 {
    let (rx, ry, rz) = (
        [[1.0, 0.0, 0.0], [0.0, x.cos(), -x.sin()], [0.0, x.sin(), x.cos()]],
        [[y.cos(), 0.0, y.sin()], [0.0, 1.0, 0.0], [-y.sin(), 0.0, y.cos()]],
        [[z.cos(), -z.sin(), 0.0], [z.sin(), z.cos(), 0.0], [0.0, 0.0, 1.0]],
    );
    match zyx {
        true => matmul(&rz, &matmul(&ry, &rx)),
        false => matmul(&rz, &matmul(&rx, &ry)),
    }
}

/// A rotation by the vector part of a unit quaternion; one too long is cut as ITK does.
fn versor(p: &[f64]) -> Matrix3 {
    const MATRIX_TOLERANCE: f64 = 1e-10; // itkVersorRigid3DTransform.hxx
    let norm = p[..3].iter().map(|v| v * v).sum::<f64>().sqrt();
    let cut = if norm >= 1.0 - MATRIX_TOLERANCE { norm * (1.0 + MATRIX_TOLERANCE) } else { 1.0 };
    let [x, y, z] = [p[0] / cut, p[1] / cut, p[2] / cut];
    quaternion([x, y, z, (1.0 - x * x - y * y - z * z).max(0.0).sqrt()])
}

/// A rotation by a quaternion (x, y, z, w) of any length.
fn quaternion(q: [f64; 4]) -> Matrix3 {
    let length = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    let [x, y, z, w] = q.map(|v| v / length);
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

/// A displacement field: size, origin, spacing and direction (row by row), then x, y, z of each
/// voxel (mm, LPS).
fn field(parameters: &[f64], fixed: &[f64]) -> Result<DenseField, String> {
    if fixed.len() != 18 {
        return Err(format!("the field has {} fixed parameters instead of 18", fixed.len()));
    }
    let size: Vec<usize> = fixed[..3].iter().map(|&n| n as usize).collect();
    if fixed[..3].iter().any(|n| n.fract() != 0.0 || !(1.0..=1e6).contains(n)) {
        return Err(format!("the field has the size {:?}", &fixed[..3]));
    }
    let n =
        size.iter().try_fold(1usize, |n, s| n.checked_mul(*s)).filter(|n| n.checked_mul(3) == Some(parameters.len()));
    let n = n.ok_or_else(|| format!("the field has {} numbers for its size {size:?}", parameters.len()))?;
    let steps = std::array::from_fn(|a| std::array::from_fn(|r| fixed[9 + 3 * r + a] * fixed[6 + a]));
    let grid = grid_from_lps([size[0], size[1], size[2]], steps, [fixed[3], fixed[4], fixed[5]]);
    let grid = grid.map_err(|_| "the field has a grid without extent".to_string())?;
    let value = |c: usize, at: usize| if c < 2 { -parameters[3 * at + c] } else { parameters[3 * at + c] };
    let values = (0..3).flat_map(|c| (0..n).map(move |at| value(c, at) as f32)).collect();
    DenseField::from_vec(grid, values).map_err(|e| e.to_string())
}
