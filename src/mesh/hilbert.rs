//! Insertion order: biased random rounds, each along a Hilbert curve.
//!
//! Sources: N. Amenta, S. Choi, G. Rote, "Incremental constructions con BRIO", SoCG 2003; J.
//! Skilling, "Programming the Hilbert curve", AIP Conf. Proc. 707 (2004).

/// Bits of the curve along each axis.
const BITS_PER_AXIS: u32 = 16;

/// The order in which to insert the points: a permutation of their numbers, the same every time.
///
/// Each point is in the last round with probability 7/8, in the one before with 7/64 and so on;
/// within a round the points follow the curve, so that each lies near the one before.
pub(super) fn insertion_order(points: &[[f64; 3]]) -> Vec<u32> {
    let mut low = [f64::INFINITY; 3];
    let mut high = [f64::NEG_INFINITY; 3];
    for p in points {
        for a in 0..3 {
            low[a] = low[a].min(p[a]);
            high[a] = high[a].max(p[a]);
        }
    }
    let extent = (0..3).map(|a| high[a] - low[a]).fold(f64::MIN_POSITIVE, f64::max);
    let scale = f64::from((1 << BITS_PER_AXIS) - 1) / extent;
    let key = |i: usize, p: &[f64; 3]| {
        let cell = std::array::from_fn(|a| ((p[a] - low[a]) * scale) as u32);
        (15 - u64::from(round(i as u64))) << (3 * BITS_PER_AXIS) | hilbert_index(cell)
    };
    let mut keyed: Vec<(u64, u32)> = points.iter().enumerate().map(|(i, p)| (key(i, p), i as u32)).collect();
    keyed.sort_unstable();
    keyed.into_iter().map(|(_, i)| i).collect()
}

/// How many rounds before the last point `i` is inserted, 0 to 15 (the finaliser of SplitMix64 as
/// chance).
fn round(i: u64) -> u32 {
    let mut h = i.wrapping_add(0x9e37_79b9_7f4a_7c15);
    h = (h ^ (h >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    h = (h ^ (h >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((h ^ (h >> 31)).trailing_zeros() / 3).min(15)
}

/// Position of a cell of the 2^16-cube along the Hilbert curve (Skilling's `AxestoTranspose`, then
/// interleaved).
fn hilbert_index(mut x: [u32; 3]) -> u64 {
    for bit in (1..BITS_PER_AXIS).rev() {
        let (q, mask) = (1 << bit, (1 << bit) - 1);
        for a in 0..3 {
            // Invert the low bits of x[0], or exchange them with those of x[a].
            let set = if x[a] & q != 0 { u32::MAX } else { 0 };
            let t = (x[0] ^ x[a]) & mask & !set;
            x[0] ^= t | (mask & set);
            x[a] ^= t;
        }
    }
    x[1] ^= x[0];
    x[2] ^= x[1];
    // The exclusive or of all higher bits of x[2], at each bit.
    let mut parity = x[2] >> 1;
    for shift in [1, 2, 4, 8, 16] {
        parity ^= parity >> shift;
    }
    let [a, b, c] = x.map(|v| spread(u64::from(v ^ parity)));
    a << 2 | b << 1 | c
}

/// Bit `i` of the low 21 moved to bit `3 i`.
fn spread(mut v: u64) -> u64 {
    v = (v | v << 32) & 0x001f_0000_0000_ffff;
    v = (v | v << 16) & 0x001f_0000_ff00_00ff;
    v = (v | v << 8) & 0x100f_00f0_0f00_f00f;
    v = (v | v << 4) & 0x10c3_0c30_c30c_30c3;
    (v | v << 2) & 0x1249_2492_4924_9249
}

#[cfg(test)]
mod tests {
    use super::hilbert_index;

    /// Cells that follow each other on the curve share a face, and the curve visits each once.
    #[test]
    fn the_curve_is_continuous() {
        let side = 8;
        let mut cells: Vec<(u64, [i32; 3])> = (0..side * side * side)
            .map(|n| [n % side, n / side % side, n / (side * side)])
            .map(|c| (hilbert_index(c), c.map(|v| v as i32)))
            .collect();
        cells.sort_unstable();
        for (at, pair) in cells.windows(2).enumerate() {
            let steps: i32 = (0..3).map(|a| (pair[0].1[a] - pair[1].1[a]).abs()).sum();
            assert_eq!((steps, pair[0].0), (1, at as u64));
        }
    }
}
