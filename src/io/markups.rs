//! 3D Slicer's points: markups (`.mrk.json`, read and written) and the older fiducials (`.fcsv`,
//! read).
//!
//! Both say whether they are RAS or LPS; without, `.mrk.json` is LPS and `.fcsv` RAS, as Slicer
//! takes them.

use super::csv::PointTable;
use super::raw::in_mm;
use super::{format, source, write_json};
use crate::error::IoError;
use crate::types::WorldPoint;
use crate::types::names::cut;
use serde::Deserialize;
use serde_json::{Value, json};
use std::path::Path;

#[derive(Deserialize)]
struct Markups {
    markups: Vec<List>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct List {
    coordinate_system: Option<Value>,
    /// One for all axes, or a list of one an axis: the name of a unit, or of its UCUM code.
    coordinate_units: Option<Value>,
    #[serde(default)]
    control_points: Vec<ControlPoint>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct ControlPoint {
    label: Option<String>,
    position: Option<[f64; 3]>,
    position_status: Option<String>,
}

/// Whether `path` is one of Slicer's formats, by its name.
pub(crate) fn is_slicer(path: &Path) -> bool {
    let name = path.to_string_lossy().to_lowercase();
    name.ends_with(".fcsv") || name.ends_with(".json")
}

/// Reads the points of either format, world mm RAS, with a column `label`.
pub(super) fn read(path: &Path) -> Result<PointTable, IoError> {
    let text = source::text(path, source::MAX_TEXT_BYTES)?;
    let (points, labels) = match path.to_string_lossy().to_lowercase().ends_with(".fcsv") {
        true => read_fcsv(path, &text)?,
        false => read_json(path, &text)?,
    };
    if points.is_empty() {
        return Err(format(path, "holds no point", "place one in Slicer and save it again"));
    }
    if let Some(at) = points.iter().position(|p: &[f64; 3]| p.iter().any(|v| !v.is_finite())) {
        return Err(format(path, format!("point {} has a coordinate that is not finite", at + 1), "remove that point"));
    }
    let points = points.into_iter().map(WorldPoint).collect();
    let others = labels.into_iter().map(|l| vec![l]).collect();
    Ok(PointTable { points, other_columns: vec!["label".into()], others })
}

type Points = (Vec<[f64; 3]>, Vec<String>);

/// The sign of x and y that takes a coordinate system to RAS.
fn to_ras(path: &Path, system: &str) -> Result<f64, IoError> {
    match system.trim().to_uppercase().as_str() {
        "RAS" | "0" => Ok(1.0),
        "LPS" | "1" => Ok(-1.0),
        other => {
            let what = format!("has the coordinate system {:?}", other.chars().take(20).collect::<String>());
            Err(format(path, what, "save it as RAS or LPS"))
        }
    }
}

fn read_json(path: &Path, text: &str) -> Result<Points, IoError> {
    let hint = "give a markups file as Slicer saves it (.mrk.json)";
    let file: Markups =
        serde_json::from_str(text).map_err(|e| format(path, format!("is no markups file ({e})"), hint))?;
    let [list] = &file.markups[..] else {
        return Err(format(path, format!("holds {} lists of points, one is needed", file.markups.len()), hint));
    };
    let sign = match &list.coordinate_system {
        None => -1.0,
        Some(Value::String(system)) => to_ras(path, system)?,
        Some(other) => to_ras(path, &other.to_string())?,
    };
    let unit = match &list.coordinate_units {
        None => 1.0,
        Some(units) => unit_in_mm(units).ok_or_else(|| {
            let what = format!("has coordinateUnits {}", cut(&units.to_string()));
            format(path, what, "save it in mm, or in another unit of length, the same along all axes")
        })?,
    };
    let defined = |p: &&ControlPoint| p.position_status.as_deref().is_none_or(|s| s == "defined");
    let mut out = Points::default();
    for p in list.control_points.iter().filter(defined) {
        let Some([x, y, z]) = p.position else { continue };
        out.0.push([sign * unit * x, sign * unit * y, unit * z]);
        out.1.push(p.label.clone().unwrap_or_default());
    }
    Ok(out)
}

/// What a unit is in mm; none where it is none of length, or the axes differ.
fn unit_in_mm(units: &Value) -> Option<f64> {
    match units {
        Value::String(name) => in_mm(name),
        Value::Array(axes) => {
            let each: Vec<f64> = axes.iter().map(unit_in_mm).collect::<Option<_>>()?;
            each.first().copied().filter(|u| each.iter().all(|v| v == u))
        }
        Value::Object(coded) => coded.get("codeValue").or(coded.get("CodeValue")).and_then(unit_in_mm),
        _ => None,
    }
}

fn read_fcsv(path: &Path, text: &str) -> Result<Points, IoError> {
    let mut sign = 1.0;
    let mut columns = ["x", "y", "z", "label"].map(|name| (name, if name == "label" { 11 } else { 0 }));
    (0..3).for_each(|a| columns[a].1 = a + 1);
    let mut out = Points::default();
    for (at, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()) {
        if let Some(comment) = line.strip_prefix('#') {
            match comment.split_once('=').map(|(k, v)| (k.trim(), v)) {
                Some(("CoordinateSystem", system)) => sign = to_ras(path, system)?,
                Some(("columns", names)) => {
                    for (name, column) in &mut columns {
                        *column = names.split(',').position(|n| n.trim() == *name).unwrap_or(usize::MAX);
                    }
                }
                _ => {}
            }
            continue;
        }
        let cells: Vec<&str> = line.split(',').map(str::trim).collect();
        let mut p = [0.0; 3];
        for (a, value) in p.iter_mut().enumerate() {
            let found = cells.get(columns[a].1).copied().unwrap_or("nothing");
            *value = found.parse().map_err(|_| {
                let what = format!("line {}: {} is {found:?}, not a number", at + 1, columns[a].0);
                format(path, what, "save the fiducials again from Slicer")
            })?;
        }
        out.0.push([sign * p[0], sign * p[1], p[2]]);
        out.1.push(cells.get(columns[3].1).copied().unwrap_or_default().trim_matches('"').into());
    }
    Ok(out)
}

/// Writes points (world mm, RAS in memory, LPS on disk) as a Slicer point list; `labels` and
/// `descriptions` may be shorter.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub fn write_markups(
    path: impl AsRef<Path>,
    points: &[WorldPoint],
    labels: &[String],
    descriptions: &[String],
) -> Result<(), IoError> {
    let list: Vec<Value> = points
        .iter()
        .enumerate()
        .map(|(i, p)| {
            let [x, y, z] = p.0;
            let number = (i + 1).to_string();
            json!({
                "id": number,
                "label": labels.get(i).unwrap_or(&number),
                "description": descriptions.get(i).map_or("", String::as_str),
                "associatedNodeID": "",
                "position": [-x + 0.0, -y + 0.0, z],
                "orientation": [-1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0],
                "selected": true,
                "locked": false,
                "visibility": true,
                "positionStatus": "defined",
            })
        })
        .collect();
    let schema = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/markups-schema-v1.0.3.json#";
    write_json(
        path,
        &json!({
            "@schema": schema,
            "markups": [{
                "type": "Fiducial",
                "coordinateSystem": "LPS",
                "coordinateUnits": "mm",
                "locked": false,
                "fixedNumberOfControlPoints": false,
                "labelFormat": "%N-%d",
                "lastUsedControlPointNumber": points.len(),
                "controlPoints": list,
            }],
        }),
    )
}
