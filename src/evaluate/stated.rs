//! Whether the error that runs state of themselves tells their true one.

use crate::numerics::statistics::rank_correlation;
use crate::types::{Stated, StressRun};

/// Of these runs.
pub fn stated<'a>(runs: impl Iterator<Item = &'a StressRun>) -> Stated {
    let runs: Vec<&StressRun> = runs.collect();
    let count = |holds: &dyn Fn(&StressRun) -> bool| runs.iter().filter(|r| holds(r)).count();
    let pairs: Vec<(f64, f64)> =
        runs.iter().filter_map(|r| Some((r.expected?, r.error))).filter(|p| p.0 > 0.0 && p.1 > 0.0).collect();
    let (expected, error): (Vec<f64>, Vec<f64>) = pairs.iter().copied().unzip();
    let within = |factor: f64| {
        let near = pairs.iter().filter(|(a, b)| (a / b).max(b / a) < factor).count();
        near as f64 / pairs.len().max(1) as f64
    };
    Stated {
        runs: runs.len(),
        broken: count(&StressRun::broken),
        silent: count(&StressRun::silent),
        small: count(&StressRun::is_small),
        false_alarms: count(&StressRun::false_alarm),
        rank_correlation: rank_correlation(&expected, &error),
        within: [1.5, 2.0].map(within),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn silence_alarms_and_ranks_are_counted() {
        let run = |error: f64, expected: f64, said: &str| StressRun {
            severity: 1.0,
            error,
            limit: 1.0,
            refused: None,
            said: if said.is_empty() { Vec::new() } else { vec![said.into()] },
            inside: None,
            expected: Some(expected),
        };
        let refused = StressRun { error: f64::NAN, expected: None, refused: Some("no".into()), ..run(0.0, 0.0, "") };
        let all = [run(0.1, 0.1, ""), run(0.2, 0.5, "low"), run(2.0, 0.9, ""), run(3.0, 2.9, "low"), refused];
        let found = stated(all.iter());
        assert_eq!((found.runs, found.broken, found.silent, found.small, found.false_alarms), (5, 3, 1, 2, 1));
        assert_eq!((found.rank_correlation, found.within), (Some(1.0), [0.5, 0.5]));
    }
}
