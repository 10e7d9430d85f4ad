//! No more model than the data ask for: contact, law and number of regions by evidence.

use crate::error::StiffnessError;
use crate::stiffness::boundary_conditions::{Patch, travel};
use crate::stiffness::geometry::{self, JointStep};
use crate::stiffness::identify::{Estimate, Setup};
use crate::stiffness::mesh_problem::Level;
use crate::stiffness::summary::{self, Scale};
use crate::types::space::dot;
use crate::types::stiffness::{Contact, Evidence, Law, LawChoice, StiffnessParams};

/// Decrease of the information criterion from which a larger model is chosen (Kass and Raftery
/// 1995: more than 10 is very strong).
pub(crate) const MIN_BIC_GAIN: f64 = 10.0;
/// Largest principal strain (95th percentile) for the linear law: its error is of the order of the
/// strain, and exceeds that of a modulus beyond.
const MAX_LINEAR_STRAIN: f64 = 0.05;
/// Identification on the coarse mesh.
struct CoarseSolve {
    /// Tolerance of forward solutions (mm).
    tolerance_mm: f64,
    /// Most iterations.
    max_iterations: usize,
}

const COARSE: CoarseSolve = CoarseSolve { tolerance_mm: 1e-4, max_iterations: 12 };

/// How the open offsets of the shape are moved to the data.
struct ShapeMoves {
    /// Most moves.
    max_count: usize,
    /// Most moves of each law before the two are compared.
    max_per_law: usize,
    /// Largest step (voxels): the derivative holds about as far.
    max_step_voxels: f64,
    /// Smaller steps are left to the last step with all offsets (voxels).
    tolerance_voxels: f64,
}

const SHAPE_MOVES: ShapeMoves =
    ShapeMoves { max_count: 4, max_per_law: 2, max_step_voxels: 2.0, tolerance_voxels: 0.1 };

/// Reduction of the excess squares (ln) that a guided or measured patch must reach: it inherits the
/// field's errors.
const MIN_READ_GAIN_LN: f64 = 0.2;

/// Bulge of a plate out of its plane over the plates' motion: the error of strain is about as
/// large.
const MAX_BULGE_FRACTION: f64 = 0.02;

/// What was chosen on the coarse mesh.
#[derive(Debug)]
pub struct Choice {
    /// The law.
    pub law: Law,
    /// The estimate with it.
    pub estimate: Estimate,
    /// All that was tried.
    pub evidence: Vec<Evidence>,
    /// What to know before trusting it.
    pub warnings: Vec<String>,
}

/// The Bayesian information criterion: `samples` ln(squares / samples) + `parameters` ln(samples).
///
/// ```
/// use palpate::stiffness::model_selection::bic;
/// // Two parameters more are worth it only where they explain enough.
/// let simple = bic(100.0, 1000.0, 2);
/// assert!(bic(99.9, 1000.0, 4) > simple);
/// assert!(bic(90.0, 1000.0, 4) < simple);
/// ```
pub fn bic(squares: f64, samples: f64, parameters: usize) -> f64 {
    samples * (squares.max(1e-300) / samples).ln() + parameters as f64 * samples.max(2.0).ln()
}

/// How a patch may touch, by its measured motion: sticking where it moves as one, else sliding,
/// guided or measured, or any where noise hides it.
fn candidates(level: &Level, patch: &Patch) -> Vec<Contact> {
    let (held, load) = (&level.patches[0], &level.patches[1]);
    let travel = travel(&level.patches);
    let apart: [f64; 3] = std::array::from_fn(|a| load.middle[a] - held.middle[a]);
    let strain = dot(travel, travel).sqrt() / dot(apart, apart).sqrt().max(1e-9);
    // Free sliding spreads a flat face by half the strain.
    let free = 0.5 * strain * patch.radius;
    let flat = !patch.curved();
    let noise = 2.0 * level.surface_error;
    let mut out = if flat && patch.residual[1] < 0.25 * free {
        vec![Contact::Sticking]
    } else if flat && patch.residual[1] < noise {
        // Noise hides whether it slides; what is inside tells.
        vec![Contact::Sticking, Contact::Sliding]
    } else {
        vec![Contact::Sliding, Contact::Guided]
    };
    // What keeps no plane is no plate.
    if flat && patch.bulge() > MAX_BULGE_FRACTION * dot(travel, travel).sqrt() {
        out.push(Contact::Measured);
    }
    out
}

