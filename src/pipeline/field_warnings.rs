//! What a field run refuses, and the warnings that it gives.

use crate::error::FieldError;
use crate::matching::pair::Pair;
use crate::numerics::statistics::quantile;
use crate::pipeline::bodies::Bodies;
use crate::pipeline::contrast;
use crate::pipeline::field::MIN_MATCHES;
use crate::pipeline::hypotheses::NEAR_RANGE_FRACTION;
use crate::pipeline::uncertainty::some_of;
use crate::types::*;

/// Refuses what few features support: if few of the features `seen` agreed in the search of the
/// whole and few of the matches survive, `kept` of `found`; past the range of the search (`far`)
/// either will do, the first one where the volumes stay `unlike`.
pub(super) fn no_measurement(
    kept: usize,
    found: usize,
    seen: Counts,
    far: bool,
    unlike: bool,
) -> Result<(), FieldError> {
    let survived = (kept, "matches survive", found.div_ceil(5));
    let agreed = (
        seen.kept,
        "features agree with their neighbours in the search of the whole volume",
        seen.features_initial.div_ceil(3),
    );
    let [few_survived, few_agreed] = [survived, agreed].map(|f| f.0 < f.2);
    let refused = match () {
        _ if few_survived && (few_agreed || far) => survived,
        _ if few_agreed && far && unlike => agreed,
        _ => return Ok(()),
    };
    let (found, what, needed) = refused;
    let hint = "check that both volumes show the same tissue; where its motion is known in part, give --initial or --landmarks".into();
    Err(FieldError::TooFew { found, what, needed, hint })
}

/// Length (mm) that all but a twentieth of the mask move at most, from at most about 25,000 of its
/// voxels. A neck that shows in one volume alone goes anywhere; of the tissues that are not each
/// other's (legs, heads, necks, upside down or noise) it was 1.1 to 2 times the search range, of
/// two people 0.4 to 0.7.
pub(super) fn most_move(field: &DenseField, mask: &Mask) -> f64 {
    let parts = [0, 1, 2].map(|c| field.component(c));
    let length = |at: usize| parts.iter().map(|part| part[at] * part[at]).sum::<f32>().sqrt();
    let mut lengths: Vec<f32> = some_of(mask).map(length).collect();
    f64::from(quantile(&mut lengths, 0.95))
}

/// Loss of explained variance against rest up to which a displacement is accepted.
const MAX_SIMILARITY_LOSS: f64 = 0.01;

/// How well the volumes agree at rest and under the bodies' fields.
///
/// # Errors
/// [`FieldError::Worse`] where they agree less under the fields.
pub(super) fn agreement(pair: &Pair<'_>, bodies: &Bodies, model: MotionModel) -> Result<Agreement, FieldError> {
    let found = contrast::agreement(pair, bodies);
    let Agreement { at_rest, found: now } = found;
    if model != MotionModel::Identity && now < at_rest - MAX_SIMILARITY_LOSS {
        let hint = "check that both volumes show the same tissue, or say more: --initial, --landmarks, --mask".into();
        return Err(FieldError::Worse { at_rest, found: now, hint });
    }
    Ok(found)
}

pub(super) fn unreliable_search(counts: Counts) -> String {
    let Counts { kept, features_initial: all, .. } = counts;
    format!(
        "only {kept} of {all} features agreed with their neighbours when the whole volume was searched: the motion may be \
         another; check that both volumes show the same tissue with the same contrast, and look at warped.nii.gz"
    )
}

/// Part of the tissue without texture beyond which that explains why few matches survive.
const MOSTLY_PLAIN_FRACTION: f64 = 0.5;

/// Part of the variance that the volumes explain of each other at rest; below it, they do not show
/// the same.
const MIN_SIMILARITY: f64 = 0.1;

