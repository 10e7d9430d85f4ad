//! A folder of `palpate stiffness` read back, and fingertip files.

use super::{format, write_text};
use crate::error::IoError;
use crate::io::image::read_volume;
use crate::types::StiffnessParams;
use crate::types::Volume;
use crate::types::fingertip::{PadReduction, StiffnessFolder, StiffnessRegion};
use serde::Deserialize;
use std::path::Path;

#[derive(Deserialize)]
struct RawSummary {
    absolute: bool,
    #[serde(default = "nearly_incompressible")]
    poisson: f64,
    regions: Vec<StiffnessRegion>,
    inputs: RawInputs,
    force_n: Option<f64>,
    patches: RawPatches,
}

#[derive(Deserialize)]
struct RawInputs {
    load: String,
    #[serde(default)]
    held: String,
}

/// As `palpate stiffness` takes it unasked.
fn nearly_incompressible() -> f64 {
    StiffnessParams::default().poisson
}

#[derive(Deserialize)]
struct RawPatches {
    held: RawPatch,
    loaded: RawPatch,
}

#[derive(Deserialize)]
struct RawPatch {
    translation: [f64; 3],
    travel_mm: Option<f64>,
}

/// Reads `stiffness.nii.gz` and `summary.json` of a folder that `palpate stiffness` wrote.
///
/// # Errors
/// [`IoError`] when a file cannot be read or is of another command.
pub fn read_stiffness(folder: impl AsRef<Path>) -> Result<StiffnessFolder, IoError> {
    let folder = folder.as_ref();
    let path = folder.join("summary.json");
    let text = super::source::keyed(&path, 1 << 24, 1 << 20)?;
    told(&path, &text, || read_volume(folder.join("stiffness.nii.gz")))
}

/// The same from what is in memory: the map and the text of the summary.
///
/// # Errors
/// [`IoError`] when the summary is of another command.
pub fn stiffness_folder(map: Volume, summary: &str) -> Result<StiffnessFolder, IoError> {
    told(Path::new("summary"), summary, || Ok(map))
}

fn told(path: &Path, text: &str, map: impl FnOnce() -> Result<Volume, IoError>) -> Result<StiffnessFolder, IoError> {
    let hint = "give the folder that `palpate stiffness` wrote";
    let command: Option<String> = serde_json::from_str::<serde_json::Value>(text)
        .ok()
        .and_then(|v| v.get("command").and_then(|c| c.as_str().map(String::from)));
    if let Some(other) = command.filter(|c| c != "stiffness") {
        return Err(format(path, format!("is of `palpate {other}`"), hint));
    }
    let raw: RawSummary = serde_json::from_str(text).map_err(|e| format(path, e.to_string(), hint))?;
    if !(raw.poisson > 0.0 && raw.poisson < 0.5) {
        return Err(format(path, format!("\"poisson\" is {}, not between 0 and 0.5", raw.poisson), hint));
    }
    Ok(StiffnessFolder {
        map: map()?,
        absolute: raw.absolute,
        regions: raw.regions,
        poisson: raw.poisson,
        load: raw.inputs.load,
        held: raw.inputs.held,
        force_n: raw.force_n,
        travel_mm: raw.patches.loaded.travel_mm,
        translation: [raw.patches.loaded.translation, raw.patches.held.translation],
    })
}

/// Young's modulus (Pa) of a fingertip file.
///
/// # Errors
/// [`IoError`] when the file cannot be read or has none.
pub(crate) fn read_fingertip_modulus(path: impl AsRef<Path>) -> Result<f64, IoError> {
    found_in(path.as_ref(), "youngs_modulus", |table| table.get("youngs_modulus")?.as_float())
}

/// Whether a fingertip file was made with finite elements, and the measured force over theirs (1).
///
/// # Errors
/// [`IoError`] when the file cannot be read or is no such file.
pub fn read_fingertip_press(path: impl AsRef<Path>) -> Result<(bool, f64), IoError> {
    found_in(path.as_ref(), "calibration under [pad]", |table| {
        let pad = table.get("pad")?.as_table()?;
        Some((pad.contains_key("finite_element_nodes"), pad.get("calibration")?.as_float()?))
    })
}

