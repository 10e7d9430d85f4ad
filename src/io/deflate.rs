//! A DEFLATE encoder for voxels (RFC 1951): Huffman coding and runs of equal 4-byte words, nothing
//! else.
//!
//! The mantissas of float32 voxels hardly ever repeat, so a general encoder spends most of its time
//! looking for matches that are not there. Without that search a field of 59 MB (160 x 192 x 160,
//! smooth with a little noise, rounded as `write_field` does) takes 0.26 s of CPU time instead of
//! libdeflate's 0.74 s at level 1, and 39 MB instead of 34.

/// Bytes that share one Huffman code.
const BYTES_PER_BLOCK: usize = 1 << 19;
/// Longest code (bits): four of them and a rest of 7 bits fit in 64 bits.
const MAX_CODE_BITS: usize = 12;
/// Literals 0 to 255, end of block 256, lengths 257 to 285.
const SYMBOLS: usize = 286;
const END_OF_BLOCK: usize = 256;
/// More than the bytes of a block's code, its end and one store past the end.
const SPARE_BYTES: usize = 256;
/// Words in the longest run: 256 bytes, as DEFLATE's longest match of 258 is not a multiple of 4.
const MAX_RUN_WORDS: usize = 64;
/// Smallest match length of symbols 257 to 284 (RFC 1951, 3.2.5).
const LENGTH_BASE: [usize; 28] =
    [3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 15, 17, 19, 23, 27, 31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195, 227];

/// Packs `data` as DEFLATE blocks that end on a whole byte and are not final, so that packed chunks
/// can be joined; [`FINISH`] ends the stream. Nothing refers to bytes before `data`.
pub(super) fn deflate(data: &[u8]) -> Vec<u8> {
    let mut out = BitWriter { bytes: Vec::new(), length: 0, held: 0, count: 0 };
    for block in data.chunks(BYTES_PER_BLOCK) {
        deflate_block(block, &mut out);
    }
    out.reserve(SPARE_BYTES);
    // An empty stored block: three zero bits, the rest of the byte, length 0 and its complement.
    out.put(0, 3);
    out.count = out.count.next_multiple_of(8);
    out.put(0xffff_0000, 32);
    out.bytes.truncate(out.length);
    out.bytes
}

/// An empty stored block with the final bit set.
pub(super) const FINISH: [u8; 5] = [1, 0, 0, 0xff, 0xff];

/// One block with its own code (RFC 1951, 3.2.7). The only distance ever used is 4.
fn deflate_block(block: &[u8], out: &mut BitWriter) {
    let mut counts = [0u32; SYMBOLS];
    counts[END_OF_BLOCK] = 1;
    scan(block, |token| match token {
        Token::Literals(bytes) => bytes.iter().for_each(|&b| counts[b as usize] += 1),
        Token::Run(words) => counts[run_symbol(words).0] += 1,
    });
    let lengths = code_lengths(&counts);
    let codes = canonical_codes(&lengths);

    out.reserve(block.len() * MAX_CODE_BITS / 8 + SPARE_BYTES);
    out.put(0b100, 3); // not final, dynamic code
    out.put(SYMBOLS as u64 - 257, 5);
    out.put(4 - 1, 5); // four distance codes
    out.put(19 - 4, 4);
    // The code of the code lengths: 0 to 15 each in 4 bits; 16, 17, 18 (first in the file's order)
    // unused.
    (0..19).for_each(|i| out.put(if i < 3 { 0 } else { 4 }, 3));
    let distances = [0, 0, 1, 1]; // distance 4 is the fourth symbol; the third makes the code complete
    for &length in lengths.iter().chain(&distances) {
        out.put(reversed(length as u16, 4), 4);
    }
    scan(block, |token| match token {
        Token::Literals(bytes) => {
            for &b in bytes {
                let (code, length) = codes[b as usize];
                out.hold(code, length);
            }
            out.flush();
        }
        Token::Run(words) => {
            let (symbol, base, extra_bits) = run_symbol(words);
            out.put(codes[symbol].0, codes[symbol].1);
            out.put((4 * words - base) as u64, extra_bits);
            out.put(1, 1); // distance 4
        }
    });
    out.put(codes[END_OF_BLOCK].0, codes[END_OF_BLOCK].1);
}

enum Token<'a> {
    /// At most four.
    Literals(&'a [u8]),
    /// Number of further words that equal the one before.
    Run(usize),
}

fn scan<'a>(block: &'a [u8], mut token: impl FnMut(Token<'a>)) {
    let (words, rest) = block.as_chunks::<4>();
    let mut i = 0;
    while i < words.len() {
        let mut run = 0;
        if i > 0 {
            let limit = MAX_RUN_WORDS.min(words.len() - i);
            run = words[i..i + limit].iter().take_while(|&&w| w == words[i - 1]).count();
        }
        if run >= 2 {
            token(Token::Run(run));
            i += run;
        } else {
            token(Token::Literals(&words[i]));
            i += 1;
        }
    }
    token(Token::Literals(rest));
}

/// Symbol, smallest length and number of extra bits for a run.
fn run_symbol(words: usize) -> (usize, usize, u32) {
    let at = LENGTH_BASE.partition_point(|&base| base <= 4 * words) - 1;
    (257 + at, LENGTH_BASE[at], if at < 8 { 0 } else { (at as u32 - 4) / 4 })
}