/// How the held and the loaded patch may touch.
fn contacts(level: &Level) -> [Vec<Contact>; 2] {
    [0, 1].map(|i| candidates(level, &level.patches[i]))
}

/// Whether several contacts would be tried.
pub(crate) fn has_rivals(level: &Level) -> bool {
    contacts(level).iter().any(|c| c.len() > 1)
}

/// Lets both patches touch so.
fn touch(level: &mut Level, contact: [Contact; 2]) {
    (level.patches[0].contact, level.patches[1].contact) = (contact[0], contact[1]);
}

/// An estimate with the contact that it was made for.
#[derive(Debug, Clone)]
struct Tried {
    contact: [Contact; 2],
    /// Patches whose motion is read from the field.
    read: usize,
    /// How far the open parts of the shape were moved.
    offsets: Vec<f64>,
    /// Weighted squares with the shape where the data put it.
    squares: f64,
    /// The part of these that is more than noise.
    beyond: f64,
    estimate: Estimate,
}

impl Tried {
    /// An estimate on a level as it is; one without a `rival` needs no squares with another shape.
    fn new(level: &Level, setup: &Setup<'_>, estimate: Estimate, rival: bool) -> Result<Self, StiffnessError> {
        let shaped = if rival { geometry::fit(setup, &estimate, &level.grid, &[], &[])? } else { None };
        let squares = shaped.map_or(estimate.squares, |g| g.fit.squares.min(estimate.squares));
        let contact = [level.patches[0].contact, level.patches[1].contact];
        let read = contact.iter().filter(|c| matches!(c, Contact::Guided | Contact::Measured)).count();
        let noise = setup.noise.unwrap_or(0.0) / estimate.rms.max(f64::MIN_POSITIVE);
        let beyond = (1.0 - noise * noise).max(0.0);
        Ok(Self { contact, read, offsets: level.offsets(), squares, beyond, estimate })
    }

    fn score(&self, samples: f64) -> f64 {
        bic(self.squares, samples, self.estimate.parameters)
    }

    /// The criterion, with what each contact that is read from the field must gain beyond it.
    fn rank(&self, samples: f64) -> f64 {
        self.score(samples) + self.read as f64 * MIN_BIC_GAIN.max(MIN_READ_GAIN_LN * samples * self.beyond)
    }

    fn name(&self) -> String {
        format!("held {}, loaded {}", self.contact[0].name(), self.contact[1].name())
    }
}

/// The one that ranks first; none of none.
fn first_ranked(tried: &[Tried]) -> Option<usize> {
    let samples = tried.iter().map(|t| t.estimate.effective).fold(f64::INFINITY, f64::min);
    (0..tried.len()).min_by(|&i, &k| tried[i].rank(samples).total_cmp(&tried[k].rank(samples)))
}

/// Chooses how the patches touch and the law, on a coarse mesh, which gets the contact chosen.
///
/// # Errors
/// [`StiffnessError`] where no candidate can be solved.
pub fn choose(level: &mut Level, params: &StiffnessParams, reference: usize) -> Result<Choice, StiffnessError> {
    Chooser { level, params, reference, evidence: Vec::new(), warnings: Vec::new() }.run()
}

struct Chooser<'a> {
    level: &'a mut Level,
    params: &'a StiffnessParams,
    reference: usize,
    evidence: Vec<Evidence>,
    warnings: Vec<String>,
}

