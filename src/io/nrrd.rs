//! NRRD headers (teem.sourceforge.net/nrrd/format.html): `.nrrd`, or `.nhdr` with one file of
//! voxels beside it.
//!
//! Two or three axes of space and at most one of components, first or last; every number type; raw
//! or gzip. Spaces RAS, LAS and LPS; without any, the axes are taken as LPS, as ITK does. Lists of
//! files, text, hex and bzip2 are errors.

use super::format_error::Flaw;
use super::raw::{Packing, RawImage, Start, grid_from_lps, head, in_mm, line, numbers};
use super::voxels::Kind;
use crate::error::IoError;
use std::path::Path;

const EXPORT: &str = "save it again from 3D Slicer or SimpleITK, or as .nii.gz";

/// Reads and checks the header at `path`.
pub(super) fn header(path: &Path) -> Result<RawImage, IoError> {
    let bytes = head(path)?;
    parse(path, &bytes).map_err(|flaw| flaw.at(path))
}

/// The fields of a header, and where the voxels begin if they stand in the same file.
fn fields(bytes: &[u8]) -> Result<(Vec<(String, String)>, Option<usize>), Flaw> {
    let mut fields: Vec<(String, String)> = Vec::new();
    let (_, mut from) = line(bytes, 0).ok_or_else(cut)?; // the magic
    loop {
        // A header that ends with the file names another one for the voxels.
        let Some((text, next)) = line(bytes, from) else {
            let last = String::from_utf8_lossy(&bytes[from.min(bytes.len())..]).trim().to_string();
            if let Some((key, value)) = last.split_once(": ") {
                fields.push((key.trim().to_lowercase(), value.trim().into()));
            }
            return Ok((fields, None));
        };
        from = next;
        if text.is_empty() {
            return Ok((fields, Some(next)));
        }
        if text.starts_with('#') || text.contains(":=") {
            continue;
        }
        let (key, value) = text
            .split_once(':')
            .ok_or_else(|| Flaw::new(format!("its NRRD header has the odd line {:?}", shortened(&text)), EXPORT))?;
        fields.push((key.trim().to_lowercase(), value.trim().into()));
    }
}

fn cut() -> Flaw {
    Flaw::new("ends inside its NRRD header", "copy or export it again")
}

