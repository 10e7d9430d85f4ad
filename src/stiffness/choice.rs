//! No more model than the data ask for: contact, law and number of regions by evidence.

use crate::error::StiffnessError;
use crate::stiffness::geometry::edge_step;
use crate::stiffness::identify::{Estimate, State};
use crate::stiffness::level::Level;
use crate::stiffness::patches::{Patch, travel};
use crate::stiffness::summary;
use crate::types::space::dot;
use crate::types::stiffness::{Contact, Evidence, Law, LawChoice};

/// A model must beat a smaller one by this much (Kass and Raftery 1995: more than 10 is very
/// strong).
pub const MARGIN: f64 = 10.0;
/// Largest principal strain (95th percentile over the body) up to which the law is left to the
/// data. What a linear law leaves out is of the order of the strain (4.71 for a contrast of 5 at 7
/// %), and a field from images is off by more than tells the two apart.
const SMALL_STRAIN: f64 = 0.05;
/// Precision of forward solutions on the coarse mesh (mm).
const COARSE: f64 = 1e-4;
/// Iterations at most on the coarse mesh.
const ITERATIONS: usize = 12;

/// Moves of a punch's edge at most.
const MOVES: usize = 4;
/// Those of each law before the two are compared: the law that is chosen goes on.
const LAW_MOVES: usize = 2;
/// Length of one at most (voxels): the difference that it is taken from is linear about as far.
const LONGEST: f64 = 2.0;
/// Shorter ones are left to the last step with all offsets (voxels).
const SETTLED: f64 = 0.1;

/// A guided patch takes over what the field says along the plate, with its errors: the squares must
/// fall by so much (in ln).
const DECISIVE: f64 = 0.2;

/// What was chosen on the coarse mesh.
#[derive(Debug)]
pub struct Choice {
    /// The law.
    pub law: Law,
    /// The estimate with it.
    pub estimate: Estimate,
    /// All that was tried.
    pub evidence: Vec<Evidence>,
}

/// The Bayesian information criterion: `samples` ln(squares / samples) + `parameters` ln(samples).
pub fn bic(squares: f64, samples: f64, parameters: usize) -> f64 {
    samples * (squares.max(1e-300) / samples).ln() + parameters as f64 * samples.max(2.0).ln()
}

/// How a patch may touch, by its measured motion: sticking where it moves as one, else sliding or
/// guided, or either where noise hides it.
fn candidates(level: &Level) -> [Vec<Contact>; 2] {
    let [held, load] = &level.patches;
    let travel = travel(&level.patches);
    let apart: [f64; 3] = std::array::from_fn(|a| load.middle[a] - held.middle[a]);
    let strain = dot(travel, travel).sqrt() / dot(apart, apart).sqrt().max(1e-9);
    let one = |patch: &Patch| {
        // Free sliding spreads a flat face by half the strain.
        let free = 0.5 * strain * patch.radius;
        let flat = !patch.curved();
        if flat && patch.residual[1] < 0.25 * free {
            vec![Contact::Sticking]
        } else if flat && patch.residual[1] < 2.0 * level.surface_error {
            // Noise hides whether it slides; what is inside tells.
            vec![Contact::Sticking, Contact::Sliding]
        } else {
            vec![Contact::Sliding, Contact::Guided]
        }
    };
    [one(held), one(load)]
}

/// Lets both patches touch so.
fn touch(level: &mut Level, contact: [Contact; 2]) {
    (level.patches[0].contact, level.patches[1].contact) = (contact[0], contact[1]);
}

/// Numbers that guided patches are given: twelve each.
fn given(contact: [Contact; 2]) -> usize {
    12 * contact.iter().filter(|c| **c == Contact::Guided).count()
}

/// The estimate under large strain from another one.
///
/// # Errors
/// As [`crate::stiffness::identify::Setup::run`].
fn large_strain_from(
    level: &mut Level,
    start: State,
    poisson: f64,
    reference: usize,
) -> Result<Estimate, StiffnessError> {
    let large = level.setup(Law::NeoHookean, poisson, reference).run(start, ITERATIONS, COARSE)?;
    settle(level, Law::NeoHookean, poisson, reference, large, (LAW_MOVES, COARSE))
}

