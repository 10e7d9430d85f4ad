//! The panels of a field report.

use crate::error::ReportError;
use crate::report::colormap::ColorMap;
use crate::report::drawing;
use crate::report::field::{FieldReport, Values};
use crate::report::panels::{Panel, centre_of_motion, gray_range, length};
use crate::report::picture::Picture;
use crate::report::scale::{Scale, short};
use crate::report::section::Section;
use crate::report::statistics::{quantile, sample};
use crate::types::{MotionModel, SparseField, Voxels, WorldPoint};

/// Everything that is cut from the volumes, and the scales that go with it.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Views {
    /// Where the planes cross (mm, RAS).
    pub centre: WorldPoint,
    /// Initial, deformed and warped volume in gray.
    pub volumes: Vec<Panel>,
    /// Absolute difference to the initial volume before and after warping.
    pub differences: Vec<Panel>,
    /// Displacement magnitude.
    pub magnitude: Panel,
    /// Jacobian determinant.
    pub jacobian: Panel,
    /// The bodies, where there are several.
    pub bodies: Option<Panel>,
    /// Uncertainty.
    pub uncertainty: Panel,
    /// Distance to the true displacement, where that is known.
    pub error: Option<Panel>,
    /// One SVG a plane, and how many times longer than in truth the arrows are.
    pub arrows: (Vec<String>, f64),
    /// Black and white of the initial volume, and the gains of the deformed and the warped one to
    /// it.
    pub gray: ([f64; 2], [f32; 2]),
    /// One SVG a plane, how thick a slab is shown (mm), and the scale of the dots.
    pub matches: (Vec<String>, f64, Scale),
}

/// The bodies in colour, where there are several.
fn bodies_of(
    report: &FieldReport<'_>,
    sections: &[Section],
    base: (&Voxels<'_>, [f64; 2]),
) -> Result<Option<Panel>, ReportError> {
    let count = report.summary.bodies.len();
    if count < 2 {
        return Ok(None);
    }
    let scale = Scale { low: 1.0, high: count as f64, unit: "", map: ColorMap::Viridis };
    let labels = report.bodies.as_slice();
    // Outside the mask there is none.
    let label = |o: usize| if labels[o] > 0 { f32::from(labels[o]) } else { f32::NAN };
    let panel = Panel::coloured("Bodies", sections, base, report.mask, scale, label)?;
    Ok(Some(panel.with_note(
        "Parts that slide along each other, each with a motion of its own, by their labels in bodies.nii.gz.",
    )))
}

impl Views {
    /// Cuts the planes through the centre of motion.
    ///
    /// # Errors
    /// [`ReportError`] when a picture cannot be encoded.
    pub fn of(report: &FieldReport<'_>) -> Result<Self, ReportError> {
        let FieldReport { initial, deformed, warped, displacement, jacobian, uncertainty, mask, .. } = *report;
        let grid = initial.grid();
        let centre = centre_of_motion(displacement, mask);
        let sections = Section::through(grid, centre);
        let inside = sample(grid.len(), mask);
        let spread = |q: f64, f: &dyn Fn(usize) -> f32| quantile(inside.iter().map(|&o| f(o).into()), q);
        let range = gray_range(initial);
        let base = (initial, range);
        let values = initial.as_slice();
        let (before, after) = (matched(values, deformed, &inside), matched(values, warped, &inside));
        let gap = |v: Values<'_>, gain: f32, o: usize| (values[o] - v(o) * gain).abs();

        let worst = spread(0.99, &|o| gap(deformed, before, o));
        let difference = |title: &str, v: Values<'_>, gain: f32| -> Result<Panel, ReportError> {
            let scale = Scale { low: 0.0, high: worst.max(1e-6), unit: "", map: ColorMap::Magma };
            let mean = inside.iter().map(|&o| f64::from(gap(v, gain, o))).filter(|g| g.is_finite()).sum::<f64>();
            let mean = mean / inside.len().max(1) as f64 / (range[1] - range[0]) * 100.0;
            let panel = Panel::coloured(title, &sections, base, None, scale, |o| gap(v, gain, o))?;
            Ok(panel.with_note(format!("Mean {mean:.1} % of the gray range, in the same colours before and after.")))
        };
        let gray = |title: &str, v: Values<'_>, gain: f32, note: &str| {
            let range = range.map(|r| r / f64::from(gain));
            Ok(Panel::gray(title, &sections, v, range)?.with_note(note))
        };

        let motion = |o| length(displacement, o);
        let scales = Scales::of(&inside, &motion, jacobian, uncertainty, report.matches);
        let Scales { length: lengths, jacobian: change, uncertainty: vague, precision } = scales;

        let error = report.truth.map(|(truth, _)| {
            let gap = |o: usize| {
                let (u, t) = (displacement.at(o), truth.at(o));
                (0..3).map(|c| (u[c] - t[c]).powi(2)).sum::<f32>().sqrt()
            };
            // Where nothing was measured the field is no result.
            let measured = Some(report.bodies);
            let most = quantile(sample(grid.len(), measured).into_iter().map(|o| gap(o).into()), 0.99);
            let scale = Scale::from_zero(most, "mm", ColorMap::Magma);
            Panel::coloured("Error of the displacement", &sections, base, measured, scale, gap)
        });

        let backgrounds =
            sections.iter().map(|s| Picture::gray(s, |o| values[o], range)).collect::<Result<Vec<_>, _>>()?;
        let factor = drawing::arrow_factor(&sections, spread(0.98, &motion));
        let each = |draw: &dyn Fn(&Section, &Picture) -> String| {
            sections.iter().zip(&backgrounds).map(|(s, b)| draw(s, b)).collect::<Vec<_>>()
        };
        let arrows = each(&|s, b| drawing::arrows(s, b, displacement, mask, factor, &lengths));
        let slab = sections.iter().map(Section::thickness_mm).fold(1.0, f64::max);
        let dots = each(&|s, b| drawing::matches(s, b, &report.matches.matches, slab, &precision));

        Ok(Self {
            centre,
            volumes: vec![
                gray("Initial", &|o| values[o], 1.0, "")?,
                gray("Deformed", deformed, before, "As it came, on the initial grid.")?,
                gray("Deformed, warped back", warped, after, "Should look like the initial one.")?,
            ],
            differences: vec![
                difference("|initial − deformed|, before", deformed, before)?,
                difference("|initial − warped|, after", warped, after)?,
            ],
            magnitude: Panel::coloured("Displacement magnitude", &sections, base, mask, lengths, motion)?,
            bodies: bodies_of(report, &sections, base)?,
            jacobian: Panel::coloured("Jacobian determinant", &sections, base, mask, change, jacobian)?
                .with_note("Blue: the tissue shrinks. Red: it grows. White: its volume stays."),
            uncertainty: Panel::coloured("Uncertainty of the displacement", &sections, base, mask, vague, uncertainty)?
                .with_note(unseen(report, spread(0.5, uncertainty))),
            error: error.transpose()?,
            gray: (range, [before, after]),
            arrows: (arrows, factor),
            matches: (dots, slab, precision),
        })
    }
}

