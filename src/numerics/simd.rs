//! Run-time choice of the vector instructions.

use pulp::Arch;
use std::sync::OnceLock;

static LEVEL: OnceLock<Arch> = OnceLock::new();

/// Runs `work` compiled for the widest vector instructions that this machine and the build have
/// (AVX2, NEON ... or plain).
///
/// The code inside must be inlined to profit. No fused multiply-add is used, so the result is the
/// same for each.
#[inline(always)]
pub(crate) fn dispatch<R>(work: impl FnOnce() -> R) -> R {
    LEVEL.get_or_init(level).dispatch(work)
}

/// What this machine has, or what every machine of its kind has where the environment says
/// `PALPATE_SIMD=scalar`: so that tests can compare the two.
fn level() -> Arch {
    match std::env::var("PALPATE_SIMD") {
        Ok(asked) if asked == "scalar" => Arch::Scalar,
        _ => Arch::new(),
    }
}

/// Sum of products of two equally long slices, in 16 interleaved partial sums (a fixed order on
/// every machine).
#[inline(always)]
pub fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0f32; 16];
    let (a16, b16) = (a.chunks_exact(16), b.chunks_exact(16));
    let mut tail = 0.0;
    for (x, y) in a16.remainder().iter().zip(b16.remainder()) {
        tail += x * y;
    }
    for (x, y) in a16.zip(b16) {
        for l in 0..16 {
            lanes[l] += x[l] * y[l];
        }
    }
    lanes.iter().sum::<f32>() + tail
}

/// Sum in 16 interleaved partial sums (a fixed order on every machine).
#[inline(always)]
pub fn sum(a: &[f32]) -> f32 {
    let mut lanes = [0.0f32; 16];
    let (blocks, rest) = a.as_chunks::<16>();
    for x in blocks {
        for l in 0..16 {
            lanes[l] += x[l];
        }
    }
    lanes.iter().sum::<f32>() + rest.iter().sum::<f32>()
}
