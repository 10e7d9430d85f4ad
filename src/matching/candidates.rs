//! Candidate matches, many to many: each place of the initial volume keeps several places of the
//! deformed one.
//!
//! Four sources are joined (Zhang, Hirai, Endo & Morikawa 2007 use the first): features paired with
//! features of the other volume through a k-d tree, from the initial side and from the deformed
//! side, and exhaustive search of a feature's patch in the other volume, again from either side.

use crate::error::FieldError;
use crate::matching::correlation::Searchable;
use crate::matching::levels::OnAxes;
use crate::numerics::neighbours::Neighbours;
use crate::numerics::pyramid::finest;
use crate::types::{Candidate, FeaturePoint, Grid, GridVector, SparseField, VoxelPoint, Voxels};
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

impl CandidateParams {
    /// The defaults, for displacements up to `reach_mm`.
    pub fn within(reach_mm: f64) -> Self {
        Self { reach_mm, keep: 6, partners: 48, min_ncc: 0.3 }
    }
}

/// Candidates of each initial feature between two volumes on any grids, best correlation first: as
/// [`candidates`], by patches of 7 voxels of the finest axis.
///
/// `features` are the initial and the deformed volume's ([`FeaturePoint`] holds their world
/// places). The displacements run along the axes of the initial grid.
///
/// # Errors
/// [`FieldError::NoOverlap`] when the volumes, widened by the reach, do not meet;
/// [`FieldError::Space`] when there is no grid to resample the deformed volume on.
///
/// ```
/// use palpate::features::detect;
/// use palpate::matching::candidates::{CandidateParams, between};
/// use palpate::synth::{MotionKind, PhantomKind, PhantomParams, phantom};
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let block = PhantomParams::new(PhantomKind::Block).sized(24).moving(MotionKind::Translate);
/// let pair = phantom(&block)?;
/// let here = detect(&pair.initial, Some(&pair.mask), 20)?;
/// let there = detect(&pair.deformed, None, 100)?;
/// let lists =
///     between(&pair.initial, &pair.deformed, [&here, &there], CandidateParams::within(9.0))?;
/// assert_eq!(lists.len(), here.len());
/// assert!(lists.iter().flatten().all(|c| c.ncc >= 0.3));
/// # Ok(())
/// # }
/// ```
pub fn between(
    initial: &Voxels<'_>,
    deformed: &Voxels<'_>,
    features: [&[FeaturePoint]; 2],
    params: CandidateParams,
) -> Result<Vec<Vec<Candidate>>, FieldError> {
    let grid = initial.grid();
    let (shape, spacing) = (grid.shape(), grid.spacing());
    let moving = OnAxes::of(grid, deformed, params.reach_mm)?;
    let patch = SparseField::PATCH as f64 * finest(shape, spacing);
    let radius = spacing.map(|s| ((patch / s).round() as usize).max(1));
    let own = |points: &[FeaturePoint], origin: [f64; 3]| -> Vec<VoxelPoint> {
        let voxel = |f: &FeaturePoint| grid.affine().to_voxel(f.world).0;
        points.iter().map(voxel).map(|p| VoxelPoint(std::array::from_fn(|a| p[a] - origin[a]))).collect()
    };
    let [here, there] = [own(features[0], [0.0; 3]), own(features[1], moving.origin)];
    let fixed = Searchable::new(initial.as_slice(), shape, radius);
    let other = Searchable::new(&moving.values, moving.shape, radius);
    let initial = Side { volume: &fixed, origin: [0.0; 3], features: &here };
    let deformed = Side { volume: &other, origin: moving.origin, features: &there };
    Ok(candidates(&initial, &deformed, spacing, params))
}

/// How alike two features are: 1 where they are the same, less for others. A closure is one too.
///
/// ```
/// use palpate::FeaturePoint;
/// use palpate::matching::candidates::Similarity;
/// struct Strength;
/// impl Similarity for Strength {
///     fn between(&self, initial: &FeaturePoint, deformed: &FeaturePoint) -> f32 {
///         1.0 - (initial.response - deformed.response).abs()
///     }
/// }
/// ```
pub trait Similarity: Sync {
    /// Of a feature of the initial volume and one of the deformed volume.
    fn between(&self, initial: &FeaturePoint, deformed: &FeaturePoint) -> f32;
}

impl<F: Fn(&FeaturePoint, &FeaturePoint) -> f32 + Sync> Similarity for F {
    fn between(&self, initial: &FeaturePoint, deformed: &FeaturePoint) -> f32 {
        self(initial, deformed)
    }
}