/// What `find` finds in a fingertip file; `what` it is called where it is missing.
fn found_in<T>(path: &Path, what: &str, find: impl Fn(&toml::Table) -> Option<T>) -> Result<T, IoError> {
    let table = super::scene::read_table(path)?;
    find(&table).ok_or_else(|| format(path, format!("has no {what}"), "give a file that `palpate fingertip` wrote"))
}

/// Writes a fingertip for `fingertip.file` of a grasp scene: radius (m) and Young's modulus (Pa) of
/// the hemisphere that presses like the pad, and how it was found under `[pad]`. `calibration` is
/// the measured force over the model's (1 where none was measured); the hemisphere's modulus is
/// multiplied by it.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub fn write_fingertip(
    path: impl AsRef<Path>,
    pad: &PadReduction,
    radius_mm: f64,
    calibration: f64,
    from: &str,
) -> Result<(), IoError> {
    let rows = |k: usize| list(pad.curve.iter().map(|c| c[k]));
    let name = serde_json::to_value(pad.model).ok().and_then(|v| v.as_str().map(String::from)).unwrap_or_default();
    let [uniform, layered, _] = pad.residuals;
    let scaled = |k: usize, by: f64| list(pad.profile.iter().map(|p| by * p[k]));
    let springs = if pad.tabulated() {
        let (depths, moduli) = (scaled(0, 1e-3), scaled(1, 1e3 * calibration));
        format!("model = \"tabulated\"\nprofile_depth = [{depths}]\nprofile_modulus = [{moduli}]")
    } else {
        "model = \"parallel\"".into()
    };
    let modulus = 1e3 * calibration * pad.hemisphere_kpa;
    let mut known = String::new();
    if pad.deviation > 0.0 {
        known += &format!("youngs_modulus_sd = {:.6e}\n", modulus * pad.deviation);
    }
    if let Some([low, high]) = pad.bounds {
        known += &format!("youngs_modulus_bounds = [{:.6e}, {:.6e}]\n", modulus * low, modulus * high);
    }
    let text = format!(
        "# A fingertip for the grasp simulator, from {from}: [fingertip] file = \"this file\"\n\
         # The hemisphere, of one modulus or of unlike springs, whose force is nearest to the pad's. SI units above, mm, kPa and N under [pad].\n\
         radius = {:.6e}\nyoungs_modulus = {:.6e}\n{known}{springs}\n\n\
         [pad]\n\
         model = \"{name}\"          # the smallest of uniform, layered and map whose forces are the map's to 2 %\n\
         calibration = {calibration:.6}        # measured force over the model's, which is the finite elements' where they are below\n\
         effective_kpa = {:.6}      # one modulus in the pad's own shape\n\
         residual_uniform = {uniform:.6}\nresidual_layered = {layered:.6}\nresidual_hemisphere = {:.6}\nresidual_profile = {:.6}\n\
         surface_radius_mm = {}\nthickness_mm = {:.6}\ncolumns = {}\n\
         indentation_mm = [{}]\nforce_n = [{}]\nforce_one_modulus_n = [{}]\n",
        1e-3 * radius_mm,
        modulus,
        pad.effective_kpa,
        pad.hemisphere_residual,
        pad.profile_residual,
        if pad.radius_mm.is_finite() { format!("{:.6}", pad.radius_mm) } else { "inf".into() },
        pad.thickness_mm,
        pad.columns,
        rows(0),
        rows(1),
        rows(2),
    );
    let plate = pad.plate.as_ref().map_or_else(String::new, |plate| {
        let row = |k: usize| list(plate.curve.iter().map(|c| c[k]));
        format!(
            "finite_element_nodes = {}\nfinite_element_indentation_mm = [{}]\nfinite_element_force_n = [{}]\n\
             columns_factor = {:.6}     # columns are free to bulge, tissue is not: their forces times this are nearest to it\n\
             residual_columns = {:.6}\n",
            plate.nodes,
            row(0),
            row(1),
            plate.factor,
            plate.residual,
        )
    });
    write_text(path, &(text + &plate))
}

/// Numbers as they stand between brackets.
fn list(values: impl Iterator<Item = f64>) -> String {
    values.map(|v| format!("{v:.6e}")).collect::<Vec<_>>().join(", ")
}
