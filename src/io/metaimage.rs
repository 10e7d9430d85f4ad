//! MetaImage headers (ITK's MetaIO): `.mha`, or `.mhd` with one file of voxels beside it.
//! Coordinates are LPS, as ITK has them; each row of `TransformMatrix` is the direction of one
//! axis. Lengths are mm.

use super::format_error::Flaw;
use super::raw::{Packing, RawImage, Start, grid_from_lps, head, line, numbers};
use super::voxels::Kind;
use crate::error::IoError;
use crate::types::names::cut;
use std::path::Path;

const EXPORT: &str = "save it again from SimpleITK, or as .nii.gz";

/// Reads and checks the header at `path`.
pub(super) fn header(path: &Path) -> Result<RawImage, IoError> {
    let bytes = head(path)?;
    parse(path, &bytes).map_err(|flaw| flaw.at(path))
}

/// The fields of a header, and where it ends.
fn fields(bytes: &[u8]) -> Result<(Vec<(String, String)>, usize), Flaw> {
    let (mut fields, mut from): (Vec<(String, String)>, usize) = (Vec::new(), 0);
    let missing = || Flaw::new("its MetaImage header has no ElementDataFile", "copy or export it again");
    // The name of the file with the voxels ends the header.
    while fields.last().is_none_or(|f| f.0 != "elementdatafile") {
        let (text, next) = line(bytes, from)
            .or_else(|| Some((String::from_utf8_lossy(bytes.get(from..)?).trim().to_string(), bytes.len())))
            .filter(|(text, _)| !text.is_empty() || from < bytes.len())
            .ok_or_else(missing)?;
        from = next;
        if text.trim().is_empty() {
            continue;
        }
        if text.contains(|c: char| c == char::REPLACEMENT_CHARACTER || c.is_control() && c != '\t') {
            return Err(missing());
        }
        let (key, value) = text.split_once('=').ok_or_else(|| {
            let shown: String = text.chars().take(60).collect();
            Flaw::new(format!("its MetaImage header has the odd line {shown:?}"), EXPORT)
        })?;
        fields.push((key.trim().to_lowercase(), value.trim().into()));
    }
    Ok((fields, from))
}

