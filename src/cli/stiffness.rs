//! `palpate stiffness`: a displacement field to Young's modulus.

use super::Usage;
use super::console::Console;
use super::convention::Convention;
use super::dry_run;
use super::inputs::{Part, check_distinct, file_of, name, on_grid, read_labels, read_mask, standing_for, warn_all};
use super::limits::mesh_fits;
use super::mesh_option::{self, MeshOption};
use super::record::{self, Read, Recording};
use anyhow::{Context, Result, bail};
use clap::Args;
use palpate::error::Shown;
use palpate::error::StiffnessError;
use palpate::io::{self, OutputFolder};
use palpate::pipeline;
use palpate::pipeline::stiffness::{FieldQuality, Inputs, MIN_MATCHES_IN_BODY, inside};
use palpate::report::record::{in_summary, on_page};
use palpate::report::stiffness as report;
use palpate::stiffness::boundary_conditions::Place;
use palpate::types::stiffness::{Forecast, LawChoice, Side};
use palpate::types::{
    DenseField, ErrorSamples, Grid, Mask, MotionModel, SparseField, StiffnessParams, StiffnessResult, Trust, Volume,
};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// What is written.
pub(super) const FILES: [&str; 12] = [
    "stiffness.nii.gz",
    "stiffness_sd.nii.gz",
    "residual.nii.gz",
    "regions.csv",
    "mesh.vtu",
    "model.feb",
    "model.inp",
    "model.scn",
    "model.xml",
    "model.msh",
    "summary.json",
    "report.html",
];

/// What is written beside it where regions were looked for.
pub(super) const FOUND: &str = "regions.nii.gz";

