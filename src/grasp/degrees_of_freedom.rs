//! Degrees of freedom of rigid and of soft tips by the rank of the constraints' Jacobian, and what
//! fingers of one or two joints can set with their joint angles and with their torques.
//!
//! A finger acts on the contact by the place O of its tip and by the turn phi of its back plate, so
//! one of two joints is, at given angles, one of one joint whose base stands where that puts its
//! tip. Two links hang with the knuckle bent outwards: straight ones could not lift the tip.

use crate::grasp::constraints::Coordinates;
use crate::grasp::models::tips_of;
use crate::grasp::statics::{Equilibrium, Statics};
use crate::numerics::dense::rank;
use crate::types::grasp::Freedom;
use crate::types::{FingertipModel, Scene};

/// Length over the longest below which a direction does not count for the rank.
const RANK_TOLERANCE: f64 = 1e-9;
/// Rotation of a joint for the derivative of an equilibrium (rad).
const DIFFERENCE_STEP_RAD: f64 = 1e-5;
/// Least derivative of a grip per radian, or of a rotation, that is not zero (1).
const MIN_DERIVATIVE: f64 = 1e-6;
/// Bend of the knuckle of a two-joint finger at the pinch (rad): 20 degrees.
const KNUCKLE_BEND_RAD: f64 = 20.0 * std::f64::consts::PI / 180.0;

/// Most moving joints of a left and a right finger.
const MAX_JOINTS: usize = 4;

/// The table for all models, at the pinch of a scene: both fingers, one with the other locked, and
/// a right finger of two joints, whose link is cut in half where the scene has it in one.
///
/// ```
/// use palpate::grasp::degrees_of_freedom::table;
/// use palpate::{FingertipModel, Scene};
/// let rows = table(&Scene::reference());
/// let soft = rows
///     .iter()
///     .find(|r| r.model == FingertipModel::Parallel && r.joints == [1, 1])
///     .ok_or("no row")?;
/// // Two fingers of one joint with soft tips set grasp and posture at once.
/// assert_eq!(soft.controls(), "grasp and posture");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn table(scene: &Scene) -> Vec<Freedom> {
    let own = scene.fingers().map(|f| if f.upper.is_some() { 2 } else { 1 });
    let mut cases = vec![[1, 1], [1, 0], [1, 2]];
    if !cases.contains(&own) {
        cases.push(own);
    }
    let all = FingertipModel::ALL.iter().flat_map(|(_, model)| cases.iter().map(|joints| (*model, *joints)));
    all.map(|(model, joints)| freedom(scene, model, joints)).collect()
}

/// One joint: of which finger, and how it moves that finger's tip (m/rad) and turns its plate (1).
#[derive(Debug, Clone, Copy)]
struct Joint {
    finger: usize,
    tip: [f64; 2],
}

/// The joints of both fingers where the tips stand as at the pinch of fingers of one joint.
fn joints(scene: &Scene, counts: [usize; 2]) -> Vec<Joint> {
    let mut out = Vec::new();
    for (finger, count) in counts.into_iter().enumerate() {
        let of = scene.fingers()[finger];
        let whole = of.upper.unwrap_or(0.0) + of.link;
        let side = if finger == 0 { 1.0 } else { -1.0 };
        if count == 1 {
            out.push(Joint { finger, tip: [side * whole, 0.0] });
        } else if count == 2 {
            let upper = of.upper.unwrap_or(0.5 * whole);
            let lower = whole - upper;
            // The upper link points outwards by the knuckle's bend, the lower one down.
            let (sin, cos) = KNUCKLE_BEND_RAD.sin_cos();
            out.push(Joint { finger, tip: [side * (upper * cos + lower), -upper * sin] });
            out.push(Joint { finger, tip: [side * lower, 0.0] });
        }
    }
    out
}

/// Rows of the constraints over the object's pose (as they are), and over a joint: through the
/// tip's place and the plate's turn.
fn over(rows: &[Coordinates; 4], joint: &Joint, scene: &Scene) -> [f64; 4] {
    let of = scene.fingers()[joint.finger];
    let whole = of.upper.unwrap_or(0.0) + of.link;
    let side = if joint.finger == 0 { 1.0 } else { -1.0 };
    std::array::from_fn(|k| {
        // Displacements depend on the object's place less the tip's. A joint of one link moves the
        // tip across by that link; what is left of its row is the plate's turn.
        let own = k % 2 == joint.finger;
        let turn = if own { rows[k][3 + joint.finger] + side * whole * rows[k][0] } else { 0.0 };
        let tip = if own { -rows[k][0] * joint.tip[0] - rows[k][1] * joint.tip[1] } else { 0.0 };
        turn + tip
    })
}

