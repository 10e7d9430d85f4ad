//! Candidate matches, many to many: each place of the initial volume keeps several places of the
//! deformed one.
//!
//! Four sources are joined (Zhang, Hirai, Endo & Morikawa 2007 use the first): features paired with
//! features of the other volume through a k-d tree, from the initial side and from the deformed
//! side, and exhaustive search of a feature's patch in the other volume, again from either side.

use crate::matching::correlation::Searchable;
use crate::numerics::neighbours::Neighbours;
use crate::types::Candidate;
use rayon::prelude::*;

/// How far and how many.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CandidateParams {
    /// Largest displacement (mm along each axis).
    pub reach_mm: f64,
    /// Candidates kept from each source; 3 to 20, default 6.
    pub keep: usize,
    /// Neighbours of the other volume tried as partners; default 48.
    pub partners: usize,
    /// Correlation below which a candidate is dropped; default 0.3.
    pub min_ncc: f32,
}

/// A volume with its features, on a lattice of the common spacing that starts at `origin`.
pub struct Side<'a> {
    /// Prepared for correlation.
    pub volume: &'a Searchable<'a>,
    /// Position of its first voxel on the common lattice (voxels).
    pub origin: [f64; 3],
    /// Its features, in its own voxels.
    pub features: &'a [[f64; 3]],
}

impl Side<'_> {
    /// Common position of own voxel position `p` (mm).
    fn mm(&self, p: [f64; 3], spacing: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|a| (p[a] + self.origin[a]) * spacing[a])
    }
}

/// Candidates of each initial feature, best correlation first, no two within a voxel of each other.
pub fn candidates(
    initial: &Side<'_>,
    deformed: &Side<'_>,
    spacing: [f64; 3],
    params: CandidateParams,
) -> Vec<Vec<Candidate>> {
    let from_initial = one_way(initial, deformed, initial.features, spacing, params);
    // The strongest of the deformed features, as many as there are initial ones.
    let strongest = &deformed.features[..deformed.features.len().min(initial.features.len())];
    let from_deformed = one_way(deformed, initial, strongest, spacing, params);
    let starts: Vec<[f64; 3]> = initial.features.iter().map(|&p| initial.mm(p, spacing)).collect();
    let tree = Neighbours::new(&starts);
    let near = 2.0 * spacing.iter().fold(0.0f64, |m, &s| m.max(s));
    let mut all: Vec<Vec<Candidate>> = from_initial
        .into_iter()
        .zip(&starts)
        .map(|(found, s)| {
            let candidate =
                |(p, ncc): ([f64; 3], f32)| Candidate { displacement: std::array::from_fn(|a| p[a] - s[a]), ncc };
            found.into_iter().map(candidate).collect()
        })
        .collect();
    // A deformed feature found back at `p` in the initial volume speaks for the initial feature
    // nearest to `p`.
    for (found, &q) in from_deformed.iter().zip(strongest) {
        let q = deformed.mm(q, spacing);
        for &(p, ncc) in found {
            if let Some(&i) = tree.within(p, near, 1).first() {
                all[i].push(Candidate { displacement: std::array::from_fn(|a| q[a] - p[a]), ncc });
            }
        }
    }
    let close = spacing.map(|s| s * 0.9);
    all.par_iter_mut().for_each(|list| {
        list.retain(|c| c.ncc >= params.min_ncc);
        list.sort_by(|a, b| b.ncc.total_cmp(&a.ncc));
        let mut kept: Vec<Candidate> = Vec::with_capacity(2 * params.keep);
        for c in list.iter() {
            let twin = |k: &Candidate| (0..3).all(|a| (k.displacement[a] - c.displacement[a]).abs() < close[a]);
            if kept.len() < 2 * params.keep && !kept.iter().any(twin) {
                kept.push(*c);
            }
        }
        *list = kept;
    });
    all
}

/// For each of `features` (of `from`): the best places in `to` by search, then the best features of
/// `to` (common mm, ncc).
fn one_way(
    from: &Side<'_>,
    to: &Side<'_>,
    features: &[[f64; 3]],
    spacing: [f64; 3],
    params: CandidateParams,
) -> Vec<Vec<([f64; 3], f32)>> {
    let targets: Vec<[f64; 3]> = to.features.iter().map(|&p| to.mm(p, spacing)).collect();
    let tree = Neighbours::new(&targets);
    let reach = spacing.map(|s| (params.reach_mm / s).ceil() as usize);
    features
        .par_iter()
        .map(|&p| {
            let centre = p.map(|v| v.round().max(0.0) as usize);
            let Some(template) = from.volume.template(centre) else { return Vec::new() };
            // The patch sits on a voxel centre; the feature lies a fraction of a voxel beside it.
            let here = from.mm(centre.map(|v| v as f64), spacing);
            let shift: [f64; 3] = std::array::from_fn(|a| (p[a] - centre[a] as f64) * spacing[a]);
            let own = |mm: [f64; 3]| -> [i64; 3] {
                std::array::from_fn(|a| (mm[a] / spacing[a] - to.origin[a]).round() as i64)
            };
            let base = own(here);
            let mut found: Vec<([f64; 3], f32)> = to
                .volume
                .search(&template, base, reach, params.keep)
                .into_iter()
                .map(|peak| {
                    let at: [f64; 3] = std::array::from_fn(|a| (base[a] + i64::from(peak.offset[a])) as f64);
                    let at = to.mm(at, spacing);
                    (std::array::from_fn(|a| at[a] + shift[a]), peak.ncc)
                })
                .collect();
            let mut pairs: Vec<([f64; 3], f32)> = tree
                .within(std::array::from_fn(|a| here[a] + shift[a]), params.reach_mm, params.partners)
                .into_iter()
                .filter_map(|j| to.volume.ncc(&template, own(targets[j])).map(|ncc| (targets[j], ncc)))
                .collect();
            pairs.sort_by(|a, b| b.1.total_cmp(&a.1));
            pairs.truncate(params.keep);
            found.extend(pairs);
            found
        })
        .collect()
}
