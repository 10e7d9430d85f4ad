//! Whether a run is still on the branch of equilibria that it came along.

use crate::grasp::constraints::Coordinates;
use crate::grasp::statics::{Equilibrium, Lost, Statics};

/// Stride along the branch (rad).
pub const STRIDE: f64 = 0.05;
/// Slower than this the object rests (m/s, and rad/s times the tip's radius).
const REST: f64 = 1e-4;
/// A resting object further than this from the branch has left it (m).
const APART: f64 = 1e-4;

/// The branch behind a run.
#[derive(Debug, Clone)]
pub struct Branch<'a> {
    statics: &'a Statics<'a>,
    /// The last equilibrium that was followed to.
    at: Equilibrium,
    /// Stiffness below which the branch is looked at (N/m).
    limit: f64,
}

impl<'a> Branch<'a> {
    /// From the equilibrium that a run starts in.
    pub fn new(statics: &'a Statics<'a>, start: &Equilibrium) -> Self {
        Self { statics, at: *start, limit: 0.1 * start.smallest_eigenvalue }
    }

    /// Why the state `q`, `v` with the contact forces `f` is off the branch; none where it is on
    /// it. Unless `thorough`, a stiff state is taken to be on it.
    pub fn lost(&mut self, q: &Coordinates, v: &Coordinates, f: &[f64; 4], thorough: bool) -> Option<String> {
        if self.statics.tip.holds_normal() || (!thorough && self.statics.stiffer_than(self.limit, q, f)) {
            return None;
        }
        match self.statics.follow(&self.at, [q[3], q[4]], STRIDE) {
            Ok(found) => {
                self.at = found;
                let a = self.statics.geometry.radius;
                let size = |d: [f64; 3]| d[0].hypot(d[1]).max(a * d[2].abs());
                let apart = size([0, 1, 2].map(|k| found.q[k] - q[k]));
                let rests = size([v[0], v[1], v[2]]) <= REST;
                (rests && apart >= APART).then(|| {
                    format!("the object rests {:.3} mm from the branch of equilibria that it came along", 1e3 * apart)
                })
            }
            Err((Lost::Fold, last)) => Some(format!(
                "the branch of equilibria ends at joint angles {:.2} and {:.2} degrees (smallest eigenvalue {:.3e} N/m)",
                last.q[3].to_degrees(),
                last.q[4].to_degrees(),
                last.smallest_eigenvalue
            )),
            // The contacts of the state itself tell.
            Err(_) => None,
        }
    }
}
