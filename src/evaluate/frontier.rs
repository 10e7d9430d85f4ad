//! Speed against accuracy: methods over cases, and those that no other beats in both.

use super::mean;
use crate::types::{Standing, Trial};

/// Motion below this is none (mm).
const NONE_MM: f64 = 1e-3;

/// Whether errors are given as a part of the motion: where every case has one. Else they are
/// means as they are.
pub(crate) fn is_relative<'a>(trials: impl IntoIterator<Item = &'a Trial>) -> bool {
    trials.into_iter().all(|t| t.nothing.is_some_and(|n| n > NONE_MM))
}

/// Each method over its cases, in the order in which methods first appear; [`Standing::on_front`]
/// is set.
///
/// All errors are of one kind, by [`is_relative`] over all trials. Where that holds, a case without
/// a result counts as no registration; else it is left out. CPU time is that of the runs with a
/// result: what ends early was not faster. A method that has failed on some case is not on the
/// front, since it stands there for other cases than the rest do, and one that has failed on all
/// has neither error nor time (NaN).
pub(crate) fn standings<'a>(trials: impl IntoIterator<Item = &'a Trial>) -> Vec<Standing> {
    let trials: Vec<&Trial> = trials.into_iter().collect();
    let relative = is_relative(trials.iter().copied());
    let mut groups: Vec<Vec<&Trial>> = Vec::new();
    for trial in trials {
        let same = |g: &&mut Vec<&Trial>| {
            g.first().is_some_and(|t| t.varied == trial.varied && t.method == trial.method && t.whole == trial.whole)
        };
        match groups.iter_mut().find(same) {
            Some(group) => group.push(trial),
            None => groups.push(vec![trial]),
        }
    }
    let mut out: Vec<Standing> = groups.iter().filter_map(|g| standing(g, relative)).collect();
    let sound: Vec<usize> = (0..out.len()).filter(|&i| out[i].failures == 0).collect();
    let places: Vec<[f64; 2]> = sound.iter().map(|&i| [out[i].cpu_s, out[i].error]).collect();
    for at in pareto(&places) {
        out[sound[at]].on_front = true;
    }
    out
}

fn standing(group: &[&Trial], relative: bool) -> Option<Standing> {
    let first = group.first()?;
    let done: Vec<&&Trial> = group.iter().filter(|t| t.error.is_finite()).collect();
    let failures = group.len() - done.len();
    let left = |t: &&&Trial| (t.error / t.nothing.unwrap_or(f64::NAN)).max(1e-6).ln();
    let error = match (done.is_empty(), relative) {
        (true, _) => f64::NAN,
        // The logarithm of no registration is 0.
        (false, true) => 100.0 * (done.iter().map(left).sum::<f64>() / group.len() as f64).exp(),
        (false, false) => mean(&done.iter().map(|t| t.error).collect::<Vec<_>>()),
    };
    Some(Standing {
        varied: first.varied,
        method: first.method.clone(),
        settings: first.settings.clone(),
        error,
        cpu_s: mean(&done.iter().map(|t| t.cpu_s).collect::<Vec<_>>()),
        cases: group.len(),
        failures,
        on_front: false,
    })
}

/// Numbers of the places (cost, error) that no other place beats in one without losing in the
/// other, cheapest first. Places that are not finite are left out.
///
/// ```
/// use palpate::evaluate::frontier::pareto;
/// // Cost and error: the third place costs more than the second and is no better.
/// assert_eq!(pareto(&[[4.0, 0.1], [1.0, 0.5], [2.0, 0.5]]), [1, 0]);
/// ```
pub fn pareto(places: &[[f64; 2]]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..places.len()).filter(|&i| places[i].iter().all(|v| v.is_finite())).collect();
    order.sort_by(|&a, &b| places[a][0].total_cmp(&places[b][0]).then(places[a][1].total_cmp(&places[b][1])));
    let mut best = f64::INFINITY;
    order.retain(|&i| {
        let better = places[i][1] < best;
        best = best.min(places[i][1]);
        better
    });
    order
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::Part;

    fn trial(method: &str, error: f64, nothing: Option<f64>, cpu_s: f64) -> Trial {
        Trial {
            part: Part::Field,
            varied: "preset",
            method: method.into(),
            settings: String::new(),
            case: String::new(),
            error,
            error_p95: None,
            gradient_error: None,
            nothing,
            size: 1,
            cpu_s,
            whole: false,
            failure: None,
        }
    }

    #[test]
    fn the_front_is_what_no_other_beats() {
        let places = [[2.0, 1.0], [1.0, 3.0], [3.0, 2.0], [0.5, 3.0], [f64::NAN, 0.0], [4.0, 0.5]];
        assert_eq!(pareto(&places), [3, 0, 5]);
        let dominated = |i: usize| {
            (0..places.len())
                .any(|j| places[j][0] <= places[i][0] && places[j][1] <= places[i][1] && places[j] != places[i])
        };
        assert!(pareto(&places).into_iter().all(|i| !dominated(i)));
    }

    #[test]
    fn a_refusal_counts_as_doing_nothing_takes_no_time_and_keeps_a_method_off_the_front() {
        let trials =
            [trial("a", 1.0, Some(4.0), 1.0), trial("a", f64::NAN, Some(4.0), 0.1), trial("b", 4.0, Some(4.0), 1.5)];
        let s = standings(&trials);
        assert!((s[0].error - 50.0).abs() < 1e-9 && s[0].failures == 1 && s[0].cpu_s == 1.0);
        assert!((s[1].error - 100.0).abs() < 1e-9 && s[1].on_front && !s[0].on_front);
    }

    #[test]
    fn a_method_without_any_result_has_no_error_and_no_time() {
        let trials = [trial("a", f64::NAN, Some(4.0), 0.01), trial("b", 8.0, Some(4.0), 1.5)];
        let s = standings(&trials);
        assert!(s[0].error.is_nan() && s[0].cpu_s.is_nan() && !s[0].on_front && s[0].failures == 1);
        assert!((s[1].error - 200.0).abs() < 1e-9 && s[1].on_front);
    }

    #[test]
    fn one_case_without_motion_puts_all_methods_in_millimetres() {
        let mixed = |m: &str| [trial(m, 1.0, Some(4.0), 1.0), trial(m, 0.5, Some(0.0), 1.0)];
        let trials: Vec<Trial> = mixed("a").into_iter().chain([trial("b", 3.0, Some(4.0), 1.0)]).collect();
        let s = standings(&trials);
        assert!(!is_relative(&trials));
        assert_eq!((s[0].error, s[1].error), (0.75, 3.0));
    }

    #[test]
    fn errors_without_a_yardstick_are_averaged() {
        let s = standings(&[trial("a", 1.0, None, 1.0), trial("a", 3.0, None, 1.0)]);
        assert_eq!((s[0].error, s[0].cases), (2.0, 2));
    }
}
