//! Where the tips touch: displacements as functions of pose and joint angles, with their
//! derivatives.
//!
//! With n = (cos theta, sin theta), t = (-sin theta, cos theta), tip centres O1, O2 and r_i = p -
//! O_i, the normal constraints C_H and the integrated rolling constraints C_N of the source give
//!
//! ```text
//! d_n1 = a + W/2 - r_1 . n        d_t1 = r_1 . t - a (theta_1 - theta)
//! d_n2 = a + W/2 + r_2 . n        d_t2 = r_2 . t - a (theta_2 + theta)
//! ```
//!
//! less the place where each tip began or to where it has slid, with a radius, a link and a base of
//! each finger's own; the tilts are theta - theta_1 and -(theta + theta_2) (docs/reference/grasp.md
//! has both signs settled).
//! Rows of a Jacobian stand in the order d_n1, d_n2, d_t1, d_t2; coordinates in the order x, y,
//! theta, theta_1, theta_2.

use crate::grasp::models::Tilt;
use crate::numerics::trig::sin_cos;
use crate::types::Scene;

/// Pose and joint angles (m, rad): x, y, theta, theta_1, theta_2.
pub(crate) type Coordinates = [f64; 5];

/// Lengths of a scene (m); index 0 is the left finger.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Geometry {
    /// Radius a of each tip.
    pub radius: [f64; 2],
    /// Link length l of each finger.
    pub link: [f64; 2],
    /// Places of the joints.
    pub base: [[f64; 2]; 2],
    /// Half the object's width.
    pub half_width: f64,
    /// Places along the face, r . t - a (turn), at which d_t is 0: 0 for fingers that are alike
    /// before they slide.
    pub origin: [f64; 2],
}

impl Geometry {
    /// Of a scene.
    pub fn of(scene: &Scene) -> Self {
        let [one, two] = scene.fingers();
        // Two links that hang straight are one of their length.
        let link = [one, two].map(|f| f.upper.unwrap_or(0.0) + f.link);
        let base = scene.bases();
        let radius = scene.fingertips().map(|tip| tip.radius);
        // d_t = 0 where the object hangs level between the tips' mean height.
        let heights = [base[0][1] - link[0], base[1][1] - link[1]];
        let apart = 0.5 * (heights[1] - heights[0]);
        Self { radius, link, base, half_width: 0.5 * scene.object.width, origin: [apart, -apart] }
    }

    /// Length by which angles are made comparable to lengths (m): the left tip's radius.
    pub fn scale(&self) -> f64 {
        self.radius[0]
    }

    /// Height of the tips' centres at joint angles 0 (m): the mean of both.
    pub fn level(&self) -> f64 {
        0.5 * (self.base[0][1] - self.link[0] + self.base[1][1] - self.link[1])
    }

    /// Tip centres O1, O2 (m) at joint angles (rad).
    pub fn tips(&self, joints: [f64; 2]) -> [[f64; 2]; 2] {
        let ([s1, s2], [c1, c2]) = sin_cos(joints);
        let ([l1, l2], [b1, b2]) = (self.link, self.base);
        [[l1 * s1 + b1[0], b1[1] - l1 * c1], [b2[0] - l2 * s2, b2[1] - l2 * c2]]
    }

    /// The contact at a pose and joint angles.
    #[inline(always)]
    pub fn contact(&self, q: &Coordinates) -> Contact {
        let ([s, s1, s2], [c, c1, c2]) = sin_cos([q[2], q[3], q[4]]);
        let ([l1, l2], [a1, a2], [b1, b2]) = (self.link, self.radius, self.base);
        let r1 = [q[0] - b1[0] - l1 * s1, q[1] - b1[1] + l1 * c1];
        let r2 = [q[0] - b2[0] + l2 * s2, q[1] - b2[1] + l2 * c2];
        let along = [r1[0] * c + r1[1] * s, r2[0] * c + r2[1] * s];
        let across = [r1[1] * c - r1[0] * s, r2[1] * c - r2[0] * s];
        Contact {
            geometry: *self,
            face: [c, s],
            link_x: [l1 * c1, -l2 * c2],
            link_y: [l1 * s1, l2 * s2],
            along,
            across,
            sine: [s1 * c - c1 * s, s2 * c + c2 * s],
            cosine: [c1 * c + s1 * s, c2 * c - s2 * s],
            normal: [a1 + self.half_width - along[0], a2 + self.half_width + along[1]],
            tangential: [
                across[0] - a1 * (q[3] - q[2]) - self.origin[0],
                across[1] - a2 * (q[4] + q[2]) - self.origin[1],
            ],
        }
    }
}

/// The contact at one pose; index 0 is the left finger.
#[derive(Debug, Clone, Copy)]
pub struct Contact {
    geometry: Geometry,
    /// cos theta, sin theta.
    face: [f64; 2],
    /// d O_i / d theta_i.
    link_x: [f64; 2],
    link_y: [f64; 2],
    /// r_i . n.
    along: [f64; 2],
    /// r_i . t.
    across: [f64; 2],
    /// Sine and cosine of theta_1 - theta and theta_2 + theta.
    sine: [f64; 2],
    cosine: [f64; 2],
    /// d_n (m).
    pub normal: [f64; 2],
    /// d_t (m).
    pub tangential: [f64; 2],
}