/// Refuses a run with too few matches, with what was measured of the volumes and the one thing to
/// try. Nothing is advised that was asked for already.
pub(super) fn too_few(found: usize, pair: &Pair<'_>, search: f64, params: &FieldParams, started: bool) -> FieldError {
    let (plain, agreement) = (pair.plain(), contrast::agreement(pair, &Bodies::still(pair)).at_rest);
    // Volumes of cells are under a millimetre.
    let search = format!("{search:.*}", if search < 1.0 { 3 } else { 0 });
    let hint = match () {
        _ if plain > MOSTLY_PLAIN_FRACTION => format!(
            "{:.0} % of the tissue shows no texture that stands out of the noise: image finer or with less noise, or give --landmarks",
            100.0 * plain
        ),
        _ if agreement < MIN_SIMILARITY && started => format!(
            "at the start one volume explains {:.0} % of the other's variance: check its direction (,-1 after a name turns it round), or \
             try --initial principal",
            100.0 * agreement
        ),
        _ if agreement < MIN_SIMILARITY => format!(
            "at rest one volume explains {:.0} % of the other's variance: check that both show the same tissue; where they lie apart, \
             begin with --initial centre",
            100.0 * agreement
        ),
        _ if params.search_mm == 0.0 => {
            format!("the search range was {search} mm: if the tissue moved further, widen --search")
        }
        _ => format!("the search range was {search} mm: give --landmarks, or a start with --initial"),
    };
    no_match(found, hint)
}

pub(super) fn no_match(found: usize, hint: String) -> FieldError {
    FieldError::TooFew { found, what: "matches survive", needed: MIN_MATCHES, hint }
}

/// Where the number of points comes from.
pub(super) fn why_so_many(params: &FieldParams, wanted: usize, found: usize) -> String {
    let source = match params.points {
        0 => format!("one for {} voxels of tissue", params.voxels_per_point),
        _ => "as asked".into(),
    };
    if found > wanted {
        return format!("points: {wanted} of the {found} that were matched are written, {source}");
    }
    let limit = if found < wanted { "; no more corners stand out of the noise" } else { "" };
    format!("points: {found} of {wanted} wanted, {source}{limit}")
}

/// Says so where a model that was asked for is smaller than the motion.
pub(super) fn said_of_model(rejected: bool) -> Option<String> {
    rejected.then(|| {
        "the motion model that was asked for does not explain the volumes (see the evidence): what it leaves out is an error; leave \
         --model out, or take free"
            .into()
    })
}

/// Parts of the tissue that earn a warning.
struct Warnings {
    /// Without texture: 0 to 8 % in scans of heads, legs and a spine.
    plain_fraction: f64,
    /// Outside the deformed volume.
    out_of_view_fraction: f64,
}

const WARN: Warnings = Warnings { plain_fraction: 0.1, out_of_view_fraction: 0.05 };

/// Says so where much of the tissue shows nothing that could be seen to move.
pub(super) fn without_texture(share: f64) -> Option<String> {
    (share > WARN.plain_fraction).then(|| {
        format!(
            "{:.0} % of the tissue shows no texture that stands out of the noise: there the field is carried in from around, smooth, \
             and its uncertainty says too little; leave such parts out with --mask, or image finer or with less noise",
            100.0 * share
        )
    })
}

/// Says so where much of the tissue is not in the deformed volume.
pub(super) fn out_of_view(share: f64) -> Option<String> {
    (share > WARN.out_of_view_fraction).then(|| {
        format!(
            "{:.0} % of the tissue moves out of the deformed volume, or to where that shows nothing (not finite, or cut off): there the field is carried over from \
             what is in view, and may be off by more than its uncertainty says; leave such parts out with --mask",
            100.0 * share
        )
    })
}

/// What a user should know.
pub(super) fn warnings(counts: Counts, folds: usize, not_finite: [usize; 2], max_mm: f64, search: f64) -> Vec<String> {
    let mut out = Vec::new();
    for (count, volume) in not_finite.into_iter().zip(["initial", "deformed"]) {
        if count > 0 {
            out.push(format!("{count} voxels of the {volume} volume are not finite; they were left out"));
        }
    }
    if folds > 0 {
        out.push(format!("{folds} voxels fold (Jacobian at or below zero); do not trust strains there"));
    }
    if max_mm > NEAR_RANGE_FRACTION * search {
        let at = if max_mm > search { "past" } else { "near" };
        out.push(format!(
            "the motion reaches {max_mm:.1} mm, {at} the search range of {search:.1} mm: where it goes further, it was not found; try a wider --search"
        ));
    }
    if counts.features_initial > 0 && counts.kept * 4 < counts.features_initial {
        let (kept, all) = (counts.kept, counts.features_initial);
        out.push(format!("only {kept} of {all} features found a consistent match; look at uncertainty.nii.gz"));
    }
    out
}
