//! The pinch map: over both joint angles, which postures can be reached from the pinch, are stable,
//! hold without slip and lie in the model's range.

use crate::grasp::friction::Friction;
use crate::grasp::models::tips_of;
use crate::grasp::statics::{Equilibrium, Lost, Statics};
use crate::types::grasp::{PinchCell, PinchMap, PinchState, Sample};
use crate::types::{FingertipModel, Scene};
use std::collections::VecDeque;

/// Called with the fraction that is done (0 to 1).
pub(crate) type Progress<'a> = &'a (dyn Fn(f64) + Sync);

/// The map of `model` with `side` angles along each side from `-most` to `most` (rad); `side` is
/// made odd, so that the pinch lies on it. Postures are reached from neighbour to neighbour,
/// starting at the pinch, through such as hold.
pub fn map(scene: &Scene, model: FingertipModel, most: f64, side: usize, progress: Progress<'_>) -> PinchMap {
    let side = side.max(3) | 1;
    let tips = tips_of(scene, model);
    let statics = Statics::of(scene, [tips[0].as_ref(), tips[1].as_ref()]);
    let angles: Vec<f64> = (0..side).map(|i| most * (2.0 * i as f64 / (side - 1) as f64 - 1.0)).collect();
    let stride = 2.0 * most / (side - 1) as f64;
    let friction = Friction::of(scene);
    let nothing = |i: usize, j: usize| PinchCell {
        state: PinchState::Unreached,
        sample: Sample { joints: [angles[i], angles[j]], ..Sample::default() },
        smallest_eigenvalue: f64::NAN,
    };
    let mut cells: Vec<PinchCell> = (0..side * side).map(|n| nothing(n % side, n / side)).collect();
    let mut found: Vec<Option<Equilibrium>> = vec![None; side * side];
    let holds = |e: &Equilibrium| {
        let slips = friction.required(&e.forces, &e.displacements) > friction.coefficient;
        let state = if slips { PinchState::Slip } else { PinchState::Good };
        PinchCell { state, sample: e.sample(0.0), smallest_eigenvalue: e.smallest_eigenvalue }
    };

    let pinch = statics.pinch(scene);
    let middle = side / 2;
    let mut queue = VecDeque::new();
    if statics.out_of_range(&pinch.q).is_none() && pinch.smallest_eigenvalue > 0.0 {
        let at = middle * side + middle;
        cells[at] = holds(&pinch);
        found[at] = Some(pinch);
        queue.push_back((middle, middle));
    }
    let mut done = 0;
    while let Some((i, j)) = queue.pop_front() {
        done += 1;
        if done % 256 == 0 {
            progress(done as f64 / (side * side) as f64);
        }
        let Some(here) = found[j * side + i] else { continue };
        let next = [(i + 1, j), (i.wrapping_sub(1), j), (i, j + 1), (i, j.wrapping_sub(1))];
        for (k, l) in next.into_iter().filter(|(k, l)| *k < side && *l < side) {
            let at = l * side + k;
            if found[at].is_some() {
                continue;
            }
            match statics.follow(&here, [angles[k], angles[l]], stride) {
                Ok(equilibrium) => {
                    cells[at] = holds(&equilibrium);
                    found[at] = Some(equilibrium);
                    queue.push_back((k, l));
                }
                Err((lost, _)) => {
                    cells[at].state = match lost {
                        Lost::Fold => PinchState::Unstable,
                        Lost::Contact(_) => PinchState::ContactLost,
                        Lost::Range(_) => PinchState::OutOfRange,
                    };
                }
            }
        }
    }
    PinchMap { angles, cells }
}