fn parse(path: &Path, bytes: &[u8]) -> Result<RawImage, Flaw> {
    let (fields, end) = fields(bytes)?;
    let find = |names: &[&str]| fields.iter().find(|f| names.contains(&f.0.as_str())).map(|f| f.1.as_str());
    let need = |name: &'static str| {
        find(&[name]).ok_or_else(|| Flaw::new(format!("its NRRD header has no field '{name}'"), EXPORT))
    };
    let kind = kind(need("type")?)?;
    let odd = |name: &str, value: &str| Flaw::new(format!("its NRRD header has {name}: {}", shortened(value)), EXPORT);
    let text = need("sizes")?;
    let sizes: Vec<usize> = text
        .split_whitespace()
        .map(|s| s.parse().ok().filter(|&n| n > 0))
        .collect::<Option<_>>()
        .ok_or_else(|| odd("sizes", text))?;
    if need("dimension")?.parse() != Ok(sizes.len()) {
        return Err(odd("sizes", text));
    }
    let axes = Axes::of(&sizes, &find)?;
    let steps = axes.steps(&find)?;
    let origin = match find(&["space origin"]) {
        Some(text) => vector(text).ok_or_else(|| odd("space origin", text))?,
        None => [0.0; 3],
    };
    let (sign, placed) = match find(&["space"]).map(str::to_lowercase).as_deref() {
        None => ([1.0, 1.0, 1.0], "no space, taken as LPS"),
        Some("left-posterior-superior" | "lps") => ([1.0, 1.0, 1.0], "space LPS"),
        Some("right-anterior-superior" | "ras") => ([-1.0, -1.0, 1.0], "space RAS"),
        Some("left-anterior-superior" | "las") => ([1.0, -1.0, 1.0], "space LAS"),
        Some(other) => {
            let what = format!("is in the space '{}', which does not say where the patient is", shortened(other));
            return Err(Flaw::new(what, EXPORT));
        }
    };
    let lps = |v: [f64; 3]| std::array::from_fn(|a| sign[a] * v[a]);
    let unit = match find(&["space units"]) {
        Some(text) => units_in_mm(text).ok_or_else(|| odd("space units", text))?,
        None => [1.0; 3],
    };
    let scaled = |v: [f64; 3]| lps(std::array::from_fn(|a| unit[a] * v[a]));
    let grid = grid_from_lps(axes.shape, steps.map(scaled), scaled(origin))?;
    if axes.components > 1 && find(&["measurement frame"]).and_then(numbers).is_some_and(|m| m != FRAME) {
        return Err(Flaw::new("has a measurement frame of its own for its vectors", EXPORT));
    }
    let colours = |kind: &str| kind.to_lowercase().ends_with("color");
    if let Some(kinds) = find(&["kinds"]).filter(|k| k.split_whitespace().any(colours)) {
        let what = format!("holds colours (kinds: {}), not numbers of one meaning", shortened(kinds));
        return Err(Flaw::new(what, "convert it to one grey value a voxel"));
    }
    let big_endian = match find(&["endian"]).map(str::to_lowercase).as_deref() {
        Some("big") => true,
        Some("little") => false,
        None if kind.size() == 1 => false,
        other => return Err(odd("endian", other.unwrap_or("nothing"))),
    };
    let encoding = need("encoding")?.to_lowercase();
    let (packing, format) = match encoding.as_str() {
        "raw" => (Packing::None, "NRRD"),
        "gzip" | "gz" => (Packing::Gzip, "NRRD, gzip"),
        other => return Err(odd("encoding", other)),
    };
    if let Some(skip) = find(&["line skip", "lineskip"]).filter(|s| *s != "0") {
        return Err(odd("line skip", skip));
    }
    let skip: i64 = match find(&["byte skip", "byteskip"]) {
        Some(text) => text.parse().ok().filter(|&n| n >= -1).ok_or_else(|| odd("byte skip", text))?,
        None => 0,
    };
    let file = match (find(&["data file", "datafile"]), end) {
        (Some(name), _) if name.starts_with("LIST") || name.split_whitespace().count() > 1 && name.contains('%') => {
            return Err(Flaw::new("has its voxels in several files", EXPORT));
        }
        (Some(name), _) => path.parent().unwrap_or(Path::new("")).join(name),
        (None, Some(_)) => path.into(),
        (None, None) => return Err(cut()),
    };
    let inside = end.filter(|_| file == path).unwrap_or(0) as u64;
    let start = match skip {
        -1 if packing == Packing::None => Start::Last,
        0.. if packing == Packing::None => Start::At(inside + skip as u64),
        0 => Start::At(inside),
        _ => return Err(odd("byte skip", &skip.to_string())),
    };
    let Axes { components, interleaved, .. } = axes;
    Ok(RawImage { format, placed, grid, components, interleaved, kind, big_endian, packing, start, file })
}

/// What one of each axis of space is in mm, from `"mm" "cm" "um"`; an empty name is mm.
fn units_in_mm(text: &str) -> Option<[f64; 3]> {
    let names: Vec<&str> = text.split_whitespace().map(|w| w.trim_matches('"')).collect();
    let each: Vec<f64> =
        names.iter().map(|n| if n.is_empty() { Some(1.0) } else { in_mm(n) }).collect::<Option<_>>()?;
    match each[..] {
        [x, y, z] => Some([x, y, z]),
        [x, y] => Some([x, y, 1.0]),
        _ => None,
    }
}

/// The identity, row by row.
const FRAME: [f64; 9] = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];

fn shortened(text: &str) -> String {
    text.chars().take(60).collect()
}

/// `(x,y,z)` or `(x,y)`.
fn vector(text: &str) -> Option<[f64; 3]> {
    match numbers(text)?[..] {
        [x, y, z] => Some([x, y, z]),
        [x, y] => Some([x, y, 0.0]),
        _ => None,
    }
}

/// Which axes are space and which is components.
struct Axes {
    shape: [usize; 3],
    components: usize,
    interleaved: bool,
    /// Numbers of the axes of space.
    spatial: Vec<usize>,
    all: usize,
}

