//! Pressed bodies whose moduli are known, and the stiffness measured on them.

use crate::error::{StiffnessError, SynthError};
use crate::evaluate::mean;
use crate::pipeline::{cpu, stiffness};
use crate::stiffness::boundary_conditions::Place;
use crate::synth::{Phantom, PhantomKind, PhantomParams, phantom};
use crate::types::stiffness::{RegionStiffness, Side};
use crate::types::{DenseField, Mask, Part, SparseField, StiffnessParams, StiffnessResult, Trial};

/// A pressed body whose moduli are known, as the stiffness takes it.
pub struct Pressed {
    /// Its name.
    pub name: String,
    /// The body.
    pub phantom: Phantom,
    held: Place,
    load: Place,
    /// Force on the pressed side (N).
    pub force_n: f64,
}

impl Pressed {
    /// An elastic phantom.
    ///
    /// # Errors
    /// As [`phantom()`]; [`SynthError::NotElastic`] where nothing is known of its stiffness.
    pub fn new(params: &PhantomParams) -> Result<Self, SynthError> {
        let phantom = phantom(params)?;
        let known = phantom.description.elastic.as_ref().map(|e| (Side::parse(e.held), Side::parse(e.load), e.force_n));
        let Some((Some(held), Some(load), force)) = known else { return Err(SynthError::NotElastic) };
        let name = format!("{:?}", params.kind).to_lowercase();
        Ok(Self { name, phantom, held: Place::Side(held), load: Place::Side(load), force_n: force.abs() })
    }

    /// Takes the body to be held on the patch that `mask` covers.
    pub fn hold_at(&mut self, mask: Mask, name: &str) {
        self.held = Place::Mask(Box::new(mask), name.into());
    }

    /// Region by region from `field` on the phantom's grid, by `labels`; with `matches`, they count
    /// in place of the field inside the body.
    ///
    /// # Errors
    /// As [`stiffness::run`].
    pub fn measure(
        &self,
        field: &DenseField,
        matches: Option<&SparseField>,
        labels: &Mask,
        params: &StiffnessParams,
    ) -> Result<StiffnessResult, StiffnessError> {
        let names = |label: u8| format!("region {label}");
        let (held, load) = (&self.held, &self.load);
        let inputs = stiffness::Inputs {
            field,
            matches,
            labels,
            labelled: true,
            held,
            load,
            names: &names,
            quality: stiffness::FieldQuality::default(),
        };
        stiffness::run(&inputs, params, &|_, _| {})
    }

    /// True Young's modulus of a label (kPa).
    pub fn modulus(&self, label: u8) -> f64 {
        let regions = self.phantom.description.elastic.iter().flat_map(|e| &e.regions);
        regions.filter(|r| r.label == label).map(|r| r.youngs_modulus_kpa).next().unwrap_or(f64::NAN)
    }

    /// Error of each region's modulus (per cent).
    pub fn errors(&self, result: &StiffnessResult) -> Vec<f64> {
        let error = |r: &RegionStiffness| 100.0 * (r.youngs_modulus / self.modulus(r.label) - 1.0).abs();
        result.regions.iter().map(error).collect()
    }
}

/// Moduli from exact displacements against the nodes of the mesh: a ball in a block and layers
/// under a punch.
///
/// # Errors
/// As [`phantom()`].
pub(crate) fn stiffness_trials(
    side: usize,
    budgets: &[usize],
    progress: &dyn Fn(f64),
) -> Result<Vec<Trial>, SynthError> {
    let mut out = Vec::new();
    let kinds = [PhantomKind::Inclusion, PhantomKind::Slab];
    for (k, kind) in kinds.into_iter().enumerate() {
        let body = Pressed::new(&PhantomParams::new(kind).sized(side))?;
        let Some(known) = &body.phantom.stiffness else { continue };
        for (i, &nodes) in budgets.iter().enumerate() {
            let params = StiffnessParams { nodes, force_n: Some(body.force_n), ..StiffnessParams::default() };
            let (result, cpu_s) = cpu::timed(|| body.measure(&body.phantom.truth, None, &known.labels, &params));
            let found = result.as_ref().map(|r| mean(&body.errors(r)));
            out.push(Trial {
                part: Part::Stiffness,
                varied: "nodes",
                method: format!("{nodes} nodes"),
                settings: format!("--nodes {nodes}, labels and force given, exact displacement"),
                case: body.name.clone(),
                error: found.unwrap_or(f64::NAN),
                error_p95: None,
                gradient_error: None,
                nothing: None,
                size: result.as_ref().map_or(nodes, |r| r.mesh.nodes().len()),
                cpu_s,
                whole: false,
                failure: result.err().map(|e| e.to_string()),
            });
            progress((k as f64 + (i + 1) as f64 / budgets.len() as f64) / kinds.len() as f64);
        }
    }
    Ok(out)
}
