//! What is looked at in every step: contact, the model's range, slip.

use crate::grasp::dynamics::Reading;
use crate::grasp::friction::Friction;
use crate::grasp::models::in_range;
use crate::types::grasp::EventKind;
use crate::types::{FingertipModel, Scene};

/// Watches the contacts of one run.
#[derive(Debug, Clone)]
pub(crate) struct Watch {
    radius: [f64; 2],
    half_height: f64,
    /// What holds the tips.
    pub friction: Friction,
    rigid: bool,
    /// Whether each tip slips, and whether it is out of the model's range.
    ongoing: [[bool; 2]; 2],
    /// Whether none is.
    quiet: bool,
}

/// Events with a duration, by place in [`Watch`]'s and a run's tables.
pub(crate) const LASTING_EVENTS: [EventKind; 2] = [EventKind::Slip, EventKind::ValidityRange];

/// What a look at the contacts shows.
#[derive(Debug, Clone, Default)]
pub(crate) struct Findings {
    /// What ends the run: what, which tip (0 or 1), in words.
    pub fatal: Option<(EventKind, usize, String)>,
    /// What begins now: place in [`LASTING_EVENTS`], tip, in words.
    pub begins: Vec<(usize, usize, String)>,
    /// What is over: place in [`LASTING_EVENTS`], tip.
    pub over: Vec<(usize, usize)>,
}

impl Watch {
    /// For a scene.
    pub fn new(scene: &Scene) -> Self {
        Self {
            radius: scene.fingertips().map(|tip| tip.radius),
            half_height: 0.5 * scene.object.height,
            friction: Friction::of(scene),
            rigid: scene.fingertip.model == FingertipModel::Rigid,
            ongoing: [[false; 2]; 2],
            quiet: true,
        }
    }

    /// Whether a tip slips.
    pub(crate) fn slipping(&self) -> bool {
        self.ongoing[0] != [false; 2]
    }

    #[inline(always)]
    fn slips(&self, r: &Reading, i: usize, along: f64) -> bool {
        r.forces[2 + i].abs() > Friction::limit(along, &r.forces, i)
    }

    /// Whether all is as the model assumes, in one glance.
    #[inline(always)]
    pub fn fine(&self, r: &Reading) -> bool {
        let along = self.friction.along(&r.forces, &r.displacements);
        let one = |i: usize| {
            let touches = if self.rigid {
                r.forces[i] > 0.0
            } else {
                in_range(self.radius[i], r.displacements[i], r.sin_tilt[i])
            };
            // Without friction given the limit is not a number where nothing presses.
            touches && !(self.slips(r, i, along))
        };
        self.quiet && one(0) && one(1)
    }

    /// Whether both tips touch the object between the ends of its faces.
    pub(crate) fn on_faces(&self, r: &Reading) -> bool {
        r.places.iter().all(|p| p.abs() <= self.half_height)
    }

    /// What is wrong.
    pub(crate) fn findings(&mut self, r: &Reading) -> Findings {
        let mut found = Findings::default();
        let along = self.friction.along(&r.forces, &r.displacements);
        for i in 0..2 {
            let (d, f_n, f_t) = (r.displacements[i], r.forces[i], r.forces[2 + i]);
            let most = self.radius[i] * (1.0 - r.sin_tilt[i].abs());
            let fatal = match () {
                () if !(d.is_finite() && f_n.is_finite() && f_t.is_finite()) => {
                    Some((EventKind::NotFinite, "the state is no longer finite".into()))
                }
                () if self.rigid && f_n <= 0.0 => Some((EventKind::ContactLoss, format!("f_n is {f_n:.3} N"))),
                () if !self.rigid && d <= 0.0 => Some((EventKind::ContactLoss, format!("d_n is {:.3} mm", 1e3 * d))),
                () if r.places[i].abs() > self.half_height => {
                    let [at, end] = [r.places[i].abs(), self.half_height].map(|v| 1e3 * v);
                    let what = format!("it is {at:.2} mm from the middle of its face, which ends at {end:.2} mm");
                    Some((EventKind::ContactLoss, what))
                }
                () => None,
            };
            if let Some((kind, what)) = fatal {
                found.fatal = Some((kind, i, what));
                return found;
            }
            let now = [self.slips(r, i, along), !self.rigid && d >= most];
            for (k, now) in now.into_iter().enumerate() {
                let before = std::mem::replace(&mut self.ongoing[k][i], now);
                if now && !before {
                    let what = match LASTING_EVENTS[k] {
                        EventKind::Slip => {
                            let spin = if self.friction.moment == 0.0 { "" } else { " along the face" };
                            format!("|f_t| is {:.3} N and f_n {f_n:.3} N, friction{spin} {along:.3}", f_t.abs())
                        }
                        _ => format!("d_n is {:.3} mm, the model holds under {:.3} mm", 1e3 * d, 1e3 * most),
                    };
                    found.begins.push((k, i, what));
                } else if before && !now {
                    found.over.push((k, i));
                }
            }
        }
        self.quiet = self.ongoing == [[false; 2]; 2];
        found
    }
}