impl Contact {
    /// Tilt of finger `i`: theta - theta_1, -(theta + theta_2).
    #[inline(always)]
    pub fn tilt(&self, i: usize) -> Tilt {
        Tilt { sin: -self.sine[i], cos: self.cosine[i] }
    }

    /// d_n1, d_n2, d_t1, d_t2 (m).
    #[inline(always)]
    pub fn displacements(&self) -> [f64; 4] {
        [self.normal[0], self.normal[1], self.tangential[0], self.tangential[1]]
    }

    /// J v: rates of d_n1, d_n2, d_t1, d_t2 (m/s) at the velocity `v`.
    #[inline(always)]
    pub fn rates(&self, v: &Coordinates) -> [f64; 4] {
        let [c, s] = self.face;
        let [a1, a2] = self.geometry.radius;
        let along = |i: usize| {
            let (x, y) = (v[0] - self.link_x[i] * v[3 + i], v[1] - self.link_y[i] * v[3 + i]);
            (x * c + y * s + self.across[i] * v[2], y * c - x * s - self.along[i] * v[2])
        };
        let ((n1, t1), (n2, t2)) = (along(0), along(1));
        [-n1, n2, t1 - a1 * (v[3] - v[2]), t2 - a2 * (v[4] + v[2])]
    }

    /// J' v: what the second derivatives of the displacements have beside J v' (m/s^2).
    #[inline(always)]
    pub fn acceleration_bias(&self, v: &Coordinates) -> [f64; 4] {
        let [c, s] = self.face;
        let bias = |i: usize| {
            let w = v[3 + i];
            let (x, y) = (v[0] - self.link_x[i] * w, v[1] - self.link_y[i] * w);
            // r'' at v' = 0: minus the centripetal part of the tip's acceleration.
            let sign = if i == 0 { 1.0 } else { -1.0 };
            let (ax, ay) = (sign * self.link_y[i] * w * w, -sign * self.link_x[i] * w * w);
            let along = ax * c + ay * s + 2.0 * v[2] * (y * c - x * s) - self.along[i] * v[2] * v[2];
            let across = ay * c - ax * s - 2.0 * v[2] * (x * c + y * s) - self.across[i] * v[2] * v[2];
            (along, across)
        };
        let ((n1, t1), (n2, t2)) = (bias(0), bias(1));
        [-n1, n2, t1, t2]
    }

    /// Where the tips touch along the face (m), from the middle of the object's side.
    #[inline(always)]
    pub fn places(&self) -> [f64; 2] {
        [-self.across[0], -self.across[1]]
    }

    /// J^T f plus the moments' part: generalised forces (N, N m) of the forces d_n1, d_n2, d_t1,
    /// d_t2 (N) and of the moments on the tilts (N m).
    #[inline(always)]
    pub fn pull(&self, f: &[f64; 4], moments: &[f64; 2]) -> Coordinates {
        let [c, s] = self.face;
        let Geometry { radius: [a1, a2], link: [l1, l2], .. } = self.geometry;
        let [n1, n2, t1, t2] = *f;
        let (squeeze, drag) = (n2 - n1, t1 + t2);
        [
            c * squeeze - s * drag,
            s * squeeze + c * drag,
            self.across[1] * n2 - self.across[0] * n1 + t1 * (a1 - self.along[0]) - t2 * (a2 + self.along[1])
                + moments[0]
                - moments[1],
            l1 * (n1 * self.cosine[0] - t1 * self.sine[0]) - a1 * t1 - moments[0],
            l2 * (n2 * self.cosine[1] - t2 * self.sine[1]) - a2 * t2 - moments[1],
        ]
    }

    /// Moment about the object's centre (N m) of pushes, from
    /// [`crate::grasp::control::Inputs::moment`].
    #[inline(always)]
    pub fn turn(&self, moment: [f64; 2]) -> f64 {
        moment[0] * self.face[0] - moment[1] * self.face[1]
    }

    /// J: derivatives of d_n1, d_n2, d_t1, d_t2, row by row.
    pub fn jacobian(&self) -> [Coordinates; 4] {
        std::array::from_fn(|row| self.pull(&std::array::from_fn(|k| f64::from(u8::from(k == row))), &[0.0; 2]))
    }

    /// Sum of `f`_k times the second derivatives of d_k in (x, y, theta), joints fixed (N/m, N, N
    /// m).
    pub fn curvature(&self, f: &[f64; 4]) -> [[f64; 3]; 3] {
        let [c, s] = self.face;
        let [n1, n2, t1, t2] = *f;
        let (squeeze, drag) = (n2 - n1, t1 + t2);
        let x = -s * squeeze - c * drag;
        let y = c * squeeze - s * drag;
        let turn = n1 * self.along[0] - n2 * self.along[1] - t1 * self.across[0] - t2 * self.across[1];
        [[0.0, 0.0, x], [0.0, 0.0, y], [x, y, turn]]
    }
}
