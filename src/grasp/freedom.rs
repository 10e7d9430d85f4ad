//! Degrees of freedom of rigid and of soft tips by the rank of the constraints' Jacobian, and what
//! one or two 1-DOF fingers can set with their joint angles.

use crate::grasp::constraints::Coordinates;
use crate::grasp::models::tips_of;
use crate::grasp::statics::Statics;
use crate::numerics::dense::rank;
use crate::types::grasp::Freedom;
use crate::types::{FingertipModel, Scene};

/// Directions shorter than this part of the longest do not count.
const TOLERANCE: f64 = 1e-9;
/// Turn of a joint for the derivative of an equilibrium (rad).
const TURN: f64 = 1e-5;

/// The table for all models, at the pinch of a scene: two moving fingers, then one with the other
/// locked.
pub fn table(scene: &Scene) -> Vec<Freedom> {
    let cases = FingertipModel::ALL.iter().flat_map(|(_, model)| [2, 1].map(|fingers| (*model, fingers)));
    cases.map(|(model, fingers)| freedom(scene, model, fingers)).collect()
}

/// Constraints C = D(q) - d = 0 as rows over (q, d): pose, the first `fingers` joints, and the
/// displacements that the model allows.
fn freedom(scene: &Scene, model: FingertipModel, fingers: usize) -> Freedom {
    let scene = scene.with_model(model);
    let tips = tips_of(&scene, model);
    let statics = Statics::of(&scene, [tips[0].as_ref(), tips[1].as_ref()]);
    let tip = statics.tips[0];
    let pinch = statics.pinch(&scene);
    let rows = statics.geometry.contact(&pinch.q).jacobian();
    let soft = [!tip.holds_normal(), !tip.holds_normal(), !tip.holds_tangent(), !tip.holds_tangent()];
    let over = |joints: usize| -> Vec<[f64; 9]> {
        (0..4)
            .map(|k| {
                let mut row = [0.0; 9];
                row[..3 + joints].copy_from_slice(&rows[k][..3 + joints]);
                row[5 + k] = if soft[k] { -1.0 } else { 0.0 };
                // Lengths over the radius, so that all columns are of one size.
                row[2] /= statics.geometry.scale();
                (row[3], row[4]) = (row[3] / statics.geometry.scale(), row[4] / statics.geometry.scale());
                row
            })
            .collect()
    };
    let displacements = soft.iter().filter(|s| **s).count();
    let (all, locked) = (rank(&over(fingers), TOLERANCE), rank(&over(0), TOLERANCE));
    let derivatives = if tip.holds_normal() {
        // Without compliance no force follows from joint angles, and angles only move along the
        // null space.
        let turns = null_turn(&rows, fingers).map_or(Vec::new(), |t| vec![[t, 0.0]]);
        transposed(&turns)
    } else {
        let columns = (0..fingers).filter_map(|i| {
            let turned = |sign: f64| {
                let mut joints = [0.0; 2];
                joints[i] = sign * TURN;
                statics.equilibrium(joints, &pinch)
            };
            let (up, down) = (turned(1.0)?, turned(-1.0)?);
            let grip = |f: &[f64; 4]| 0.5 * (f[0] + f[1]) / pinch.forces[0];
            Some([(up.q[2] - down.q[2]) / (2.0 * TURN), (grip(&up.forces) - grip(&down.forces)) / (2.0 * TURN)])
        });
        transposed(&columns.collect::<Vec<_>>())
    };
    let significant = |row: &[f64; 2]| usize::from(row.iter().any(|v| v.abs() > 1e-6));
    let unit = |row: &[f64; 2]| {
        let length = row[0].hypot(row[1]);
        if length > 1e-6 { [row[0] / length, row[1] / length] } else { [0.0; 2] }
    };
    Freedom {
        model,
        fingers,
        coordinates: 3 + fingers + displacements,
        rank: all,
        freedom: 3 + fingers + displacements - all,
        object_freedom: 3 + displacements - locked.min(3 + displacements),
        posture_rank: significant(&derivatives[0]),
        grasp_rank: significant(&derivatives[1]),
        both_rank: rank(&derivatives.map(|r| unit(&r)), 1e-6),
    }
}

/// From one (theta, grip) a joint to a row of theta and a row of grip over the joints.
fn transposed(columns: &[[f64; 2]]) -> [[f64; 2]; 2] {
    let mut out = [[0.0; 2]; 2];
    for (i, column) in columns.iter().enumerate().take(2) {
        (out[0][i], out[1][i]) = (column[0], column[1]);
    }
    out
}

/// Turn of the object along the one direction that four held rows leave of pose and joints, for a
/// unit turn of joint 1; none where nothing is left, as with one finger.
fn null_turn(rows: &[Coordinates; 4], fingers: usize) -> Option<f64> {
    if fingers < 2 {
        return None;
    }
    // J_rest z = -J_1: unknowns x, y, theta, theta_2 for theta_1 = 1.
    let matrix = rows.map(|r| [r[0], r[1], r[2], r[4]]);
    let right = rows.map(|r| -r[3]);
    crate::numerics::dense::solve(&matrix, &right).map(|z| z[2])
}