#[derive(Debug, Args)]
pub struct Options {
    /// Displacement field, initial to deformed (5-D NIfTI, LPS mm), or a folder of palpate field
    #[arg(long, value_name = "F", required_unless_present = "sequence")]
    field: Option<PathBuf>,
    /// A folder of palpate track: one stiffness map for all its frames
    #[arg(long, value_name = "DIR", conflicts_with_all = ["field", "matches", "force", "mask"])]
    sequence: Option<PathBuf>,
    /// Sequence: total force in each frame but the reference, in order, lost ones too, in N (0: at
    /// rest); without, moduli are ratios
    #[arg(long, value_name = "N,N,...", requires = "sequence", value_delimiter = ',', allow_hyphen_values = true)]
    pub(super) forces: Vec<f64>,
    /// Matches to use inside the body, with their precision, in place of the field, which
    /// smoothness flattens; none for the field itself
    /// [default: matches.csv of the same results of palpate field, if any]
    #[arg(long, value_name = "M.csv|none", value_parser = standing_for(Part::Matches))]
    matches: Option<PathBuf>,
    /// The body: a mask on the field's grid; regions are then looked for
    #[arg(
        long,
        value_name = "M",
        conflicts_with = "labels",
        required_unless_present_any = ["labels", "sequence"],
        value_parser = standing_for(Part::Mask)
    )]
    mask: Option<PathBuf>,
    /// Regions: a label map on the field's grid, 0 outside
    #[arg(long, value_name = "L", value_parser = standing_for(Part::Labels))]
    pub(super) labels: Option<PathBuf>,
    /// Names of the labels, as 1=skin,2=fat (or with ; between, as a table of pairs has them)
    #[arg(long, value_name = "NAMES", requires = "labels")]
    names: Option<String>,
    /// Where the body is held: x-, x+ ... z+ in world axes, or a mask that covers the patch
    #[arg(long, value_name = "AXIS|FILE", default_value = "z-", allow_hyphen_values = true)]
    pub(super) held: String,
    /// Where it is pressed, in the same way
    #[arg(long, value_name = "AXIS|FILE", default_value = "z+", allow_hyphen_values = true)]
    pub(super) load: String,
    /// Total force on the loaded patch in N, its magnitude; without, moduli are ratios
    #[arg(long = "total-force", alias = "force", value_name = "N", allow_negative_numbers = true)]
    force: Option<f64>,
    /// Poisson's ratio of all regions, or LABEL=NU of one; may be given several times
    /// [default: 0.49]
    #[arg(long, value_name = "NU|LABEL=NU", value_delimiter = ',', allow_hyphen_values = true)]
    poisson: Vec<String>,
    /// Young's modulus of a label that is known (bone, a calibrated pad), in kPa: it is not sought,
    /// and without a force it sets the scale; may be given several times
    #[arg(long, value_name = "LABEL=KPA", value_delimiter = ',', requires = "labels")]
    fixed: Vec<String>,
    /// A table of what is known by label: columns label, and poisson or youngs_modulus_kpa or both;
    /// an empty field is open
    #[arg(long, value_name = "TABLE.csv", requires = "labels")]
    materials: Option<PathBuf>,
    /// One standard deviation of the border between two labels, in voxels: how well whoever drew
    /// them knew it
    #[arg(long, value_name = "VOXELS", default_value_t = StiffnessParams::default().label_sd)]
    label_sd: f64,
    /// linear, neo-hookean, or auto: the one that explains the field better
    #[arg(long, default_value = "auto")]
    model: LawChoice,
    /// Nodes of the mesh, about; 500 to 500,000
    #[arg(long, value_name = "N", default_value_t = StiffnessParams::default().nodes)]
    nodes: usize,
    /// Regions to try at most without labels, 1 to 8 [default: 4]
    #[arg(long, value_name = "N")]
    regions: Option<usize>,
    /// Volume to show behind the maps in report.html; may be given several times [default:
    /// warped.nii.gz of the same results of palpate field, if any: the deformed volume drawn back
    /// to where the initial one lies]
    #[arg(long = "image", value_name = "FILE")]
    pub(super) images: Vec<PathBuf>,
    /// Folder for the results
    #[arg(short, long, value_name = "DIR")]
    pub(super) output: PathBuf,
    /// Write into a folder that is not empty
    #[arg(long)]
    pub(super) overwrite: bool,
    /// Exit with 1 where trust in the result is low
    #[arg(long)]
    strict: bool,
    /// Check everything, say what would be done, and write nothing
    #[arg(long)]
    pub(super) dry_run: bool,
    #[command(flatten)]
    convention: Convention,
    #[command(flatten)]
    mesh: MeshOption,
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { model, force, nodes, regions, label_sd, .. } = *options;
    let usual = StiffnessParams::default();
    let known = Materials::of(options)?;
    let params = StiffnessParams {
        poisson: known.poisson.unwrap_or(usual.poisson),
        poisson_of: known.poisson_of,
        fixed: known.fixed,
        label_sd,
        model,
        force_n: force,
        nodes,
        regions: regions.unwrap_or(usual.regions),
    };
    params.check()?;
    if console.arguments().iter().any(|a| a == "--force" || a.starts_with("--force=")) {
        warn_all(console, &["--force is called --total-force now; the old name goes with the next release".into()]);
    }
    if regions.is_some() && options.labels.is_some() {
        warn_all(console, &["--regions changes nothing with --labels, which say what the regions are".into()]);
    }
    mesh_fits(params.nodes)?;
    if options.sequence.is_some() && options.labels.is_none() {
        bail!(Usage(
            "--sequence needs --labels: regions that each frame found for itself would not be the same ones".into()
        ));
    }
    // Clap drops a requirement that conflicts with what is given.
    if !options.forces.is_empty() && options.sequence.is_none() {
        bail!(Usage("--forces belongs to --sequence; for a single field give --total-force".into()));
    }
    let body = options.labels.as_ref().or(options.mask.as_ref());
    let Some(body) = body else { bail!(Usage("give --labels or --mask".into())) };
    match (&options.sequence, &options.field) {
        (Some(folder), _) => super::stiffness_sequence::run(options, &params, folder, body, console),
        (None, Some(field)) => one(options, &params, field, body, console),
        (None, None) => bail!(Usage("give --field or --sequence".into())),
    }
}

/// Files named for the patches.
pub(super) fn patch_files(options: &Options) -> Vec<PathBuf> {
    let named = [&options.held, &options.load].into_iter().filter(|t| Side::parse(t).is_none());
    named.map(PathBuf::from).collect()
}

