//! Force against displacement and tilt: the parallel model against the radial one.

use crate::grasp::models::{Parallel, Radial, Tilt, Tip, in_range};
use crate::types::Fingertip;
use crate::types::grasp::PostureForce;
use std::f64::consts::PI;

/// Forces along the back plate's normal, cos(tilt) dU/dd at d_t = 0 (N), for displacements to four
/// tenths of the radius and tilts to 40 degrees: pi E d^2 / cos(tilt) for parallel springs, pi E
/// d^2 for radial ones.
pub fn force(fingertip: &Fingertip) -> PostureForce {
    let stiffness = PI * fingertip.youngs_modulus;
    let (parallel_tip, radial_tip) = (Parallel { stiffness }, Radial { stiffness });
    let displacements: Vec<f64> = (0..=40).map(|i| 0.01 * f64::from(i) * fingertip.radius).collect();
    let tilts: Vec<f64> = (-40..=40).map(|i| f64::from(i).to_radians()).collect();
    let (mut parallel, mut radial) = (Vec::new(), Vec::new());
    for &d in &displacements {
        for &tilt in &tilts {
            let tilt = Tilt::of(tilt);
            let inside = d == 0.0 || in_range(fingertip.radius, d, tilt.sin);
            let along = tilt.cos * parallel_tip.gradient(d, 0.0, tilt).normal;
            parallel.push(if inside { along } else { f64::NAN });
            radial.push(radial_tip.gradient(d, 0.0, tilt).normal);
        }
    }
    PostureForce { tilts, displacements, parallel, radial }
}
