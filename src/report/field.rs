//! What the report of `palpate field` is made from.

use crate::types::{DenseField, FieldParams, FieldResult, Grid, Mask, Metrics, Volume};

/// A result with the volumes it came from.
#[derive(Debug, Clone, Copy)]
pub struct FieldReport<'a> {
    /// The subcommand, "field" or "demo".
    pub command: &'a str,
    /// Initial volume, deformed volume and mask, as they are called.
    pub names: [&'a str; 3],
    /// The initial volume.
    pub initial: &'a Volume,
    /// The deformed volume resampled on the initial grid without any displacement.
    pub deformed: &'a Volume,
    /// The grid the deformed volume came on.
    pub deformed_grid: &'a Grid,
    /// The mask, on the initial grid.
    pub mask: Option<&'a Mask>,
    /// What was asked for.
    pub params: &'a FieldParams,
    /// What was found.
    pub result: &'a FieldResult,
    /// The true displacement on the initial grid and the score against it, where the truth is known.
    pub truth: Option<(&'a DenseField, &'a Metrics)>,
}

#[cfg(test)]
pub(crate) mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::types::{
        Affine, Counts, FieldSummary, LevelReport, Match, Mesh, MotionModel, SparseField, TetMesh, WorldPoint,
    };

    /// A made-up result with known numbers.
    pub(crate) struct Case {
        pub(crate) initial: Volume,
        pub(crate) params: FieldParams,
        pub(crate) result: FieldResult,
    }

    impl Case {
        pub(crate) fn new(shape: [usize; 3], spacing: [f64; 3]) -> Self {
            let grid = Grid::new(shape, Affine::scaled(spacing, [0.0; 3]).unwrap()).unwrap();
            let initial = Volume::from_vec(grid, (0..grid.len()).map(|i| (i % 97) as f32).collect()).unwrap();
            let displacement = DenseField::from_fn(grid, |p| [0.1 * p.0[0], 0.0, 1.0]);
            let nodes: Vec<WorldPoint> =
                [[0.0; 3], [9.0, 0.0, 0.0], [0.0, 9.0, 0.0], [0.0, 0.0, 9.0]].map(WorldPoint).to_vec();
            let one = |p: &WorldPoint| Match {
                initial: *p,
                displacement: [1.0, 0.0, 0.0],
                ncc: 0.9,
                covariance: [0.01, 0.01, 0.01, 0.0, 0.0, 0.0],
                kept: true,
            };
            let counts = Counts {
                features_initial: 20_000,
                features_deformed: 90_000,
                candidates: 160_000,
                kept: 13_020,
                nodes: 13_020,
                tetrahedra: 80_000,
            };
            let level = LevelReport {
                spacing_mm: spacing,
                counts,
                energy_before: 900.0,
                energy_after: 300.0,
                residual_mm: 0.12,
            };
            let summary = FieldSummary {
                counts,
                model: MotionModel::Free,
                evidence: vec!["free: 12 % lower".into()],
                levels: vec![level],
                folds: 0,
                mask_voxels: grid.len(),
                mean_mm: 1.5,
                max_mm: 2.2,
                uncertainty_median_mm: 0.2,
                seconds: vec![("features".into(), 1.0), ("matching".into(), 2.0)],
                warnings: vec!["two of <three> slices are empty".into()],
            };
            let result = FieldResult {
                displacement,
                warped: initial.clone(),
                jacobian: Volume::filled(grid, 1.1),
                uncertainty: Volume::filled(grid, 0.2),
                matches: SparseField { matches: nodes.iter().map(one).collect() },
                mesh: Mesh::Tetrahedra(TetMesh::new(nodes, vec![[0, 1, 2, 3]]).unwrap()),
                node_displacement: vec![[1.0, 0.0, 0.0]; 4],
                summary,
            };
            Self { initial, params: FieldParams::default(), result }
        }

        pub(crate) fn report(&self) -> FieldReport<'_> {
            FieldReport {
                command: "field",
                names: ["initial.nii.gz", "a<b>.nii", ""],
                initial: &self.initial,
                deformed: &self.initial,
                deformed_grid: self.initial.grid(),
                mask: None,
                params: &self.params,
                result: &self.result,
                truth: None,
            }
        }
    }
}
