//! Nearest neighbours among points in space (a k-d tree).

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use std::num::NonZero;

/// Points that can be asked for neighbours.
pub struct Neighbours {
    tree: Option<ImmutableKdTree<f64, 3>>,
}

impl Neighbours {
    /// Over points with finite coordinates; an empty slice is allowed and never answers.
    pub fn new(points: &[[f64; 3]]) -> Self {
        let usable = !points.is_empty() && points.iter().flatten().all(|v| v.is_finite());
        Self { tree: usable.then(|| ImmutableKdTree::new_from_slice(points).ok()).flatten() }
    }

    /// The numbers of at most `count` points within `radius` (inclusive) of `at`, nearest first,
    /// ties by number; which of several equally far points is left out at the cut is up to the
    /// tree, but the same each time.
    pub fn within(&self, at: [f64; 3], radius: f64, count: usize) -> Vec<usize> {
        let (Some(tree), Some(count)) = (&self.tree, NonZero::new(count)) else { return Vec::new() };
        if !at.iter().all(|v| v.is_finite()) {
            return Vec::new();
        }
        let mut found: Vec<(f64, usize)> = tree
            .query(&at)
            .nearest_n::<SquaredEuclidean<f64>>(count)
            .execute()
            .into_iter()
            .map(|f| (f.distance, f.item as usize))
            .filter(|f| f.0 <= radius * radius)
            .collect();
        found.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        found.into_iter().map(|f| f.1).collect()
    }
}