/// Chooses how the patches touch and the law, on a coarse mesh. The patches of `level` get the
/// contact chosen.
///
/// # Errors
/// [`StiffnessError`] where no candidate can be solved.
pub fn choose(level: &mut Level, wanted: LawChoice, poisson: f64, reference: usize) -> Result<Choice, StiffnessError> {
    let mut evidence = Vec::new();
    let names = candidates(level);
    let first = if wanted == LawChoice::NeoHookean { Law::NeoHookean } else { Law::Linear };
    let mut tried: Vec<([Contact; 2], Estimate)> = Vec::new();
    let mut failure = None;
    for &a in &names[0] {
        for &b in &names[1] {
            touch(level, [a, b]);
            let setup = level.setup(first, poisson, reference);
            let mut start = setup.start();
            if let Some((_, last)) = tried.last() {
                (start.theta, start.x) = (last.state.theta.clone(), last.state.x.clone());
            }
            match setup.run(start, ITERATIONS, COARSE) {
                Ok(e) => tried.push(([a, b], e)),
                Err(e) => failure = Some(e),
            }
        }
    }
    let samples = tried.iter().map(|t| t.1.effective).fold(f64::INFINITY, f64::min);
    let count = |t: &([Contact; 2], Estimate)| t.1.parameters + given(t.0);
    let score = |t: &([Contact; 2], Estimate)| bic(t.1.squares, samples, count(t));
    let guided = |t: &([Contact; 2], Estimate)| t.0.contains(&Contact::Guided);
    let rank = |t| score(t) + if guided(t) { DECISIVE * samples } else { 0.0 };
    let best = (0..tried.len()).fold(None, |m: Option<usize>, i| match m {
        Some(k) if rank(&tried[k]) <= rank(&tried[i]) => Some(k),
        _ => Some(i),
    });
    let Some(best) = best else { return Err(failure.unwrap_or(StiffnessError::NoEquilibrium)) };
    for (i, t) in tried.iter().enumerate() {
        evidence.push(Evidence {
            question: "contact",
            model: format!("held {}, loaded {}", t.0[0].name(), t.0[1].name()),
            parameters: count(t),
            residual_mm: t.1.rms,
            bic: score(t),
            chosen: i == best,
            reason: match tried.len() {
                1 => "both patches move as rigid bodies".into(),
                _ if i == best => "explains the field best".into(),
                _ if score(t) < score(&tried[best]) => {
                    "hardly better, and takes the motion along the plate as given".into()
                }
                _ => "explains it less".into(),
            },
        });
    }
    let plain =
        (0..tried.len()).filter(|&i| !guided(&tried[i])).min_by(|&i, &k| score(&tried[i]).total_cmp(&score(&tried[k])));
    // Of a guided patch, what the evidence has of it and of the best one that is not.
    let rival = plain.filter(|_| guided(&tried[best])).map(|plain| ([best, plain], tried[plain].clone()));
    let (contact, mut estimate) = tried.swap_remove(best);
    touch(level, contact);
    let mut law = first;
    if wanted != LawChoice::Linear && first == Law::Linear {
        let strain = summary::strain(&level.setup(law, poisson, reference), &estimate.state);
        let large_strain = strain > SMALL_STRAIN;
        if !large_strain {
            estimate = settle(level, law, poisson, reference, estimate, (LAW_MOVES, COARSE))?;
        }
        let edge = level.edge.map_or(0.0, |e| e.1);
        let large = large_strain_from(level, estimate.state.clone(), poisson, reference)?;
        let samples = estimate.effective.min(large.effective);
        let scores = [&estimate, &large].map(|e| bic(e.squares, samples, e.parameters));
        let better = large_strain || scores[1] + MARGIN < scores[0];
        for (i, e) in [&estimate, &large].into_iter().enumerate() {
            let gain = scores[0] - scores[1];
            evidence.push(Evidence {
                question: "law",
                model: [Law::Linear, Law::NeoHookean][i].name().into(),
                parameters: e.parameters,
                residual_mm: e.rms,
                bic: scores[i],
                chosen: (i == 1) == better,
                reason: if large_strain {
                    let (strain, most) = (100.0 * strain, 100.0 * SMALL_STRAIN);
                    format!("strains reach {strain:.0} %; past {most:.0} % small strain is off by about as much")
                } else if better {
                    format!("the strain asks for it: the criterion falls by {gain:.0}, {MARGIN} are needed")
                } else {
                    format!("small strain suffices: the criterion would fall by {gain:.0}, {MARGIN} are needed")
                },
            });
        }
        if better {
            law = Law::NeoHookean;
            estimate = large;
            if let Some((of, (without, rival))) = rival {
                let edge = level.edge.map_or(0.0, |e| e.1);
                touch(level, without);
                // One that cannot be solved is none.
                let rival = large_strain_from(level, rival.state, poisson, reference).ok().filter(|rival| {
                    let samples = estimate.effective.min(rival.effective);
                    let gain = bic(rival.squares, samples, rival.parameters)
                        - bic(estimate.squares, samples, estimate.parameters + given(contact));
                    gain < DECISIVE * samples
                });
                if let Some(rival) = rival {
                    estimate = rival;
                    for (at, chosen, reason) in [
                        (of[0], false, "explains the field best under small strain alone"),
                        (of[1], true, "explains the field nearly as well under the law that is taken"),
                    ] {
                        (evidence[at].chosen, evidence[at].reason) = (chosen, reason.into());
                    }
                } else {
                    touch(level, contact);
                    level.move_edge(edge);
                }
            }
        } else {
            level.move_edge(edge);
        }
    } else {
        evidence.push(Evidence {
            question: "law",
            model: law.name().into(),
            parameters: estimate.parameters,
            residual_mm: estimate.rms,
            bic: bic(estimate.squares, estimate.effective, estimate.parameters),
            chosen: true,
            reason: "as asked".into(),
        });
    }
    estimate = settle(level, law, poisson, reference, estimate, (MOVES, COARSE))?;
    Ok(Choice { law, estimate, evidence })
}

/// Moves the edge of a punch to where the data put it, and identifies again, until it stays, or has
/// moved `moves` times. `precision`: of the forward solutions (mm).
///
/// # Errors
/// As [`crate::stiffness::identify::Setup::run`].
pub fn settle(
    level: &mut Level,
    law: Law,
    poisson: f64,
    reference: usize,
    mut estimate: Estimate,
    (moves, precision): (usize, f64),
) -> Result<Estimate, StiffnessError> {
    for _ in 0..moves {
        let step = edge_step(&level.setup(law, poisson, reference), &estimate, &level.grid)?;
        let Some((step, (_, moved))) = step.zip(level.edge).filter(|(step, _)| step.abs() > SETTLED) else { break };
        level.move_edge(moved + step.clamp(-LONGEST, LONGEST));
        estimate = level.setup(law, poisson, reference).run(estimate.state, ITERATIONS, precision)?;
    }
    Ok(estimate)
}