impl Chooser<'_> {
    fn run(mut self) -> Result<Choice, StiffnessError> {
        let first = if self.params.model == LawChoice::NeoHookean { Law::NeoHookean } else { Law::Linear };
        let (tried, best) = self.contact(first)?;
        self.show_contacts(&tried, best);
        let mut chosen = tried[best].clone();
        self.touch(&chosen);
        let mut law = first;
        if self.params.model == LawChoice::Auto {
            (law, chosen) = self.law(tried, best)?;
        } else {
            let (e, reason) = (&chosen.estimate, "as asked".to_string());
            self.show(shown("law", law.name().into(), e, bic(e.squares, e.effective, e.parameters), true, reason));
        }
        let estimate = settle(
            self.level,
            law,
            self.params,
            self.reference,
            chosen.estimate,
            SHAPE_MOVES.max_count,
            COARSE.tolerance_mm,
        )?;
        Ok(Choice { law, estimate, evidence: self.evidence, warnings: self.warnings })
    }

    fn show(&mut self, evidence: Evidence) {
        log::debug!("{evidence}");
        self.evidence.push(evidence);
    }

    /// Tries every contact under a law, and says which ranks first.
    fn contact(&mut self, law: Law) -> Result<(Vec<Tried>, usize), StiffnessError> {
        let [held, loaded] = contacts(self.level);
        let rivals = held.len() * loaded.len() > 1;
        let mut tried: Vec<Tried> = Vec::new();
        let mut failure = None;
        let mut attempt = |tried: &mut Vec<Tried>, contact: [Contact; 2]| {
            touch(self.level, contact);
            let setup = self.level.setup(law, self.params, self.reference);
            let mut start = setup.start();
            if let Some(last) = tried.last() {
                (start.theta, start.x) = (last.estimate.state.theta.clone(), last.estimate.state.x.clone());
            }
            match setup
                .run(start, COARSE.max_iterations, COARSE.tolerance_mm)
                .and_then(|e| Tried::new(self.level, &setup, e, rivals))
            {
                Ok(one) => tried.push(one),
                Err(e) => failure = Some(e),
            }
        };
        // The loaded patch first: it moves most.
        for &contact in &loaded {
            attempt(&mut tried, [held[0], contact]);
        }
        let along = first_ranked(&tried).map_or(loaded[0], |best| tried[best].contact[1]);
        for &contact in &held[1..] {
            attempt(&mut tried, [contact, along]);
        }
        let best = first_ranked(&tried).ok_or_else(|| failure.unwrap_or(StiffnessError::NoEquilibrium))?;
        Ok((tried, best))
    }

    /// Brings the level to where an estimate was made.
    fn touch(&mut self, tried: &Tried) {
        touch(self.level, tried.contact);
        self.level.move_to(&tried.offsets);
    }

    fn show_contacts(&mut self, tried: &[Tried], best: usize) {
        let samples = tried.iter().map(|t| t.estimate.effective).fold(f64::INFINITY, f64::min);
        for (i, t) in tried.iter().enumerate() {
            let reason = match tried.len() {
                1 => "both patches move as rigid bodies",
                _ if i == best => "explains the field best",
                _ if t.score(samples) < tried[best].score(samples) => {
                    "hardly better, and takes the motion of the patch as read"
                }
                _ => "explains it less",
            };
            self.show(shown("contact", t.name(), &t.estimate, t.score(samples), i == best, reason.into()));
        }
    }

    /// The law that the data ask for, and the contact that holds under it.
    fn law(&mut self, mut tried: Vec<Tried>, best: usize) -> Result<(Law, Tried), StiffnessError> {
        let small = tried[best].estimate.clone();
        let small = settle(
            self.level,
            Law::Linear,
            self.params,
            self.reference,
            small,
            SHAPE_MOVES.max_per_law,
            COARSE.tolerance_mm,
        )?;
        let strain = summary::strain(&self.level.setup(Law::Linear, self.params, self.reference), &small.state);
        let setup = self.level.setup(Law::Linear, self.params, self.reference);
        let small = Tried::new(self.level, &setup, small, true)?;
        let large = self.large_strain_from(&small).or_else(|_| {
            // A shape that was moved far may bear no large strain; what it changes stays to first
            // order.
            self.level.move_back();
            self.large_strain_from(&small)
        });
        let Ok(large) = large else {
            self.touch(&small);
            let e = &small.estimate;
            let criterion = bic(e.squares, e.effective, e.parameters);
            let reason = "no equilibrium was found under the neo-Hookean one".to_string();
            self.show(shown("law", Law::Linear.name().into(), e, criterion, true, reason));
            if strain > MAX_LINEAR_STRAIN {
                self.warnings.push(format!(
                    "strains reach {:.0} %, where the linear law is an approximation, but no equilibrium was found under the neo-Hookean one",
                    100.0 * strain
                ));
            }
            return Ok((Law::Linear, small));
        };
        let samples = small.estimate.effective.min(large.estimate.effective);
        let gain = small.score(samples) - large.score(samples);
        let law = self.judged(strain, gain);
        for (of, t) in [(Law::Linear, &small), (Law::NeoHookean, &large)] {
            let reason = reason(law, gain);
            self.show(shown("law", of.name().into(), &t.estimate, t.score(samples), of == law, reason));
        }
        if law == Law::Linear {
            self.touch(&small);
            return Ok((law, small));
        }
        // A contact that is read from the field must be worth it under the law that is taken.
        let plain = (0..tried.len()).filter(|&i| tried[i].read < tried[best].read);
        let plain = plain.min_by(|&i, &k| tried[i].rank(samples).total_cmp(&tried[k].rank(samples)));
        if let Some(plain) = plain {
            let start = tried.swap_remove(plain);
            self.touch(&start);
            // One that cannot be solved is none.
            if let Ok(rival) = self.large_strain_from(&start) {
                let samples = large.estimate.effective.min(rival.estimate.effective);
                if rival.rank(samples) < large.rank(samples) {
                    let asked = [large.name(), rival.name()];
                    for e in self.evidence.iter_mut().filter(|e| e.question == "contact") {
                        e.chosen = e.model == asked[1];
                        if let Some(k) = asked.iter().position(|name| *name == e.model) {
                            e.reason = LAW_CHANGED_REASONS[k].into();
                        }
                    }
                    return Ok((law, rival));
                }
            }
            self.touch(&large);
        }
        Ok((law, large))
    }

    fn large_strain_from(&mut self, from: &Tried) -> Result<Tried, StiffnessError> {
        let setup = self.level.setup(Law::NeoHookean, self.params, self.reference);
        let large = setup.run(from.estimate.state.clone(), COARSE.max_iterations, COARSE.tolerance_mm)?;
        let large = settle(
            self.level,
            Law::NeoHookean,
            self.params,
            self.reference,
            large,
            SHAPE_MOVES.max_per_law,
            COARSE.tolerance_mm,
        )?;
        let setup = self.level.setup(Law::NeoHookean, self.params, self.reference);
        Tried::new(self.level, &setup, large, true)
    }

    /// The law by what its criterion gains; where that does not tell, by the strain.
    fn judged(&mut self, strain: f64, gain: f64) -> Law {
        let is_large = strain > MAX_LINEAR_STRAIN;
        let percent = 100.0 * strain;
        if gain < -MIN_BIC_GAIN && is_large {
            self.warnings.push(format!(
                "strains reach {percent:.0} %, where the linear law is an approximation, but the data prefer it: Poisson's ratio, \
                 patches or labels may not be as assumed, or the field is not measured; compare with --model neo-hookean"
            ));
        } else if (-MIN_BIC_GAIN..=MIN_BIC_GAIN).contains(&gain) && is_large {
            self.warnings.push(format!(
                "the data do not tell the laws apart; as strains reach {percent:.0} % the neo-Hookean one is taken"
            ));
        }
        if gain > MIN_BIC_GAIN || (is_large && gain >= -MIN_BIC_GAIN) { Law::NeoHookean } else { Law::Linear }
    }
}

