//! Speed against accuracy: methods over cases, and those that no other beats in both.

use crate::types::{Standing, Trial};

/// Each method over its cases, in the order in which methods first appear; [`Standing::on_front`] is set.
///
/// A case without a result counts as doing nothing where that is known, and is left out elsewhere.
pub fn standings<'a>(trials: impl IntoIterator<Item = &'a Trial>) -> Vec<Standing> {
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
    let mut out: Vec<Standing> = groups.iter().filter_map(|g| standing(g)).collect();
    let places: Vec<[f64; 2]> = out.iter().map(|s| [s.cpu_s, s.error]).collect();
    for at in pareto(&places) {
        out[at].on_front = true;
    }
    out
}

fn standing(group: &[&Trial]) -> Option<Standing> {
    let first = group.first()?;
    let relative = group.iter().all(|t| t.nothing.is_some_and(|n| n > 0.0));
    let errors: Vec<f64> = if relative {
        let left = |t: &&Trial| {
            let part = t.error / t.nothing.unwrap_or(f64::NAN);
            if part.is_nan() { 1.0 } else { part.max(1e-6) }
        };
        group.iter().map(left).map(f64::ln).collect()
    } else {
        group.iter().map(|t| t.error).filter(|e| e.is_finite()).collect()
    };
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let spent: Vec<f64> = group.iter().map(|t| t.cpu_s).collect();
    Some(Standing {
        varied: first.varied,
        method: first.method.clone(),
        settings: first.settings.clone(),
        error: if relative { 100.0 * mean(&errors).exp() } else { mean(&errors) },
        cpu_s: mean(&spent),
        cases: group.len(),
        failures: group.iter().filter(|t| t.error.is_nan()).count(),
        on_front: false,
    })
}

/// Numbers of the places (cost, error) that no other place beats in one without losing in the other, cheapest first.
/// Places that are not finite are left out.
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
    fn a_refusal_counts_as_doing_nothing() {
        let trials =
            [trial("a", 1.0, Some(4.0), 1.0), trial("a", f64::NAN, Some(4.0), 3.0), trial("b", 4.0, Some(4.0), 1.5)];
        let s = standings(&trials);
        assert!((s[0].error - 50.0).abs() < 1e-9 && s[0].failures == 1 && s[0].cpu_s == 2.0);
        assert!((s[1].error - 100.0).abs() < 1e-9 && s[1].on_front && s[0].on_front);
    }

    #[test]
    fn errors_without_a_yardstick_are_averaged() {
        let s = standings(&[trial("a", 1.0, None, 1.0), trial("a", 3.0, None, 1.0)]);
        assert_eq!((s[0].error, s[0].cases), (2.0, 2));
    }
}