/// Constraints C = D(q) - d = 0 as rows over (q, d): pose, joints, and the displacements that the
/// model allows.
fn freedom(scene: &Scene, model: FingertipModel, counts: [usize; 2]) -> Freedom {
    let scene = scene.with_model(model);
    let tips = tips_of(&scene, model);
    let statics = Statics::of(&scene, [tips[0].as_ref(), tips[1].as_ref()]);
    let (normal, tangent) = (statics.holds_normal(), statics.holds_tangent());
    let pinch = statics.pinch(&scene);
    let rows = statics.geometry.contact(&pinch.q).jacobian();
    let a = statics.geometry.scale();
    let moving = joints(&scene, counts);
    let columns: Vec<[f64; 4]> = moving.iter().map(|j| over(&rows, j, &scene).map(|v| v / a)).collect();
    let soft = [!normal, !normal, !tangent, !tangent];
    let with = |count: usize| -> Vec<[f64; 3 + MAX_JOINTS + 4]> {
        (0..4)
            .map(|k| {
                let mut row = [0.0; 3 + MAX_JOINTS + 4];
                // Lengths over the radius, so that all columns are of one size.
                (row[0], row[1], row[2]) = (rows[k][0], rows[k][1], rows[k][2] / a);
                columns.iter().take(count).enumerate().for_each(|(j, c)| row[3 + j] = c[k]);
                row[3 + MAX_JOINTS + k] = if soft[k] { -1.0 } else { 0.0 };
                row
            })
            .collect()
    };
    let count = moving.len();
    let displacements = soft.iter().filter(|s| **s).count();
    let (all, locked) = (rank(&with(count), RANK_TOLERANCE), rank(&with(0), RANK_TOLERANCE));
    let coordinates = 3 + count + displacements;
    // Rigid tips answer to angles along their null space alone, and to torques also by their grip.
    let angles: Vec<[f64; 2]> = if normal {
        null_turns(&with(count), count).into_iter().map(|turn| [turn, 0.0]).collect()
    } else {
        moving.iter().filter_map(|j| response(&statics, &pinch, j, &scene)).collect()
    };
    let by_torque = if normal {
        let mut ways = angles.clone();
        if count > coordinates - all {
            ways.push([0.0, 1.0]);
        }
        ways
    } else {
        angles.clone()
    };
    let unit = |v: &[f64; 2]| {
        let length = v[0].hypot(v[1]);
        if length > MIN_DERIVATIVE { [v[0] / length, v[1] / length] } else { [0.0; 2] }
    };
    let significant = |k: usize, ways: &[[f64; 2]]| usize::from(ways.iter().any(|v| v[k].abs() > MIN_DERIVATIVE));
    let both = |ways: &[[f64; 2]]| rank(&ways.iter().map(unit).collect::<Vec<_>>(), MIN_DERIVATIVE);
    // A tip of springs also carries a moment on its plate.
    let carried = if normal || model == FingertipModel::Radial { 2 } else { 3 };
    Freedom {
        model,
        fingers: counts.iter().filter(|c| **c > 0).count(),
        joints: counts,
        contact_forces: 2 * carried,
        coordinates,
        rank: all,
        freedom: coordinates - all,
        object_freedom: 3 + displacements - locked.min(3 + displacements),
        posture_rank: significant(0, &angles),
        grasp_rank: significant(1, &angles),
        both_rank: both(&angles),
        torque_rank: both(&by_torque),
        stable: if normal { 3 + displacements == locked || locked >= 3 } else { pinch.smallest_eigenvalue > 0.0 },
    }
}

/// Turn of the object (1) and change of the grip, over itself, for a unit turn of a joint.
fn response(statics: &Statics<'_>, pinch: &Equilibrium, joint: &Joint, scene: &Scene) -> Option<[f64; 2]> {
    let of = scene.fingers()[joint.finger];
    let whole = of.upper.unwrap_or(0.0) + of.link;
    let side = if joint.finger == 0 { 1.0 } else { -1.0 };
    let turned = |sign: f64| {
        let turn = sign * DIFFERENCE_STEP_RAD;
        let mut moved = *statics;
        // The plate turns with the angle of one joint; the base makes up for where that puts the
        // tip.
        let base = &mut moved.geometry.base[joint.finger];
        let (sin, cos) = turn.sin_cos();
        base[0] += turn * joint.tip[0] - side * whole * sin;
        base[1] += turn * joint.tip[1] - whole * (1.0 - cos);
        let mut angles = [0.0; 2];
        angles[joint.finger] = turn;
        // Where d_t is counted from belongs to the face and stays.
        moved.equilibrium(angles, pinch)
    };
    let (up, down) = (turned(1.0)?, turned(-1.0)?);
    let grip = |e: &Equilibrium| 0.5 * (e.forces[0] + e.forces[1]) / pinch.forces[0];
    Some([(up.q[2] - down.q[2]) / (2.0 * DIFFERENCE_STEP_RAD), (grip(&up) - grip(&down)) / (2.0 * DIFFERENCE_STEP_RAD)])
}

/// Turns of the object along the directions that the rows leave, a unit turn of one joint each.
fn null_turns(rows: &[[f64; 3 + MAX_JOINTS + 4]], count: usize) -> Vec<f64> {
    // Each joint that the others leave free: pose and the other joints answer to it.
    let mut out = Vec::new();
    for free in 0..count {
        let mut order: Vec<usize> = (0..3).chain((0..count).filter(|j| *j != free).map(|j| 3 + j)).collect();
        order.truncate(4);
        if order.len() < 4 {
            continue;
        }
        let matrix: [[f64; 4]; 4] = std::array::from_fn(|k| std::array::from_fn(|c| rows[k][order[c]]));
        let right = std::array::from_fn(|k| -rows[k][3 + free]);
        if let Some(z) = crate::numerics::dense::solve(&matrix, &right) {
            out.push(z[2]);
        }
    }
    out
}
