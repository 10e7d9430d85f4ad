//! The part of a NIfTI header that is used, from version 1 (parsed by the `nifti` crate) or 2.

use crate::io::format_error::Flaw;
use nifti::{Endianness, NiftiHeader};

/// Bytes of the longest header, NIfTI-2's; more than NIfTI-1's 348.
pub(super) const MAX_HEADER_BYTES: usize = 540;

/// What NiftyReg writes as `intent_name` of a transformation.
pub(super) const NIFTYREG: &[u8] = b"NREG_TRANS";

const CONVERT: &str = "convert it to a .nii.gz (for example with dcm2niix, nibabel or ITK-SNAP)";

/// Fields as they stand in the file, not yet judged (apart from the magic).
#[derive(Debug)]
pub(super) struct Header {
    pub big_endian: bool,
    pub dim: [i64; 8],
    pub datatype: i16,
    pub intent: i64,
    pub intent_p1: f64,
    /// Whether NiftyReg has put its name here.
    pub niftyreg: bool,
    pub pixdim: [f64; 8],
    /// NaN and the like have become negative.
    pub vox_offset: i64,
    pub scl_slope: f64,
    pub scl_inter: f64,
    pub xyzt_units: u8,
    pub qform_code: i64,
    pub sform_code: i64,
    /// b, c, d, then the offset x, y, z.
    pub quatern: [f64; 6],
    pub srow: [[f64; 4]; 3],
    /// 1 or 2.
    pub version: u8,
    /// Whether the voxels stand in a file of their own.
    pub pair: bool,
    /// Up to its first NUL, without characters that would disturb a terminal.
    pub description: String,
}

/// Text that ends at its first NUL, as it may be shown.
fn shown(bytes: &[u8]) -> String {
    let text = bytes.split(|b| *b == 0).next().unwrap_or_default();
    String::from_utf8_lossy(text).chars().filter(|c| !c.is_control()).collect::<String>().trim().into()
}

impl Header {
    /// From the first [`MAX_HEADER_BYTES`] bytes of the unpacked file, or all of it where it is
    /// shorter.
    pub(super) fn parse(head: &[u8]) -> Result<Self, Flaw> {
        let cut =
            || Flaw::new(format!("ends inside the header (after {} bytes)", head.len()), "copy or export it again");
        let size = head.first_chunk().ok_or_else(cut)?;
        let big_endian = i32::from_be_bytes(*size) == 348 || i32::from_be_bytes(*size) == 540;
        match if big_endian { i32::from_be_bytes(*size) } else { i32::from_le_bytes(*size) } {
            348 => Self::version_1(head.get(..348).ok_or_else(cut)?),
            540 => Self::version_2(head.get(..540).ok_or_else(cut)?, big_endian),
            _ => Err(Flaw::new("is not a NIfTI file (wrong magic)", CONVERT)),
        }
    }

    fn version_1(head: &[u8]) -> Result<Self, Flaw> {
        let pair = match &head[344..348] {
            b"n+1\0" => false,
            b"ni1\0" => true,
            [0, ..] => {
                let what = "is an ANALYZE 7.5 header, which does not say where the patient's left is";
                return Err(Flaw::new(what, CONVERT));
            }
            _ => return Err(Flaw::new("is not a NIfTI file (wrong magic)", CONVERT)),
        };
        let h = NiftiHeader::from_reader(head)
            .map_err(|e| Flaw::new(format!("the header cannot be parsed ({e})"), CONVERT))?;
        // The crate takes the byte order from dim[0]; sizeof_hdr has the last word.
        if h.sizeof_hdr != 348 {
            return Err(bad_dimensions());
        }
        Ok(Self {
            big_endian: h.endianness == Endianness::Big,
            dim: h.dim.map(|d| i64::from(d as i16)),
            datatype: h.datatype,
            intent: h.intent_code.into(),
            intent_p1: h.intent_p1.into(),
            niftyreg: h.intent_name.starts_with(NIFTYREG),
            pixdim: h.pixdim.map(f64::from),
            vox_offset: if h.vox_offset.fract() == 0.0 { h.vox_offset as i64 } else { -1 },
            scl_slope: h.scl_slope.into(),
            scl_inter: h.scl_inter.into(),
            xyzt_units: h.xyzt_units,
            qform_code: h.qform_code.into(),
            sform_code: h.sform_code.into(),
            quatern: [h.quatern_b, h.quatern_c, h.quatern_d, h.quatern_x, h.quatern_y, h.quatern_z].map(f64::from),
            srow: [h.srow_x, h.srow_y, h.srow_z].map(|row| row.map(f64::from)),
            version: 1,
            pair,
            description: shown(&head[148..228]),
        })
    }