/// Lengths of an optimal prefix code with no length past [`MAX_CODE_BITS`] (package-merge; Larmore
/// and Hirschberg 1990, doi:10.1145/79147.79150). A symbol that does not occur gets 0; at least two
/// must occur.
fn code_lengths(counts: &[u32; SYMBOLS]) -> [u8; SYMBOLS] {
    let mut leaves: Vec<(u32, usize)> = (0..SYMBOLS).filter(|&s| counts[s] > 0).map(|s| (counts[s], s)).collect();
    leaves.sort_unstable();
    // Each row: weights in order, with the packages (pairs of the row before) marked.
    let row = |packages: &mut dyn Iterator<Item = u32>| {
        let mut row: Vec<(u32, bool)> = leaves.iter().map(|&(weight, _)| (weight, false)).collect();
        row.extend(packages.map(|weight| (weight, true)));
        row.sort_unstable();
        row
    };
    let mut rows = vec![row(&mut std::iter::empty())];
    for level in 1..MAX_CODE_BITS {
        let next = row(&mut rows[level - 1].chunks_exact(2).map(|pair| pair[0].0 + pair[1].0));
        rows.push(next);
    }
    // The first 2 n - 2 of the last row, and all that is packed in them: a symbol's length is how
    // often it occurs.
    let mut lengths = [0; SYMBOLS];
    let mut taken = 2 * leaves.len() - 2;
    for row in rows.iter().rev() {
        let packages = row[..taken].iter().filter(|&&(_, package)| package).count();
        leaves[..taken - packages].iter().for_each(|&(_, symbol)| lengths[symbol] += 1);
        taken = 2 * packages;
    }
    lengths
}

/// The code that follows from the lengths (RFC 1951, 3.2.2), with its bits in the order of the
/// stream.
fn canonical_codes(lengths: &[u8; SYMBOLS]) -> [(u64, u32); SYMBOLS] {
    let mut codes = [(0, 0); SYMBOLS];
    let mut next = 0u16;
    for length in 1..=MAX_CODE_BITS as u32 {
        next <<= 1;
        for symbol in (0..SYMBOLS).filter(|&s| u32::from(lengths[s]) == length) {
            codes[symbol] = (reversed(next, length), length);
            next += 1;
        }
    }
    codes
}

fn reversed(code: u16, bits: u32) -> u64 {
    u64::from(code.reverse_bits() >> (16 - bits))
}

/// Bits into bytes, lowest first.
struct BitWriter {
    /// Anything from `length` on.
    bytes: Vec<u8>,
    length: usize,
    held: u64,
    count: u32,
}

impl BitWriter {
    /// Makes room for `bytes` more bytes.
    fn reserve(&mut self, bytes: usize) {
        self.bytes.resize(self.length + bytes, 0);
    }

    /// Adds bits without writing any; at most 63 may be held.
    #[inline]
    fn hold(&mut self, bits: u64, count: u32) {
        self.held |= bits << self.count;
        self.count += count;
    }

    /// Writes all whole bytes; seven more bytes may be touched.
    #[inline]
    fn flush(&mut self) {
        self.bytes[self.length..self.length + 8].copy_from_slice(&self.held.to_le_bytes());
        let whole = self.count / 8;
        self.length += whole as usize;
        self.held >>= 8 * whole;
        self.count %= 8;
    }

    #[inline]
    fn put(&mut self, bits: u64, count: u32) {
        self.hold(bits, count);
        self.flush();
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;
    use std::io::Read;

    fn unpack(packed: &[u8]) -> Vec<u8> {
        let mut out = Vec::new();
        flate2::read::DeflateDecoder::new(packed).read_to_end(&mut out).unwrap();
        out
    }

    fn round_trip(chunks: &[&[u8]]) -> usize {
        let mut packed: Vec<u8> = chunks.iter().flat_map(|c| deflate(c)).collect();
        packed.extend(FINISH);
        let data = chunks.concat();
        assert!(unpack(&packed) == data, "flate2 reads something else");
        let mut out = vec![0; data.len()];
        assert_eq!(libdeflater::Decompressor::new().deflate_decompress(&packed, &mut out).unwrap(), data.len());
        assert!(out == data, "libdeflate reads something else");
        packed.len()
    }

    #[test]
    fn every_run_length_and_every_remainder_round_trip() {
        for words in 0..200 {
            for rest in 0..4 {
                let mut data = vec![1, 2, 3, 4];
                data.extend([5, 6, 7, 8].repeat(words));
                data.extend(vec![9; rest]);
                round_trip(&[&data]);
            }
        }
    }

    #[test]
    fn skewed_counts_stay_within_the_longest_code() {
        // Fibonacci counts give an unlimited Huffman code its longest words.
        let mut counts = [0; SYMBOLS];
        let (mut a, mut b) = (1u32, 1u32);
        for count in counts.iter_mut().take(30) {
            *count = a;
            (a, b) = (b, a + b);
        }
        let lengths = code_lengths(&counts);
        assert_eq!(lengths.iter().max(), Some(&(MAX_CODE_BITS as u8)));
        let kraft: f64 = lengths.iter().filter(|&&l| l > 0).map(|&l| 0.5f64.powi(i32::from(l))).sum();
        assert_eq!(kraft, 1.0);
    }

    #[test]
    fn several_blocks_and_constant_data() {
        let ramp: Vec<u8> = (0..3 * BYTES_PER_BLOCK as u32).flat_map(|i| (i / 7).to_le_bytes()).collect();
        assert!(round_trip(&[&ramp, &ramp[..1001], &[]]) < ramp.len());
        assert!(round_trip(&[&vec![0; 1 << 20]]) < 8000);
        round_trip(&[]);
    }

    proptest! {
        #[test]
        fn any_bytes_round_trip(data in proptest::collection::vec(0u8..4, 0..3000), wild: Vec<u8>) {
            round_trip(&[&data, &wild]);
        }
    }
}
