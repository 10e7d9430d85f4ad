//! Skin scenes (TOML, SI) and the response they give.

use super::csv::write_table;
use super::format;
use super::scene::{known, read_table};
use crate::error::IoError;
use crate::types::skin::{Layer, SkinBlock, SkinLoad, SkinSample, SkinScene};
use serde::Deserialize;
use std::path::Path;
use toml::Value;

const LOAD: [&str; 4] = ["displacement", "ramp", "hold", "end"];
const LAYER: [&str; 7] = ["name", "thickness", "element", "e0", "c0", "maxwell", "c_unload"];
const BLOCK: [&str; 3] = ["width", "indenter", "poisson"];

#[derive(Deserialize)]
struct RawScene {
    load: SkinLoadRaw,
    layer: Vec<RawLayer>,
    block: Option<RawBlock>,
}

#[derive(Deserialize)]
struct SkinLoadRaw {
    displacement: f64,
    ramp: f64,
    hold: f64,
    end: f64,
}

#[derive(Deserialize)]
struct RawLayer {
    name: Option<String>,
    thickness: f64,
    element: String,
    e0: Option<f64>,
    c0: Option<f64>,
    maxwell: Option<Vec<[f64; 2]>>,
    c_unload: Option<Vec<f64>>,
}

#[derive(Deserialize, Default)]
struct RawBlock {
    width: Option<f64>,
    indenter: Option<f64>,
    poisson: Option<f64>,
}

/// Reads a skin scene. Without `[block]` the block is 6 times as wide as it is thick, the punch 1.5
/// times, and Poisson's ratio 0.45.
///
/// # Errors
/// [`IoError`] when the file cannot be read or is no TOML, a key is unknown (with the nearest known
/// one), missing or of a wrong type, or a value is out of range.
///
/// ```
/// use palpate::io::read_skin_scene;
/// let scene = read_skin_scene(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/skin.toml"))?;
/// assert_eq!(scene.layers.len(), 3);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn read_skin_scene(path: impl AsRef<Path>) -> Result<SkinScene, IoError> {
    let path = path.as_ref();
    let table = read_table(path)?;
    known(path, "the scene", &table, &["load", "layer", "block"])?;
    for (name, keys) in [("load", &LOAD[..]), ("block", &BLOCK)] {
        match table.get(name) {
            Some(Value::Table(part)) => known(path, &format!("[{name}]"), part, keys)?,
            Some(_) => {
                return Err(format(path, format!("{name} is not a table"), format!("write [{name}] above its keys")));
            }
            None => {}
        }
    }
    match table.get("layer") {
        Some(Value::Array(layers)) => {
            for layer in layers.iter().filter_map(Value::as_table) {
                known(path, "[[layer]]", layer, &LAYER)?;
            }
        }
        _ => return Err(format(path, "has no [[layer]]", "write one [[layer]] table for each, from the surface down")),
    }
    let raw: RawScene = Value::Table(table).try_into().map_err(|error: toml::de::Error| {
        let message = error.to_string().trim_end().replace('\n', " ");
        format(path, message, "docs/reference/skin.md shows a whole scene")
    })?;
    let mut layers = Vec::with_capacity(raw.layer.len());
    for (number, l) in raw.layer.into_iter().enumerate() {
        let name = l.name.unwrap_or_else(|| (number + 1).to_string());
        let element = l.element.parse().map_err(|e: crate::error::UnknownName| {
            format(path, e.to_string(), format!("correct layer '{name}' element"))
        })?;
        if layers.iter().any(|l: &Layer| l.name == name) {
            let what = format!("two layers are called '{name}', and response.csv has a column for each name");
            return Err(format(path, what, "give each [[layer]] a name of its own"));
        }
        layers.push(Layer {
            name,
            thickness: l.thickness,
            element,
            e0: l.e0.unwrap_or(0.0),
            c0: l.c0.unwrap_or(0.0),
            maxwell: l.maxwell.unwrap_or_default(),
            c_unload: l.c_unload.unwrap_or_default(),
        });
    }
    let thickness: f64 = layers.iter().map(|l| l.thickness).sum();
    let block = raw.block.unwrap_or_default();
    let SkinLoadRaw { displacement, ramp, hold, end } = raw.load;
    let scene = SkinScene {
        load: SkinLoad { displacement, ramp, hold, end },
        layers,
        block: SkinBlock {
            width: block.width.unwrap_or(6.0 * thickness),
            indenter: block.indenter.unwrap_or(1.5 * thickness),
            poisson: block.poisson.unwrap_or(0.45),
        },
    };
    scene.check().map_err(|e| format(path, e.to_string(), "docs/reference/skin.md has all keys and their ranges"))?;
    Ok(scene)
}

/// Writes time (s), stress_pa, displacement_m and `strain_<layer>` (compression positive), a row
/// for each sample.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub(crate) fn write_response(path: impl AsRef<Path>, scene: &SkinScene, samples: &[SkinSample]) -> Result<(), IoError> {
    let mut columns: Vec<String> = ["time", "stress_pa", "displacement_m"].map(String::from).to_vec();
    columns.extend(scene.layers.iter().map(|l| format!("strain_{}", l.name)));
    let columns: Vec<&str> = columns.iter().map(String::as_str).collect();
    let rows = samples.iter().map(|s| {
        let numbers = [&[s.time, s.stress, s.displacement][..], &s.strain].concat();
        numbers.into_iter().map(|v| format!("{v:.9e}")).collect()
    });
    write_table(path.as_ref(), &columns, rows)
}