/// What the uncertainty says, where half of the voxels lie under `median` mm.
fn unseen(report: &FieldReport<'_>, median: f64) -> String {
    let said = format!("One standard deviation. Half of the voxels lie under {} mm.", short(median));
    match report.summary.model {
        MotionModel::Identity if !report.summary.rejected => {
            format!(
                "{said} Nothing seemed to move: a motion of {BAND_95_SD} times as much would have been seen, 95 % of the time."
            )
        }
        _ => said,
    }
}

/// Deviations along an axis within which 95 % of the lengths of normal errors lie, in three axes.
const BAND_95_SD: f64 = 2.8;

/// Range and colours of what is measured: the same in pictures, viewers and distributions.
pub(super) struct Scales {
    /// Displacement magnitude (mm).
    pub length: Scale,
    /// Jacobian determinant.
    pub jacobian: Scale,
    /// Uncertainty of the displacement (mm).
    pub uncertainty: Scale,
    /// Precision of the kept matches (mm).
    pub precision: Scale,
}

impl Scales {
    /// From the values over the voxels at `inside`, but for the few that stand out.
    pub fn of(
        inside: &[usize],
        length: Values<'_>,
        jacobian: Values<'_>,
        uncertainty: Values<'_>,
        matches: &SparseField,
    ) -> Self {
        let most = |f: Values<'_>, q| quantile(inside.iter().map(|&o| f64::from(f(o))), q);
        let change = most(&|o| (jacobian(o) - 1.0).abs(), 0.99).clamp(0.05, 1.0);
        let sigma = quantile(matches.kept().map(|m| m.sigma()), 0.95);
        Self {
            length: Scale::from_zero(most(length, 0.998), "mm", ColorMap::Viridis),
            jacobian: Scale::about(1.0, change, ""),
            uncertainty: Scale::from_zero(most(uncertainty, 0.98), "mm", ColorMap::Magma),
            precision: Scale::from_zero(sigma, "mm", ColorMap::Viridis),
        }
    }
}

/// The gain that brings `volume` closest to `reference` in the least squares over `offsets`; 1
/// where there is none.
pub(super) fn matched(reference: &[f32], volume: Values<'_>, offsets: &[usize]) -> f32 {
    let pairs = || {
        offsets.iter().map(|&o| (f64::from(reference[o]), f64::from(volume(o)))).filter(|(x, y)| (x * y).is_finite())
    };
    let gain = pairs().map(|(x, y)| x * y).sum::<f64>() / pairs().map(|(_, y)| y * y).sum::<f64>();
    if gain.is_finite() && gain > 1e-6 { gain as f32 } else { 1.0 }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::report::field::tests::Case;

    #[test]
    fn every_quantity_is_cut_in_three_planes() {
        let case = Case::new([12, 10, 8], [1.0, 1.0, 3.0]);
        let v = Views::of(&case.report()).unwrap();
        for p in v.volumes.iter().chain(&v.differences).chain([&v.magnitude, &v.jacobian, &v.uncertainty]) {
            assert_eq!(p.pictures.len(), 3, "{}", p.title);
        }
        assert_eq!(v.magnitude.scale.unwrap().high, 1.5);
        assert!(v.differences[1].note.starts_with("Mean 0.0 %"));
    }

    #[test]
    fn one_slice_is_shown_as_one_plane() {
        let case = Case::new([12, 10, 1], [1.0; 3]);
        assert_eq!(Views::of(&case.report()).unwrap().volumes[0].pictures.len(), 1);
    }

    #[test]
    fn a_common_gain_is_taken_out() {
        let mut case = Case::new([12, 10, 8], [1.0; 3]);
        let bright: Vec<f32> = case.initial.as_slice().iter().map(|v| 7.0 * v).collect();
        case.warped = Box::new(move |o| bright[o]);
        assert!(Views::of(&case.report()).unwrap().differences[1].note.starts_with("Mean 0.0 %"));
    }
}
