//! The severity at which something breaks, by a sweep and bisection.

/// How severities are spread over their range.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Spread {
    /// Even differences.
    Linear,
    /// The same, rounded to whole numbers.
    Whole,
    /// Even ratios; both ends must be positive.
    Ratio,
}

/// What a search has found.
#[derive(Debug, Clone, PartialEq)]
pub struct Breaking<R> {
    /// Severities with what came out there, harmless first.
    pub tried: Vec<(f64, R)>,
    /// The first severity that breaks.
    pub breaks_at: Option<f64>,
    /// The last one before it that holds.
    pub holds_at: Option<f64>,
}

/// Tries `coarse` severities (at least 2) over `range`, harmless end first, and halves the interval
/// before the first that breaks `halvings` times, or until nothing lies between. `run` may find
/// that a severity cannot be had at all (`None`): the range ends there.
///
/// What lies past the first break is tried too, but not searched: a curve need not be monotone.
///
/// ```
/// use palpate::evaluate::breaking::{Spread, breaking_point};
/// let found = breaking_point([0.0, 10.0], Spread::Linear, 5, 6, Some, |severity| *severity > 3.3);
/// let (holds, breaks) =
///     (found.holds_at.ok_or("never holds")?, found.breaks_at.ok_or("never breaks")?);
/// assert!(holds <= 3.3 && breaks > 3.3 && breaks - holds < 0.1);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn breaking_point<R>(
    range: [f64; 2],
    spread: Spread,
    coarse: usize,
    halvings: usize,
    run: impl Fn(f64) -> Option<R>,
    breaks: impl Fn(&R) -> bool,
) -> Breaking<R> {
    let between = |[a, b]: [f64; 2], t: f64| match spread {
        Spread::Linear => a + t * (b - a),
        Spread::Whole => (a + t * (b - a)).round(),
        Spread::Ratio => a * (b / a).powf(t),
    };
    let mut tried: Vec<(f64, R)> = Vec::with_capacity(coarse + halvings);
    for i in 0..coarse {
        // The ends are met exactly.
        let at = match i {
            0 => range[0],
            i if i + 1 == coarse => range[1],
            i => between(range, i as f64 / (coarse - 1) as f64),
        };
        let Some(found) = run(at) else { break };
        tried.push((at, found));
    }
    let first = tried.iter().position(|t| breaks(&t.1));
    let (mut breaks_at, mut holds_at) = (first.map(|i| tried[i].0), None);
    match first {
        Some(0) => {}
        Some(i) => holds_at = Some(tried[i - 1].0),
        None => holds_at = tried.last().map(|t| t.0),
    }
    if let (Some(mut place), Some(mut low), Some(mut high)) = (first, holds_at, breaks_at) {
        for _ in 0..halvings {
            let at = between([low, high], 0.5);
            if at == low || at == high {
                break;
            }
            let Some(found) = run(at) else { break };
            let broke = breaks(&found);
            tried.insert(place, (at, found));
            if broke {
                high = at;
            } else {
                low = at;
                place += 1;
            }
        }
        (breaks_at, holds_at) = (Some(high), Some(low));
    }
    Breaking { tried, breaks_at, holds_at }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_threshold_is_bracketed_to_the_last_halving() {
        for (range, spread) in [([0.0, 10.0], Spread::Linear), ([10.0, 0.1], Spread::Ratio)] {
            let worse = |a: f64| if range[1] > range[0] { a >= 6.3 } else { a <= 0.63 };
            let found = breaking_point(range, spread, 5, 4, |s| Some(worse(s)), |b| *b);
            let (high, low) = (found.breaks_at.unwrap_or(f64::NAN), found.holds_at.unwrap_or(f64::NAN));
            assert!(worse(high) && !worse(low), "{found:?}");
            let width = match spread {
                Spread::Linear | Spread::Whole => (high - low) / 2.5,
                Spread::Ratio => (high / low).ln() / 0.01f64.ln() * 4.0,
            };
            assert!((width - 1.0 / 16.0).abs() < 1e-9, "{width}");
            assert!(found.tried.windows(2).all(|w| (w[1].0 - w[0].0) * (range[1] - range[0]) > 0.0));
            assert_eq!(found.tried.len(), 9);
        }
    }

    #[test]
    fn whole_severities_are_bracketed_by_neighbours() {
        let found = breaking_point([0.0, 8.0], Spread::Whole, 3, 5, Some, |s| *s > 2.4);
        assert_eq!((found.breaks_at, found.holds_at), (Some(3.0), Some(2.0)));
        assert_eq!(found.tried.iter().map(|t| t.0).collect::<Vec<_>>(), [0.0, 2.0, 3.0, 4.0, 8.0]);
    }

    #[test]
    fn what_never_breaks_or_always_breaks_is_said() {
        let never = breaking_point([0.0, 1.0], Spread::Linear, 3, 3, Some, |_| false);
        assert_eq!((never.breaks_at, never.holds_at, never.tried.len()), (None, Some(1.0), 3));
        let always = breaking_point([0.0, 1.0], Spread::Linear, 3, 3, Some, |_| true);
        assert_eq!((always.breaks_at, always.holds_at), (Some(0.0), None));
        let ends = breaking_point([0.0, 1.0], Spread::Linear, 3, 3, |s| (s < 0.9).then_some(s), |_| false);
        assert_eq!((ends.breaks_at, ends.holds_at), (None, Some(0.5)));
    }
}