/// What is read of a single field as of a sequence.
pub(super) fn common_inputs(options: &Options) -> Read {
    let mut inputs = record::inputs(&[
        ("labels", options.labels.as_ref()),
        ("mask", options.mask.as_ref()),
        ("field_deformed", options.convention.deformed()),
        ("mesh", options.mesh.path()),
    ]);
    let patches = [("held", &options.held), ("load", &options.load)];
    let files = patches.into_iter().filter(|(_, text)| Side::parse(text).is_none());
    inputs.extend(files.filter_map(|(role, text)| Some((role, file_of(Path::new(text), Part::Mask).ok()?))));
    inputs.extend(options.images.iter().map(|p| ("image", p.clone())));
    inputs
}

/// Volumes for the report, on `grid`: those asked for, or what was found `beside` the field; that
/// is left out where it cannot be shown.
pub(super) fn images(options: &Options, beside: Option<&Path>, grid: &Grid) -> Result<Vec<(String, Volume)>> {
    let read = |path: &Path| -> Result<Volume> {
        let shown = on_grid(io::read_volume(path)?, grid);
        if !shown.as_slice().iter().any(|v| v.is_finite() && *v != 0.0) {
            bail!("{}: shows nothing where the field lies; check the file and its affine", path.shown());
        }
        Ok(shown)
    };
    if options.images.is_empty() {
        let found = beside.and_then(|path| read(path).ok());
        return Ok(found.map(|volume| ("warped".into(), volume)).into_iter().collect());
    }
    options.images.iter().map(|path| Ok((name(path), read(path)?))).collect()
}

/// Says what would be done with a field, or with the first of a sequence, whose forces are given.
pub(super) fn plan(
    options: &Options,
    params: &StiffnessParams,
    field: &Path,
    setting: &Setting,
    frames: &[Option<f64>],
    forecast: &Forecast,
    console: &Console,
) -> Result<()> {
    OutputFolder::check(&options.output, options.overwrite)?;
    let sides = [options.held.as_str(), &options.load];
    let more: &[&str] = match (frames.is_empty(), setting.labelled) {
        (false, _) => &["frames.csv"],
        (true, false) => &[FOUND],
        (true, true) => &[],
    };
    let files = [&FILES[..], more].concat();
    warn_all(console, &setting.notes);
    console.say(&dry_run::stiffness(
        field,
        (&setting.labels, setting.labelled),
        params,
        sides,
        frames,
        forecast,
        &options.output,
        &files,
    ));
    Ok(())
}

