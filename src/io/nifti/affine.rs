//! Voxel to world: sform, qform or neither, and back to a quaternion.
//!
//! Formulas: nifti1.h, "3D IMAGE (VOLUME) ORIENTATION AND LOCATION IN SPACE" and
//! `nifti_quatern_to_mat44`, `nifti_mat44_to_quatern` in nifti1_io.c.

use super::header::Header;
use crate::io::format_error::Flaw;
use crate::types::space::Matrix3;
use crate::types::{Affine, VoxelPoint};

/// Largest cosine between two axes that still counts as a right angle; 200 mm away it moves a voxel
/// by 2 um.
const MAX_SHEAR_COSINE: f64 = 1e-5;

/// The affine (mm, RAS): the sform where its code is positive, else the qform where its code is,
/// else the voxel size with the first voxel at the origin. `axes` are the first three, to excuse an
/// unset size along an axis of one voxel.
pub(super) fn affine(h: &Header, axes: [usize; 3]) -> Result<Affine, Flaw> {
    if h.sform_code > 0 { in_mm(h, h.srow) } else { in_mm(h, quatern_rows(h, axes)?) }
}

/// The largest distance between where the sform and the qform of a header place a corner of its
/// volume (mm); None where it has not both.
pub(super) fn disagreement(h: &Header, axes: [usize; 3]) -> Option<f64> {
    if h.sform_code <= 0 || h.qform_code <= 0 {
        return None;
    }
    let [a, b] = [in_mm(h, h.srow).ok()?, in_mm(h, quatern_rows(h, axes).ok()?).ok()?];
    let corner = |n: usize| VoxelPoint([0, 1, 2].map(|d| ((n >> d & 1) * (axes[d] - 1)) as f64));
    let apart = |n: usize| a.to_world(corner(n)).minus(b.to_world(corner(n))).iter().map(|d| d * d).sum::<f64>().sqrt();
    Some((0..8).map(apart).fold(0.0, f64::max))
}

/// By the qform, or by the voxel size alone, in the header's unit.
fn quatern_rows(h: &Header, axes: [usize; 3]) -> Result<[[f64; 4]; 3], Flaw> {
    let size = voxel_size(h, axes)?;
    let (rotation, at) = match h.qform_code > 0 {
        true => (rotation(h.quatern), [h.quatern[3], h.quatern[4], h.quatern[5]]),
        false => ([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], [0.0; 3]),
    };
    let qfac = if h.qform_code > 0 && h.pixdim[0] < 0.0 { -1.0 } else { 1.0 };
    let column = [size[0], size[1], qfac * size[2]];
    Ok(std::array::from_fn(|r| std::array::from_fn(|c| if c < 3 { rotation[r][c] * column[c] } else { at[r] })))
}

fn in_mm(h: &Header, rows: [[f64; 4]; 3]) -> Result<Affine, Flaw> {
    // NIFTI_UNITS_METER 1, _MM 2, _MICRON 3.
    let unit = match h.xyzt_units & 7 {
        1 => 1e3,
        3 => 1e-3,
        _ => 1.0,
    };
    Affine::new(rows.map(|row| row.map(|v| v * unit)))
        .map_err(|e| Flaw::new(e.to_string(), "write the true voxel size and orientation into the header"))
}

fn voxel_size(h: &Header, axes: [usize; 3]) -> Result<[f64; 3], Flaw> {
    let mut size = [0.0; 3];
    for a in 0..3 {
        size[a] = match h.pixdim[a + 1] {
            v if v > 0.0 && v.is_finite() => v,
            _ if axes[a] == 1 => 1.0,
            v => {
                let what = format!("there is no sform and pixdim[{}] is {v}, not a voxel size", a + 1);
                return Err(Flaw::new(what, "write the true voxel size into the header"));
            }
        };
    }
    Ok(size)
}

/// The rotation of the unit quaternion (a, b, c, d) with a >= 0.
fn rotation([b, c, d, ..]: [f64; 6]) -> Matrix3 {
    let rest = 1.0 - (b * b + c * c + d * d);
    let (a, s) = if rest < 1e-7 { (0.0, 1.0 / (1.0 - rest).sqrt()) } else { (rest.sqrt(), 1.0) };
    let (b, c, d) = (s * b, s * c, s * d);
    [
        [a * a + b * b - c * c - d * d, 2.0 * (b * c - a * d), 2.0 * (b * d + a * c)],
        [2.0 * (b * c + a * d), a * a + c * c - b * b - d * d, 2.0 * (c * d - a * b)],
        [2.0 * (b * d - a * c), 2.0 * (c * d + a * b), a * a + d * d - c * c - b * b],
    ]
}

/// qfac (-1 or 1) and the quaternion's (b, c, d); none when the affine has shear.
pub(super) fn quaternion(affine: &Affine) -> Option<(f64, [f64; 3])> {
    let (linear, size) = (affine.linear(), affine.spacing());
    let mut r: Matrix3 = std::array::from_fn(|i| std::array::from_fn(|j| linear[i][j] / size[j]));
    let dot = |r: &Matrix3, p: usize, q: usize| (0..3).map(|i| r[i][p] * r[i][q]).sum::<f64>();
    if [(0, 1), (0, 2), (1, 2)].iter().any(|&(p, q)| dot(&r, p, q).abs() > MAX_SHEAR_COSINE) {
        return None;
    }
    let determinant = (0..3).map(|i| r[0][i] * minor(&r, i)).sum::<f64>();
    let qfac = determinant.signum();
    r.iter_mut().for_each(|row| row[2] *= qfac);

    // The largest of a, b, c, d is found first, so that nothing small is divided by.
    let trace = [r[0][0] + r[1][1] + r[2][2], r[0][0] - r[1][1] - r[2][2], r[1][1] - r[0][0] - r[2][2], {
        r[2][2] - r[0][0] - r[1][1]
    }];
    let largest = (1..4).fold(0, |m, i| if trace[i] > trace[m] { i } else { m });
    let big = 0.5 * (1.0 + trace[largest]).max(0.0).sqrt();
    let quarter = 0.25 / big;
    let (sum, difference) =
        (|i: usize, j: usize| quarter * (r[i][j] + r[j][i]), |i: usize, j: usize| quarter * (r[i][j] - r[j][i]));
    let (a, bcd) = match largest {
        0 => (big, [difference(2, 1), difference(0, 2), difference(1, 0)]),
        1 => (difference(2, 1), [big, sum(0, 1), sum(0, 2)]),
        2 => (difference(0, 2), [sum(0, 1), big, sum(1, 2)]),
        _ => (difference(1, 0), [sum(0, 2), sum(1, 2), big]),
    };
    Some((qfac, bcd.map(|v| if a < 0.0 { -v } else { v })))
}

/// Cofactor of entry (0, i).
fn minor(r: &Matrix3, i: usize) -> f64 {
    let (p, q) = ((i + 1) % 3, (i + 2) % 3);
    r[1][p] * r[2][q] - r[1][q] * r[2][p]
}
