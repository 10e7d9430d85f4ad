//! What is looked at in every step: contact, the model's range, slip.

use crate::grasp::models::in_range;
use crate::grasp::plant::Reading;
use crate::types::grasp::EventKind;
use crate::types::{FingertipModel, Scene};

/// Watches the contacts of one run.
#[derive(Debug, Clone)]
pub struct Watch {
    radius: f64,
    friction: Option<f64>,
    rigid: bool,
    slipping: [bool; 2],
}

/// A flaw of one contact: what, which tip (0 or 1), in words.
pub type Flaw = (EventKind, usize, String);

impl Watch {
    /// For a scene.
    pub fn new(scene: &Scene) -> Self {
        Self {
            radius: scene.fingertip.radius,
            friction: scene.object.friction,
            rigid: scene.fingertip.model == FingertipModel::Rigid,
            slipping: [false; 2],
        }
    }

    #[inline(always)]
    fn slips(&self, r: &Reading, i: usize) -> bool {
        self.friction.is_some_and(|friction| r.forces[2 + i].abs() > friction * r.forces[i])
    }

    /// Whether all is as the model assumes, in one glance.
    #[inline(always)]
    pub fn fine(&self, r: &Reading) -> bool {
        let one = |i: usize| {
            let touches =
                if self.rigid { r.forces[i] > 0.0 } else { in_range(self.radius, r.displacements[i], r.sin_tilt[i]) };
            touches && !self.slips(r, i) && !self.slipping[i]
        };
        one(0) && one(1)
    }

    /// What is wrong: the flaw that ends the run, and the tips that begin to slip.
    pub fn flaws(&mut self, r: &Reading) -> (Option<Flaw>, Vec<Flaw>) {
        let mut slips = Vec::new();
        for i in 0..2 {
            let (d, f_n, f_t) = (r.displacements[i], r.forces[i], r.forces[2 + i]);
            let most = self.radius * (1.0 - r.sin_tilt[i].abs());
            let flaw = match () {
                () if !(d.is_finite() && f_n.is_finite() && f_t.is_finite()) => {
                    Some((EventKind::BadStep, "the state is no longer finite".into()))
                }
                () if self.rigid && f_n <= 0.0 => Some((EventKind::ContactLoss, format!("f_n is {f_n:.3} N"))),
                () if self.rigid => None,
                () if d <= 0.0 => Some((EventKind::ContactLoss, format!("d_n is {:.3} mm", 1e3 * d))),
                () if d >= most => {
                    let what = format!("d_n is {:.3} mm, the model holds under {:.3} mm", 1e3 * d, 1e3 * most);
                    Some((EventKind::ValidityRange, what))
                }
                () => None,
            };
            if let Some((kind, what)) = flaw {
                return (Some((kind, i, what)), slips);
            }
            let now = self.slips(r, i);
            if now && !self.slipping[i] {
                let friction = self.friction.unwrap_or_default();
                let what = format!("|f_t| is {:.3} N and f_n {f_n:.3} N, friction {friction}", f_t.abs());
                slips.push((EventKind::Slip, i, what));
            }
            self.slipping[i] = now;
        }
        (None, slips)
    }
}