fn one(options: &Options, params: &StiffnessParams, field: &Path, body: &Path, console: &Console) -> Result<()> {
    let mut source = Source::of(field, options.matches.as_deref())?;
    let patches = patch_files(options);
    let given: Vec<&Path> = [Some(source.field.as_path()), Some(body), source.matches.as_deref()]
        .into_iter()
        .flatten()
        .chain(patches.iter().chain(&options.images).chain(options.mesh.path()).map(PathBuf::as_path))
        .collect();
    let results: Vec<PathBuf> =
        FILES.iter().chain(&[FOUND]).chain(&mesh_option::FILES).map(|f| options.output.join(f)).collect();
    check_distinct(&given, &results)?;

    let started = Instant::now();
    let progress = console.progress();
    progress.set("read", 0.0);
    let field = options.convention.read(&source.field)?;
    let setting = Setting::read(options, params, body, field.grid(), &source.field)?;
    let mut matches = source.matches.as_ref().map(io::read_matches).transpose()?;
    if options.matches.is_none() && matches.as_ref().is_some_and(|m| !setting.holds_enough(m)) {
        console.detail(&format!("fewer than {MIN_MATCHES_IN_BODY} matches in the body: the field itself is taken"));
        (matches, source.matches) = (None, None);
    }
    let images = images(options, source.image.as_deref(), field.grid())?;
    let on_mesh = options.mesh.measure(&field, &setting.labels, &source.field)?;
    if options.dry_run {
        let forecast = setting.forecast(&field, params);
        let forecast = forecast.with_context(|| format!("{} with {}", name(&source.field), name(body)))?;
        drop(progress);
        return plan(options, params, &source.field, &setting, &[], &forecast, console);
    }
    let mut folder = OutputFolder::create(&options.output, options.overwrite)?;
    let mut inputs = record::inputs(&[("field", Some(&source.field)), ("matches", source.matches.as_ref())]);
    inputs.extend(common_inputs(options));
    if options.images.is_empty() {
        inputs.extend(source.image.iter().map(|p| ("image", p.clone())));
    }
    inputs.extend(source.summary.iter().chain(&source.samples).map(|p| ("field", p.clone())));
    let record = Recording::start(console, inputs);
    // Of a sequence, or of another mesh.
    folder.supersede(|file| file == "frames.csv" || file == FOUND || mesh_option::FILES.contains(&file))?;
    let read = started.elapsed().as_secs_f64();

    let quality = Quality::of(&source)?;
    let result = setting.run(&field, matches.as_ref(), quality.told(), params, &|s, f| progress.set(s, f));
    let mut result = result.with_context(|| format!("{} with {}", name(&source.field), name(body)))?;
    result.seconds.insert(0, ("read".into(), read));
    result.warnings.splice(0..0, setting.notes.iter().cloned());
    progress.set("write", 1.0);
    let names = report::InputNames {
        field: name(&source.field),
        body: name(body),
        matches: source.matches.as_deref().map(name),
        held: options.held.clone(),
        load: options.load.clone(),
    };
    write(&mut folder, &mut result)?;
    if let Some(on_mesh) = on_mesh {
        let labels = result.found.as_ref().unwrap_or(&setting.labels);
        let said = on_mesh.write(&mut folder, labels, &result)?;
        result.warnings.extend(said);
    }
    let record = record.finish();
    let told = in_summary(report::summary(&result, &names), &record);
    folder.write("summary.json", |p| io::write_json(p, &told))?;
    let page = report::page(&result, &names, &report::Shown { field: Some(&field), images: &images })?;
    folder.write("report.html", |p| io::write_text(p, &on_page(page, &record)))?;
    folder.commit()?;
    drop(progress);
    warn_all(console, &result.warnings);
    let used = match &source.matches {
        Some(path) if options.matches.is_none() => {
            format!("  data         {} beside the field; --matches none takes the field itself\n", name(path))
        }
        _ => String::new(),
    };
    let page = options.output.join("report.html");
    console.say(&format!("{}{used}  results      {}", report::text(&result), page.shown()));
    strict(options, &result)
}

/// Refuses a result of low trust, once it is written, where that was asked for.
pub(super) fn strict(options: &Options, result: &StiffnessResult) -> Result<()> {
    if options.strict && result.trust == Trust::Low {
        bail!("--strict: trust in the moduli is low: {}", result.trust_reasons.join("; "));
    }
    Ok(())
}

/// Where the motion is read from.
struct Source {
    field: PathBuf,
    matches: Option<PathBuf>,
    /// The deformed volume drawn back to where the initial one lies.
    image: Option<PathBuf>,
    /// What the field's own results say of its error.
    summary: Option<PathBuf>,
    samples: Option<PathBuf>,
}

/// What is known of a field's own error.
#[derive(Debug, Default)]
pub(super) struct Quality {
    trust: Option<Trust>,
    model: Option<MotionModel>,
    samples: Option<ErrorSamples>,
}

impl Quality {
    fn of(source: &Source) -> Result<Self> {
        let summary = source.summary.as_ref().map(io::read_json).transpose()?.unwrap_or_default();
        Ok(Self {
            trust: serde_json::from_value(summary["trust"].clone()).ok(),
            model: serde_json::from_value(summary["model"].clone()).ok(),
            samples: source.samples.as_ref().map(io::read_samples).transpose()?,
        })
    }

    fn told(&self) -> FieldQuality<'_> {
        FieldQuality { trust: self.trust, model: self.model, samples: self.samples.as_ref() }
    }
}

impl Source {
    /// The matches of the same results are taken where none are named: the field between them is
    /// smoothed, which flattens strain and with it a contrast.
    fn of(given: &Path, matches: Option<&Path>) -> Result<Self> {
        let field = file_of(given, Part::Field)?;
        let ours = given.is_dir() || field.file_name().is_some_and(|n| n == "displacement.nii.gz");
        let ours = ours && field.with_file_name("summary.json").is_file();
        let beside = |file: &str| Some(field.with_file_name(file)).filter(|f| ours && f.is_file());
        let matches = match matches {
            Some(path) if path.as_os_str() == "none" => None,
            Some(path) => Some(path.to_path_buf()),
            None => beside("matches.csv"),
        };
        Ok(Self {
            image: beside("warped.nii.gz"),
            summary: beside("summary.json"),
            samples: beside("posterior.nii.gz"),
            matches,
            field,
        })
    }
}

