//! What the report of `palpate field` is made from.

use crate::report::strain::StrainReport;
use crate::types::{DenseField, FieldParams, FieldSummary, Grid, Mask, Mesh, Metrics, SparseField, Voxels};

/// A value for each voxel offset (x fastest): a volume, or what can be worked out where a picture
/// asks for it.
pub type Values<'a> = &'a (dyn Fn(usize) -> f32 + Sync);

/// A result with the volumes it came from. All on the initial volume's grid.
#[derive(Clone, Copy)]
pub(crate) struct FieldReport<'a> {
    /// The subcommand, "field" or "demo".
    pub command: &'a str,
    /// Initial volume, deformed volume and mask, as they are called.
    pub names: [&'a str; 3],
    /// The initial volume.
    pub initial: &'a Voxels<'a>,
    /// The deformed volume without any displacement.
    pub deformed: Values<'a>,
    /// The grid the deformed volume came on.
    pub deformed_grid: &'a Grid,
    /// The deformed volume at x + u(x).
    pub warped: Values<'a>,
    /// The mask.
    pub mask: Option<&'a Mask>,
    /// What was asked for.
    pub params: &'a FieldParams,
    /// Displacement, initial to deformed (mm, RAS).
    pub displacement: &'a DenseField,
    /// Jacobian determinant of x + u(x) (1).
    pub jacobian: Values<'a>,
    /// One standard deviation of the displacement (mm).
    pub uncertainty: Values<'a>,
    /// The body of each voxel that was measured, from 1; 0 elsewhere.
    pub bodies: &'a Mask,
    /// All matches with covariance.
    pub matches: &'a SparseField,
    /// The mesh through the kept matches (initial positions).
    pub mesh: &'a Mesh,
    /// Displacement at the mesh's nodes (mm, RAS).
    pub node_displacement: &'a [[f64; 3]],
    /// The rest.
    pub summary: &'a FieldSummary,
    /// The true displacement and the score against it, where the truth is known.
    pub truth: Option<(&'a DenseField, &'a Metrics)>,
    /// The strain, where it was asked for.
    pub strain: Option<StrainReport<'a>>,
}

#[cfg(test)]
pub(crate) mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::types::{
        Affine, Agreement, BodyReport, Counts, ErrorSource, ExpectedError, LevelReport, Match, MotionModel,
        StageReport, TetMesh, Volume, WorldPoint,
    };

    /// A made-up result with known numbers.
    pub(crate) struct Case {
        pub(crate) initial: Volume,
        pub(crate) warped: Value,
        pub(crate) deformed: Value,
        pub(crate) uncertainty: Value,
        pub(crate) bodies: Mask,
        pub(crate) displacement: DenseField,
        pub(crate) summary: FieldSummary,
        params: FieldParams,
        jacobian: Value,
        matches: SparseField,
        mesh: Mesh,
    }

    type Value = Box<dyn Fn(usize) -> f32 + Sync>;

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
                raw: None,
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
                rejected: false,
                evidence: vec!["free: 12 % lower".into()],
                bodies: vec![BodyReport {
                    label: 1,
                    voxels: grid.len(),
                    model: MotionModel::Free,
                    slides_mm: 0.0,
                    expected_error_mm: 0.2,
                }],
                levels: vec![level],
                stages: vec![StageReport {
                    name: "final".into(),
                    spacing_mm: spacing,
                    moved_mm: 1.5,
                    unexplained: 0.1,
                    error_mm: None,
                }],
                folds: 0,
                mask_voxels: grid.len(),
                mean_mm: 1.5,
                max_mm: 2.2,
                uncertainty_median_mm: 0.2,
                expected: ExpectedError {
                    mean_mm: 0.12,
                    interval_mm: [0.06, 0.24],
                    p95_mm: 0.5,
                    against_mm: 1.5,
                    sources: vec![(ErrorSource::Noise, 0.9), (ErrorSource::Misfit, 0.1)],
                    labels: Vec::new(),
                },
                unseen: 0.0,
                agreement: Agreement { at_rest: 0.5, found: 0.9 },
                recast: None,
                landmarks: None,
                start: None,
                seconds: vec![("features".into(), 1.0), ("matching".into(), 2.0)],
                warnings: vec!["two of <three> slices are empty".into()],
            };
            let same = initial.clone();
            Self {
                warped: Box::new(move |o| same.as_slice()[o]),
                deformed: Box::new(|o| (o % 97) as f32),
                uncertainty: Box::new(|_| 0.2),
                bodies: Mask::filled(grid, 1),
                displacement,
                summary,
                params: FieldParams::default(),
                jacobian: Box::new(|_| 1.1),
                matches: SparseField { matches: nodes.iter().map(one).collect() },
                mesh: Mesh::Tetrahedra(TetMesh::new(nodes, vec![[0, 1, 2, 3]]).unwrap()),
                initial,
            }
        }

        pub(crate) fn report(&self) -> FieldReport<'_> {
            FieldReport {
                command: "field",
                names: ["initial.nii.gz", "a<b>.nii", ""],
                initial: &self.initial,
                deformed: &*self.deformed,
                deformed_grid: self.initial.grid(),
                warped: &*self.warped,
                mask: None,
                params: &self.params,
                displacement: &self.displacement,
                jacobian: &*self.jacobian,
                uncertainty: &*self.uncertainty,
                bodies: &self.bodies,
                matches: &self.matches,
                mesh: &self.mesh,
                node_displacement: &[[1.0, 0.0, 0.0]; 4],
                summary: &self.summary,
                truth: None,
                strain: None,
            }
        }
    }
}