/// Why a contact gives way to another once the law is chosen, and why the other is taken.
const LAW_CHANGED_REASONS: [&str; 2] = [
    "explains the field best under small strain alone",
    "explains the field nearly as well under the law that is taken",
];

fn reason(law: Law, gain: f64) -> String {
    match law {
        Law::NeoHookean if gain > MIN_BIC_GAIN => {
            format!("the strain asks for it: the criterion falls by {gain:.0}, {MIN_BIC_GAIN} are needed")
        }
        Law::NeoHookean => "the data do not tell; the strain is past what the linear law bears".into(),
        Law::Linear if gain < -MIN_BIC_GAIN => {
            format!("the linear law explains the field better: the criterion differs by {:.0}", -gain)
        }
        Law::Linear => {
            format!("small strain suffices: the criterion would fall by {gain:.0}, {MIN_BIC_GAIN} are needed")
        }
    }
}

fn shown(question: &'static str, model: String, e: &Estimate, bic: f64, chosen: bool, reason: String) -> Evidence {
    Evidence { question, model, parameters: e.parameters, residual_mm: e.rms, bic, chosen, reason }
}

/// Moves the open parts of the shape to where the data put them, and identifies again, until they
/// stay, or have moved `moves` times. A move stands if it explains the data better, as told by the
/// squares and the penalty of the offsets; else half of it is tried. `precision`: of the
/// forward solutions (mm).
///
/// # Errors
/// As [`crate::stiffness::identify::Setup::run`].
pub(crate) fn settle(
    level: &mut Level,
    law: Law,
    params: &StiffnessParams,
    reference: usize,
    mut estimate: Estimate,
    moves: usize,
    precision: f64,
) -> Result<Estimate, StiffnessError> {
    level.settled = false;
    for _ in 0..moves {
        let setup = level.setup(law, params, reference);
        let far = |step: &JointStep| step.offsets.iter().any(|step| step.abs() > SHAPE_MOVES.tolerance_voxels);
        let Some(step) = JointStep::of(&setup, &estimate)?.filter(far) else { break };
        let step = step.limited(SHAPE_MOVES.max_step_voxels);
        let variance = setup.variance(&estimate);
        let misfit = |level: &Level, e: &Estimate| {
            e.raw * e.squares / variance + level.setup(law, params, reference).prior(&e.state) + level.penalty()
        };
        let (before, least) = (level.offsets(), misfit(level, &estimate));
        let better = [1.0, 0.5].into_iter().find_map(|part| {
            level.move_to(&before.iter().zip(&step.offsets).map(|(b, s)| b + part * s).collect::<Vec<f64>>());
            // A shape that cannot be solved is left alone.
            let setup = level.setup(law, params, reference);
            let start = step.state(&setup, &estimate, part);
            let found = setup.run(start, COARSE.max_iterations, precision).ok()?;
            (misfit(level, &found) < least).then_some(found)
        });
        let Some(better) = better else {
            level.move_to(&before);
            level.settled = true;
            break;
        };
        estimate = better;
    }
    Ok(estimate)
}