    fn version_2(head: &[u8], big_endian: bool) -> Result<Self, Flaw> {
        let pair = match &head[4..12] {
            b"n+2\0\r\n\x1a\n" => false,
            b"ni2\0\r\n\x1a\n" => true,
            _ => return Err(Flaw::new("is not a NIfTI file (wrong magic)", CONVERT)),
        };
        let bytes = |at: usize, n: usize| {
            let mut b = [0; 8];
            b[..n].copy_from_slice(&head[at..at + n]);
            if big_endian {
                b[..n].reverse();
            }
            b
        };
        let int = |at, n| i64::from_le_bytes(bytes(at, n)) << (64 - 8 * n) >> (64 - 8 * n);
        let float = |at| f64::from_le_bytes(bytes(at, 8));
        Ok(Self {
            big_endian,
            dim: std::array::from_fn(|i| int(16 + 8 * i, 8)),
            datatype: int(12, 2) as i16,
            intent: int(504, 4),
            intent_p1: float(80),
            niftyreg: head[508..524].starts_with(NIFTYREG),
            pixdim: std::array::from_fn(|i| float(104 + 8 * i)),
            vox_offset: int(168, 8),
            scl_slope: float(176),
            scl_inter: float(184),
            xyzt_units: int(500, 4) as u8,
            qform_code: int(344, 4),
            sform_code: int(348, 4),
            quatern: std::array::from_fn(|i| float(352 + 8 * i)),
            srow: std::array::from_fn(|r| std::array::from_fn(|c| float(400 + 32 * r + 8 * c))),
            version: 2,
            pair,
            description: shown(&head[240..320]),
        })
    }

    /// Lengths of the seven axes (1 past the last one), each at least 1.
    pub(super) fn axes(&self) -> Result<[usize; 7], Flaw> {
        let count = usize::try_from(self.dim[0]).ok().filter(|n| (1..=7).contains(n)).ok_or_else(bad_dimensions)?;
        let mut axes = [1; 7];
        for i in 1..=count {
            let length = self.dim[i];
            // Some writers leave a 0 on the axes past the third.
            axes[i - 1] =
                usize::try_from(length).ok().map(|n| if i > 3 { n.max(1) } else { n }).filter(|&n| n > 0).ok_or_else(
                    || Flaw::new(format!("dim[{i}] is {length}, not a number of voxels"), "export it again"),
                )?;
        }
        Ok(axes)
    }

    /// Where the voxels begin (bytes from the start of the unpacked file that holds them).
    pub(super) fn data_offset(&self) -> Result<u64, Flaw> {
        let first = match (self.pair, self.version) {
            (true, _) => 0,
            (_, 1) => 352,
            _ => 544,
        };
        match self.vox_offset {
            0 => Ok(first as u64), // never filled in
            at if at >= first => Ok(at as u64),
            at => Err(Flaw::new(
                format!("vox_offset is {at}, inside the header or not a whole number"),
                "rewrite the file with a NIfTI library",
            )),
        }
    }

    /// Slope and intercept of `value = slope * stored + intercept`; a slope of 0 or NaN stands for
    /// none, as in nibabel.
    pub(super) fn scaling(&self) -> Result<(f64, f64), Flaw> {
        if self.scl_slope == 0.0 || !self.scl_slope.is_finite() {
            Ok((1.0, 0.0))
        } else if self.scl_inter.is_finite() {
            Ok((self.scl_slope, self.scl_inter))
        } else {
            Err(Flaw::new(
                format!("scl_slope is {} but scl_inter is {}", self.scl_slope, self.scl_inter),
                "set scl_inter in the header (0 for none)",
            ))
        }
    }
}

fn bad_dimensions() -> Flaw {
    Flaw::new("dim[0], the number of axes, is not 1 to 7", "the header is damaged: copy or export the file again")
}