/// What holds for every field of a run.
pub(super) struct Setting {
    pub(super) labels: Mask,
    labelled: bool,
    held: Place,
    load: Place,
    names: Vec<String>,
    /// What was resampled.
    pub(super) notes: Vec<String>,
}

impl Setting {
    /// Whether the body holds matches enough to go by them in place of the field.
    pub(super) fn holds_enough(&self, matches: &SparseField) -> bool {
        inside(matches, &self.labels) >= MIN_MATCHES_IN_BODY
    }

    pub(super) fn read(
        options: &Options,
        params: &StiffnessParams,
        body: &Path,
        grid: &Grid,
        reference: &Path,
    ) -> Result<Self> {
        let mut notes = Vec::new();
        let labels = match &options.labels {
            Some(labels) => read_labels(labels, grid, reference, &mut notes)?,
            None => {
                let mut mask = read_mask(body, grid, reference, &mut notes)?;
                mask.as_mut_slice().iter_mut().for_each(|v| *v = u8::from(*v > 0));
                mask
            }
        };
        let held = place(&options.held, grid, reference, "--held", &mut notes)?;
        let load = place(&options.load, grid, reference, "--load", &mut notes)?;
        let names = names(options.names.as_deref(), &labels)?;
        if let Some(label) = params.label_not_in(&labels).filter(|_| options.materials.is_none()) {
            bail!(Usage(format!("--poisson and --fixed: the label map holds no label {label}")));
        }
        Ok(Self { labels, labelled: options.labels.is_some(), held, load, names, notes })
    }

    /// The pipeline's view of it with `field`.
    pub(super) fn run(
        &self,
        field: &DenseField,
        matches: Option<&SparseField>,
        quality: FieldQuality<'_>,
        params: &StiffnessParams,
        progress: pipeline::stiffness::Progress<'_>,
    ) -> Result<StiffnessResult, StiffnessError> {
        self.with(field, matches, quality, |inputs| pipeline::stiffness::run(inputs, params, progress))
    }

    /// What [`Self::run`] would take.
    pub(super) fn forecast(&self, field: &DenseField, params: &StiffnessParams) -> Result<Forecast, StiffnessError> {
        self.with(field, None, FieldQuality::default(), |inputs| pipeline::dry_run::stiffness(inputs, params))
    }

