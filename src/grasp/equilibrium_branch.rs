//! Whether a run is still on the branch of equilibria that it came along.

use crate::grasp::constraints::Coordinates;
use crate::grasp::statics::{Equilibrium, Lost, Statics};

/// Step along the branch of equilibria (rad).
pub(crate) const BRANCH_STEP_RAD: f64 = 0.05;
/// When an object at rest has left the branch.
struct RestTest {
    /// Largest speed of an object at rest (m/s, and rad/s times the tip's radius).
    max_speed: f64,
    /// Largest distance from the branch (m).
    max_distance_m: f64,
}

const REST: RestTest = RestTest { max_speed: 1e-4, max_distance_m: 1e-4 };

/// The branch behind a run.
#[derive(Debug, Clone)]
pub(crate) struct Branch<'a> {
    statics: Statics<'a>,
    /// The last equilibrium that was followed to; none while there is none to follow.
    at: Option<Equilibrium>,
    /// Stiffness below which the branch is looked at (N/m).
    limit: f64,
    /// Whether it was lost when it was last looked at.
    lost: bool,
}

/// What a look at the branch shows.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Look {
    /// The state is on its branch, or on its way along it.
    On,
    /// The branch ends before the present joint angles; in words.
    Fold(String),
    /// The object rests elsewhere, on a branch that is followed from now on; in words.
    Elsewhere(String),
}

impl<'a> Branch<'a> {
    /// From the equilibrium that a run starts in.
    pub fn new(statics: Statics<'a>, start: &Equilibrium) -> Self {
        Self { statics, at: Some(*start), limit: 0.1 * start.smallest_eigenvalue, lost: false }
    }

    /// The tips have slid: d_t is counted from `origin` (m), and the branch goes on from the state.
    pub fn slid(&mut self, origin: [f64; 2], q: &Coordinates, forces: &[f64; 4]) {
        self.statics.geometry.origin = origin;
        self.at = self.near(q, forces);
        self.lost = false;
    }

    /// A stable equilibrium near a state.
    fn near(&self, q: &Coordinates, forces: &[f64; 4]) -> Option<Equilibrium> {
        let guess = Equilibrium { q: *q, forces: *forces, ..Equilibrium::default() };
        self.statics.equilibrium([q[3], q[4]], &guess).filter(|e| e.smallest_eigenvalue > 0.0)
    }

    /// Looks at the state `q`, `v` with the contact forces `f`. Unless `thorough`, a stiff state is
    /// taken to be on the branch that it was on.
    pub fn look(&mut self, q: &Coordinates, v: &Coordinates, f: &[f64; 4], thorough: bool) -> Look {
        let statics = &self.statics;
        if statics.holds_normal() || (!thorough && !self.lost && statics.stiffer_than(self.limit, q, f)) {
            return Look::On;
        }
        let a = statics.geometry.scale();
        let size = |d: [f64; 3]| d[0].hypot(d[1]).max(a * d[2].abs());
        let rests = size([v[0], v[1], v[2]]) <= REST.max_speed;
        let found = self.at.map(|at| statics.follow(&at, [q[3], q[4]], BRANCH_STEP_RAD));
        let look = match found {
            None => {
                self.at = if rests { self.near(q, f) } else { None };
                Look::On
            }
            Some(Ok(found)) => {
                self.at = Some(found);
                let apart = size([0, 1, 2].map(|k| found.q[k] - q[k]));
                if rests && apart >= REST.max_distance_m {
                    self.at = self.near(q, f);
                    let mm = 1e3 * apart;
                    Look::Elsewhere(format!(
                        "the object rests {mm:.3} mm from the branch of equilibria that it came along"
                    ))
                } else {
                    Look::On
                }
            }
            Some(Err((Lost::Fold, last))) => {
                let here = if rests { self.near(q, f) } else { None };
                self.at = here.or(self.at);
                if here.is_some() {
                    Look::Elsewhere("the object rests on another branch of equilibria than it came along".into())
                } else {
                    Look::Fold(format!(
                        "the branch of equilibria ends at joint angles {:.2} and {:.2} degrees (smallest eigenvalue \
                         {:.3e} N/m); the motion goes on without one",
                        last.q[3].to_degrees(),
                        last.q[4].to_degrees(),
                        last.smallest_eigenvalue
                    ))
                }
            }
            // The contacts of the state itself tell.
            Some(Err(_)) => Look::On,
        };
        self.lost = matches!(look, Look::Fold(_));
        look
    }
}