impl Axes {
    fn of<'a>(sizes: &[usize], find: &dyn Fn(&[&str]) -> Option<&'a str>) -> Result<Self, Flaw> {
        let all = sizes.len();
        let spatial: Vec<usize> = match (find(&["space directions"]), find(&["kinds"])) {
            (Some(text), _) => {
                let words = split_vectors(text);
                (0..all).filter(|&a| words.get(a).is_some_and(|w| w != "none")).collect()
            }
            (None, Some(kinds)) => {
                let kinds: Vec<String> = kinds.split_whitespace().map(str::to_lowercase).collect();
                let space =
                    |a: usize| kinds.get(a).is_none_or(|k| matches!(k.as_str(), "domain" | "space" | "none" | "???"));
                (0..all).filter(|&a| space(a)).collect()
            }
            (None, None) => (0..all.min(3)).collect(),
        };
        let rest: Vec<usize> = (0..all).filter(|a| !spatial.contains(a)).collect();
        let (components, interleaved) = match rest[..] {
            [] => (1, false),
            [0] => (sizes[0], true),
            [a] if a + 1 == all => (sizes[a], false),
            _ => (0, false),
        };
        if !(2..=3).contains(&spatial.len()) || components == 0 {
            let what = format!("has the axes {sizes:?}, {} of them in space", spatial.len());
            return Err(Flaw::new(what, "give a volume, or a field with three numbers a voxel"));
        }
        let mut shape = [1; 3];
        spatial.iter().enumerate().for_each(|(at, &a)| shape[at] = sizes[a]);
        Ok(Self { shape, components, interleaved, spatial, all })
    }

    /// From voxel to voxel along each axis.
    fn steps<'a>(&self, find: &dyn Fn(&[&str]) -> Option<&'a str>) -> Result<[[f64; 3]; 3], Flaw> {
        let wrong = |what: &str| Flaw::new(format!("its NRRD header has odd {what}"), EXPORT);
        let mut steps = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        if let Some(text) = find(&["space directions"]) {
            let words = split_vectors(text);
            if words.len() != self.all {
                return Err(wrong("space directions"));
            }
            for (at, &a) in self.spatial.iter().enumerate() {
                steps[at] = vector(&words[a]).ok_or_else(|| wrong("space directions"))?;
            }
        } else if let Some(text) = find(&["spacings"]) {
            let words: Vec<&str> = text.split_whitespace().collect();
            for (at, &a) in self.spatial.iter().enumerate() {
                let size = words.get(a).and_then(|w| w.parse::<f64>().ok()).filter(|v| v.is_finite() && *v > 0.0);
                steps[at][at] = size.ok_or_else(|| wrong("spacings"))?;
            }
            if find(&["axis mins", "axismins"]).is_some() {
                return Err(wrong("axis mins in place of a space origin"));
            }
        }
        Ok(steps)
    }
}

/// `none (1,0,0) (0, 1, 0)` in parts.
fn split_vectors(text: &str) -> Vec<String> {
    let (mut out, mut depth) = (vec![String::new()], 0);
    for c in text.chars() {
        depth += i32::from(c == '(') - i32::from(c == ')');
        if c.is_whitespace() && depth == 0 {
            out.push(String::new());
        } else if let Some(last) = out.last_mut() {
            last.push(c);
        }
    }
    out.retain(|w| !w.is_empty());
    out
}

fn kind(name: &str) -> Result<Kind, Flaw> {
    Ok(match name {
        "uchar" | "unsigned char" | "uint8" | "uint8_t" => Kind::U8,
        "signed char" | "int8" | "int8_t" => Kind::I8,
        "short" | "short int" | "signed short" | "signed short int" | "int16" | "int16_t" => Kind::I16,
        "ushort" | "unsigned short" | "unsigned short int" | "uint16" | "uint16_t" => Kind::U16,
        "int" | "signed int" | "int32" | "int32_t" => Kind::I32,
        "uint" | "unsigned int" | "uint32" | "uint32_t" => Kind::U32,
        "longlong"
        | "long long"
        | "long long int"
        | "signed long long"
        | "signed long long int"
        | "int64"
        | "int64_t" => Kind::I64,
        "ulonglong" | "unsigned long long" | "unsigned long long int" | "uint64" | "uint64_t" => Kind::U64,
        "float" => Kind::F32,
        "double" => Kind::F64,
        other => return Err(Flaw::new(format!("holds '{}', not numbers", shortened(other)), "save it as float")),
    })
}
