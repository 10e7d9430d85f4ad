//! How voxels are stored, in any format.

use super::format_error::Flaw;
use rayon::prelude::*;

/// The type of a stored number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F32,
    F64,
}

/// Product of the lengths of axes, `usize::MAX` where it is more: what no file can hold.
pub(super) fn count(axes: &[usize]) -> usize {
    axes.iter().fold(1, |n: usize, &length| n.saturating_mul(length))
}

impl Kind {
    /// Bytes of one number.
    pub(super) fn size(self) -> usize {
        match self {
            Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::I64 | Self::F64 => 8,
        }
    }

    /// Refuses numbers without a sign where vectors are wanted.
    pub(super) fn check_signed(self) -> Result<(), Flaw> {
        match self {
            Self::U8 | Self::U16 | Self::U32 | Self::U64 => {
                let what =
                    format!("holds three {} numbers a voxel, which have no sign: colours, not vectors", self.name());
                Err(Flaw::new(what, "give a displacement field"))
            }
            _ => Ok(()),
        }
    }

    /// As `int16`.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::U8 => "uint8",
            Self::I8 => "int8",
            Self::U16 => "uint16",
            Self::I16 => "int16",
            Self::U32 => "uint32",
            Self::I32 => "int32",
            Self::U64 => "uint64",
            Self::I64 => "int64",
            Self::F32 => "float32",
            Self::F64 => "float64",
        }
    }
}

/// The numbers in `bytes`, each as slope times it plus intercept.
pub(super) fn decode(kind: Kind, big_endian: bool, scaling: (f64, f64), bytes: &[u8]) -> Vec<f32> {
    macro_rules! decode_as {
        ($t:ty) => {
            if big_endian {
                convert(bytes, scaling, |b| <$t>::from_be_bytes(b) as f64)
            } else {
                convert(bytes, scaling, |b| <$t>::from_le_bytes(b) as f64)
            }
        };
    }
    match kind {
        Kind::U8 => decode_as!(u8),
        Kind::I8 => decode_as!(i8),
        Kind::U16 => decode_as!(u16),
        Kind::I16 => decode_as!(i16),
        Kind::U32 => decode_as!(u32),
        Kind::I32 => decode_as!(i32),
        Kind::U64 => decode_as!(u64),
        Kind::I64 => decode_as!(i64),
        Kind::F32 => decode_as!(f32),
        Kind::F64 => decode_as!(f64),
    }
}

/// The whole numbers in `bytes` as they are stored; none of a type that has fractions, or where one
/// is past 2^63.
pub(super) fn integers(kind: Kind, big_endian: bool, bytes: &[u8]) -> Option<Vec<i64>> {
    macro_rules! integers_as {
        ($t:ty) => {{
            let whole = |b: &[u8; size_of::<$t>()]| {
                let stored = if big_endian { <$t>::from_be_bytes(*b) } else { <$t>::from_le_bytes(*b) };
                i64::try_from(stored).ok()
            };
            bytes.as_chunks().0.par_iter().with_min_len(1 << 16).map(whole).collect()
        }};
    }
    match kind {
        Kind::U8 => integers_as!(u8),
        Kind::I8 => integers_as!(i8),
        Kind::U16 => integers_as!(u16),
        Kind::I16 => integers_as!(i16),
        Kind::U32 => integers_as!(u32),
        Kind::I32 => integers_as!(i32),
        Kind::U64 => integers_as!(u64),
        Kind::I64 => integers_as!(i64),
        Kind::F32 | Kind::F64 => None,
    }
}

fn convert<const N: usize>(
    bytes: &[u8],
    (slope, intercept): (f64, f64),
    stored: impl Fn([u8; N]) -> f64 + Sync,
) -> Vec<f32> {
    let voxels = bytes.as_chunks::<N>().0;
    voxels.par_iter().with_min_len(1 << 16).map(|&b| (slope * stored(b) + intercept) as f32).collect()
}