    fn with<T>(
        &self,
        field: &DenseField,
        matches: Option<&SparseField>,
        quality: FieldQuality<'_>,
        run: impl FnOnce(&Inputs<'_>) -> T,
    ) -> T {
        run(&Inputs {
            field,
            matches,
            labels: &self.labels,
            labelled: self.labelled,
            held: &self.held,
            load: &self.load,
            names: &|label| self.names[label as usize].clone(),
            quality,
        })
    }
}

pub(super) fn place(text: &str, grid: &Grid, reference: &Path, flag: &str, notes: &mut Vec<String>) -> Result<Place> {
    match Side::parse(text) {
        Some(side) => Ok(Place::Side(side)),
        None => {
            let path = Path::new(text);
            if !path.exists() {
                bail!("{flag} {text}: is neither a side (x-, x+, y-, y+, z-, z+) nor a file; check the spelling");
            }
            let path = &file_of(path, Part::Mask).with_context(|| format!("{flag} {text}"))?;
            let mask = read_mask(path, grid, reference, notes).with_context(|| format!("{flag} {text}"))?;
            Ok(Place::Mask(Box::new(mask), name(path)))
        }
    }
}

/// What is known of the regions' materials.
#[derive(Debug, Default)]
struct Materials {
    poisson: Option<f64>,
    poisson_of: Vec<(u8, f64)>,
    fixed: Vec<(u8, f64)>,
}

impl Materials {
    /// From a table, and from what is given beside it, which comes first.
    fn of(options: &Options) -> Result<Self> {
        let mut out = Self::default();
        for text in &options.poisson {
            match text.split_once('=') {
                None => out.poisson = Some(number(text, "--poisson", "0.49 or 1=0.49")?),
                Some((label, nu)) => put(&mut out.poisson_of, label, nu, "--poisson", "1=0.49")?,
            }
        }
        for text in &options.fixed {
            let Some((label, e)) = text.split_once('=') else {
                bail!(Usage(format!("--fixed: {text:?} is not of the form 3=15000 (label, kPa)")));
            };
            put(&mut out.fixed, label, e, "--fixed", "3=15000")?;
        }
        if let Some(path) = &options.materials {
            for row in io::read_materials(path)? {
                let known = |all: &[(u8, f64)]| all.iter().any(|k| k.0 == row.label);
                let [poisson, fixed] = [known(&out.poisson_of), known(&out.fixed)];
                out.poisson_of.extend(row.poisson.filter(|_| !poisson).map(|nu| (row.label, nu)));
                out.fixed.extend(row.youngs_modulus.filter(|_| !fixed).map(|e| (row.label, e)));
            }
        }
        Ok(out)
    }
}

pub(super) fn number(text: &str, flag: &str, form: &str) -> Result<f64> {
    text.trim().parse().map_err(|_| Usage(format!("{flag}: {text:?} is not of the form {form}")).into())
}

pub(super) fn put(all: &mut Vec<(u8, f64)>, label: &str, value: &str, flag: &str, form: &str) -> Result<()> {
    let Ok(label) = label.trim().parse::<u8>() else {
        bail!(Usage(format!("{flag}: {label:?} is no label (1 to 255); write it as {form}")));
    };
    if all.iter().any(|known| known.0 == label) {
        bail!(Usage(format!("{flag}: label {label} is given twice")));
    }
    all.push((label, number(value, flag, form)?));
    Ok(())
}

/// A name for every label; separated as on a command line or as in a table of pairs.
pub(super) fn names(given: Option<&str>, labels: &Mask) -> Result<Vec<String>> {
    let mut out: Vec<String> = (0..256).map(|l| format!("region {l}")).collect();
    for pair in given.into_iter().flat_map(|g| g.split([',', ';'])) {
        let parsed = pair.split_once('=').and_then(|(l, n)| Some((l.trim().parse::<u8>().ok()?, n.trim())));
        let Some((label, text)) = parsed.filter(|p| !p.1.is_empty()) else {
            bail!(Usage(format!("--names: {pair:?} is not of the form 1=skin")));
        };
        if !labels.as_slice().contains(&label) {
            bail!(Usage(format!("--names: the label map holds no label {label}")));
        }
        out[label as usize] = text.into();
    }
    Ok(out)
}

pub(super) fn write(folder: &mut OutputFolder, result: &mut StiffnessResult) -> Result<()> {
    let started = Instant::now();
    let about = match result.absolute {
        true => "palpate: Young's modulus, kPa",
        false => "palpate: Young's modulus over the reference region's (a ratio)",
    };
    folder.write("stiffness.nii.gz", |p| io::write_volume(p, &result.map, about))?;
    folder.write("stiffness_sd.nii.gz", |p| {
        io::write_volume(p, &result.map_sd, &about.replace("palpate:", "palpate: sd of"))
    })?;
    folder
        .write("residual.nii.gz", |p| io::write_volume(p, &result.residual, "palpate: length of the residual, mm"))?;
    if let Some(found) = &result.found {
        folder.write(FOUND, |p| io::write_labels(p, found, "palpate: regions found without labels"))?;
    }
    folder.write("regions.csv", |p| io::write_regions(p, &result.regions, result.absolute))?;
    let modulus: Vec<f32> = result.element_modulus.iter().map(|&e| e as f32).collect();
    let label: Vec<f32> = result.mesh.labels().iter().map(|&l| f32::from(l)).collect();
    let data = [("youngs_modulus", modulus.as_slice()), ("label", label.as_slice())];
    folder.write("mesh.vtu", |p| io::write_quadratic_mesh(p, &result.mesh, &result.displacement, &data))?;
    folder.write("model.feb", |p| io::write_feb(p, result))?;
    folder.write("model.inp", |p| io::write_inp(p, result))?;
    folder.write("model.scn", |p| io::write_sofa(p, result))?;
    folder.write("model.xml", |p| io::write_mjcf(p, result))?;
    folder.write("model.msh", |p| io::write_msh(p, result))?;
    result.seconds.push(("write".into(), started.elapsed().as_secs_f64()));
    Ok(())
}