fn parse(path: &Path, bytes: &[u8]) -> Result<RawImage, Flaw> {
    let (fields, from) = fields(bytes)?;
    // Of several names for one thing MetaIO takes the first one here, and of several lines the
    // last.
    let find = |names: &[&str]| names.iter().find_map(|n| fields.iter().rfind(|f| f.0 == *n)).map(|f| f.1.as_str());
    let odd = |name: &str, value: &str| {
        let shown: String = value.chars().take(60).collect();
        Flaw::new(format!("its MetaImage header has {name} = {shown}"), EXPORT)
    };
    let yes = |names: &[&str]| find(names).is_some_and(|v| v.eq_ignore_ascii_case("true") || v == "1");
    let number = |name: &'static str, key: &str, default: Option<i64>| match find(&[key]) {
        Some(text) => text.parse().map_err(|_| odd(name, text)),
        None => default.ok_or_else(|| Flaw::new(format!("its MetaImage header has no {name}"), EXPORT)),
    };
    let n = match number("NDims", "ndims", None)? {
        2 => 2,
        3 => 3,
        other => return Err(odd("NDims", &other.to_string())),
    };
    let list = |name: &'static str, keys: &[&str], default: f64, length: usize| match find(keys) {
        Some(text) => numbers(text).filter(|v| v.len() == length).ok_or_else(|| odd(name, text)),
        None => Ok(vec![default; length]),
    };
    let text = find(&["dimsize"]).ok_or_else(|| Flaw::new("its MetaImage header has no DimSize", EXPORT))?;
    let sizes: Vec<usize> = text
        .split_whitespace()
        .map(|s| s.parse().ok().filter(|&n| n > 0))
        .collect::<Option<Vec<_>>>()
        .filter(|s| s.len() == n)
        .ok_or_else(|| odd("DimSize", text))?;
    let spacing = list("ElementSpacing", &["elementspacing", "elementsize"], 1.0, n)?;
    let offset = list("Offset", &["origin", "offset", "position"], 0.0, n)?;
    let identity: Vec<f64> = (0..n * n).map(|i| f64::from(u8::from(i % (n + 1) == 0))).collect();
    let directions = match find(&["transformmatrix", "rotation", "orientation"]) {
        Some(text) => numbers(text).filter(|v| v.len() == n * n).ok_or_else(|| odd("TransformMatrix", text))?,
        None => identity,
    };
    let (mut shape, mut origin) = ([1; 3], [0.0; 3]);
    let mut steps = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    for a in 0..n {
        (shape[a], origin[a]) = (sizes[a], offset[a]);
        (0..n).for_each(|c| steps[a][c] = directions[a * n + c] * spacing[a]);
    }
    let grid = grid_from_lps(shape, steps, origin)?;
    let neutral = [("elementtointensityfunctionslope", 1.0), ("elementtointensityfunctionoffset", 0.0)];
    for (key, value) in neutral {
        if let Some(text) = find(&[key]).filter(|t| t.parse() != Ok(value)) {
            return Err(odd(key, text));
        }
    }
    if let Some(unit) = find(&["distanceunits"]).filter(|u| !["mm", "?"].contains(u)) {
        let what = format!("its MetaImage header has DistanceUnits = {}, which ITK takes as mm", cut(unit));
        return Err(Flaw::new(what, "write the voxel size and the origin in mm"));
    }
    if find(&["binarydata"]).is_some_and(|v| v.eq_ignore_ascii_case("false")) {
        return Err(odd("BinaryData", "False"));
    }
    let channels = number("ElementNumberOfChannels", "elementnumberofchannels", Some(1))?;
    let components = usize::try_from(channels).ok().filter(|c| (1..=1000).contains(c));
    let components = components.ok_or_else(|| odd("ElementNumberOfChannels", &channels.to_string()))?;
    let packed = yes(&["compresseddata"]);
    let skip = number("HeaderSize", "headersize", Some(0))?;
    let name = find(&["elementdatafile"]).unwrap_or_default();
    let local = name.eq_ignore_ascii_case("local");
    if name.starts_with("LIST") || name.contains('%') {
        return Err(Flaw::new("has its voxels in several files", EXPORT));
    }
    let start = match (local, skip) {
        (true, 0 | -1) => Start::At(from as u64),
        (false, -1) if !packed => Start::Last,
        (false, 0..) => Start::At(skip as u64),
        _ => return Err(odd("HeaderSize", &skip.to_string())),
    };
    Ok(RawImage {
        format: if packed { "MetaImage, zlib" } else { "MetaImage" },
        placed: "LPS",
        grid,
        components,
        interleaved: true,
        kind: kind(find(&["elementtype"]).unwrap_or_default())?,
        big_endian: yes(&["binarydatabyteordermsb", "elementbyteordermsb"]),
        packing: if packed { Packing::Zlib } else { Packing::None },
        start,
        file: if local { path.into() } else { path.parent().unwrap_or(Path::new("")).join(name) },
    })
}

fn kind(name: &str) -> Result<Kind, Flaw> {
    Ok(match name.strip_suffix("_ARRAY").unwrap_or(name) {
        "MET_UCHAR" => Kind::U8,
        "MET_CHAR" => Kind::I8,
        "MET_USHORT" => Kind::U16,
        "MET_SHORT" => Kind::I16,
        "MET_UINT" | "MET_ULONG" => Kind::U32,
        "MET_INT" | "MET_LONG" => Kind::I32,
        "MET_ULONG_LONG" => Kind::U64,
        "MET_LONG_LONG" => Kind::I64,
        "MET_FLOAT" => Kind::F32,
        "MET_DOUBLE" => Kind::F64,
        other => {
            let shown: String = other.chars().take(40).collect();
            return Err(Flaw::new(format!("holds '{shown}', not numbers"), "save it as MET_FLOAT"));
        }
    })
}