/// Candidates of each initial feature among the deformed ones, by a similarity of the caller's
/// own, best first.
///
/// Looks at the `partners` nearest features within the reach (a distance here) and keeps the best
/// of those that are at least `min_ncc` alike. The similarity stands as [`Candidate::ncc`].
/// `grid` is the initial volume's.
///
/// ```
/// use palpate::matching::candidates::{CandidateParams, paired};
/// use palpate::{Affine, FeaturePoint, Grid, VoxelPoint, WorldPoint};
/// let grid = Grid::new([32, 32, 32], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let at = |x, response| FeaturePoint {
///     voxel: VoxelPoint([x, 5.0, 5.0]),
///     world: WorldPoint([x, 5.0, 5.0]),
///     response,
/// };
/// let (here, there) = ([at(10.0, 2.0)], [at(11.0, 9.0), at(13.0, 2.1)]);
/// // Alike are corners of like strength.
/// let alike = |a: &FeaturePoint, b: &FeaturePoint| 1.0 - (a.response - b.response).abs();
/// let lists = paired(&grid, [&here, &there], CandidateParams::within(5.0), &alike);
/// assert_eq!(lists[0].len(), 1);
/// assert_eq!(grid.vector_to_world(lists[0][0].displacement), [3.0, 0.0, 0.0]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn paired(
    grid: &Grid,
    [initial, deformed]: [&[FeaturePoint]; 2],
    params: CandidateParams,
    similarity: &impl Similarity,
) -> Vec<Vec<Candidate>> {
    let places: Vec<[f64; 3]> = deformed.iter().map(|f| f.world.0).collect();
    let tree = Neighbours::new(&places);
    let of = |from: &FeaturePoint| {
        let near = tree.within(from.world.0, params.reach_mm, params.partners).into_iter().map(|j| &deformed[j]);
        let candidate = |to: &FeaturePoint| Candidate {
            displacement: grid.vector_from_world(to.world.minus(from.world)),
            ncc: similarity.between(from, to),
        };
        let mut list: Vec<Candidate> = near.map(candidate).filter(|c| c.ncc >= params.min_ncc).collect();
        list.sort_by(|a, b| b.ncc.total_cmp(&a.ncc));
        list.truncate(params.keep);
        list
    };
    initial.par_iter().map(of).collect()
}

/// A volume with its features, on a lattice of the common spacing that starts at `origin`.
pub struct Side<'a> {
    /// Prepared for correlation.
    pub volume: &'a Searchable<'a>,
    /// Position of its first voxel on the common lattice (voxels).
    pub origin: [f64; 3],
    /// Its features, in its own voxels.
    pub features: &'a [VoxelPoint],
}

impl Side<'_> {
    /// Common position of own voxel position `p` (mm).
    fn mm(&self, VoxelPoint(p): VoxelPoint, spacing: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|a| (p[a] + self.origin[a]) * spacing[a])
    }
}

/// Candidates of each initial feature, best correlation first, no two within a voxel of each other.
///
/// For volumes whose voxels have the same axes and `spacing` (mm); [`between`] takes any two. The
/// displacements run along those axes.
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
            let candidate = |(p, ncc): ([f64; 3], f32)| Candidate { displacement: apart(p, *s), ncc };
            found.into_iter().map(candidate).collect()
        })
        .collect();
    // A deformed feature found back at `p` in the initial volume speaks for the initial feature
    // nearest to `p`.
    for (found, &q) in from_deformed.iter().zip(strongest) {
        let q = deformed.mm(q, spacing);
        for &(p, ncc) in found {
            if let Some(&i) = tree.within(p, near, 1).first() {
                all[i].push(Candidate { displacement: apart(q, p), ncc });
            }
        }
    }
    let close = spacing.map(|s| s * 0.9);
    all.par_iter_mut().for_each(|list| {
        list.retain(|c| c.ncc >= params.min_ncc);
        list.sort_by(|a, b| b.ncc.total_cmp(&a.ncc));
        let mut kept: Vec<Candidate> = Vec::with_capacity(2 * params.keep);
        for c in list.iter() {
            let twin = |k: &Candidate| (0..3).all(|a| (k.displacement.0[a] - c.displacement.0[a]).abs() < close[a]);
            if kept.len() < 2 * params.keep && !kept.iter().any(twin) {
                kept.push(*c);
            }
        }
        *list = kept;
    });
    all
}

/// The vector from `from` to `to`.
fn apart(to: [f64; 3], from: [f64; 3]) -> GridVector {
    GridVector(std::array::from_fn(|a| to[a] - from[a]))
}

/// For each of `features` (of `from`): the best places in `to` by search, then the best features of
/// `to` (common mm, ncc).
fn one_way(
    from: &Side<'_>,
    to: &Side<'_>,
    features: &[VoxelPoint],
    spacing: [f64; 3],
    params: CandidateParams,
) -> Vec<Vec<([f64; 3], f32)>> {
    let targets: Vec<[f64; 3]> = to.features.iter().map(|&p| to.mm(p, spacing)).collect();
    let tree = Neighbours::new(&targets);
    let reach = spacing.map(|s| (params.reach_mm / s).ceil() as usize);
    features
        .par_iter()
        .map(|&VoxelPoint(p)| {
            let centre = p.map(|v| v.round().max(0.0) as usize);
            let Some(template) = from.volume.template(centre) else { return Vec::new() };
            // The patch sits on a voxel centre; the feature lies a fraction of a voxel beside it.
            let here = from.mm(VoxelPoint(centre.map(|v| v as f64)), spacing);
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
                    let at = std::array::from_fn(|a| (base[a] + i64::from(peak.offset[a])) as f64);
                    let at = to.mm(VoxelPoint(at), spacing);
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