/// Identifies again with the shape as it was meshed.
///
/// # Errors
/// As [`crate::stiffness::identify::Setup::run`].
pub(crate) fn as_meshed(
    level: &mut Level,
    law: Law,
    params: &StiffnessParams,
    reference: usize,
    estimate: &Estimate,
) -> Result<Estimate, StiffnessError> {
    level.move_back();
    level.settled = false;
    level.setup(law, params, reference).run(estimate.state.clone(), COARSE.max_iterations, COARSE.tolerance_mm)
}

/// How the scale of given moduli converges; it depends little on what they change.
struct KnownModuli {
    /// Most runs.
    max_runs: usize,
    /// Change of ln E at which they have converged.
    tolerance_ln: f64,
}

const KNOWN_MODULI: KnownModuli = KnownModuli { max_runs: 3, tolerance_ln: 1e-3 };

/// Identifies again with the moduli that are given, beside the one that sets the scale, where the
/// scale puts them.
///
/// # Errors
/// As [`crate::stiffness::identify::Setup::run`].
pub(crate) fn known_moduli(
    level: &mut Level,
    law: Law,
    params: &StiffnessParams,
    reference: usize,
    mut estimate: Estimate,
) -> Result<Estimate, StiffnessError> {
    let scale = Scale::of(&level.body, params);
    let sets = |r: usize| matches!(scale, Scale::Known(known, _) if known == r);
    let given = |label: u8| params.fixed.iter().find(|f| f.0 == label).map(|f| f.1.ln());
    let labels = level.body.labels.clone();
    let others: Vec<(usize, f64)> =
        (0..labels.len()).filter(|&r| !sets(r)).filter_map(|r| Some((r, given(labels[r])?))).collect();
    for _ in 0..KNOWN_MODULI.max_runs {
        let setup = level.setup(law, params, reference);
        let found = summary::moduli(&setup, &estimate, None, scale).log;
        let off = |&(r, e): &(usize, f64)| (r, estimate.state.theta[r] + e - found[r]);
        // Of the reference itself nothing can be moved: the scale says what it is.
        let known: Vec<(u8, f64)> =
            others.iter().filter(|o| o.0 != reference).map(off).map(|(r, t)| (labels[r], t)).collect();
        let change = known.iter().map(|(label, t)| {
            let r = labels.partition_point(|l| l < label);
            (t - estimate.state.theta[r]).abs()
        });
        if change.fold(0.0, f64::max) < KNOWN_MODULI.tolerance_ln {
            break;
        }
        level.known = known;
        let start = estimate.state.clone();
        estimate = level.setup(law, params, reference).run(start, COARSE.max_iterations, COARSE.tolerance_mm)?;
    }
    Ok(estimate)
}
