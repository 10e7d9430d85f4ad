//! gzip (RFC 1952): one member written by all threads, any number of members read.
//!
//! What is written does not depend on the number of threads: the data is cut at fixed places and the packed chunks
//! are joined in order into a single member, which even readers that stop after the first member accept.

use super::deflate::{FINISH, deflate};
use flate2::Crc;
use flate2::bufread::GzDecoder;
use std::io::{self, BufRead, Read, Seek, SeekFrom, Write};
use std::ops::Range;

/// No DEFLATE stream unpacks to more than this many times its size.
pub(super) const LARGEST_RATIO: u64 = 1032;
/// Bytes after the voxels that are still read, to check the checksum behind them.
const SLACK: usize = 1 << 20;

/// Whether the bytes start as gzip does.
pub(super) fn is_gzip(bytes: &[u8]) -> bool {
    bytes.starts_with(&[0x1f, 0x8b])
}

/// A packed part of a member.
pub(super) struct Chunk {
    packed: Vec<u8>,
    crc: Crc,
}

impl Chunk {
    pub(super) fn new(bytes: &[u8]) -> Self {
        let mut crc = Crc::new();
        crc.update(bytes);
        Self { packed: deflate(bytes), crc }
    }
}

/// One member in the making: unpacks to the bytes of all its chunks, one after the other.
pub(super) struct Member<'a, W> {
    out: &'a mut W,
    crc: Crc,
    /// Bytes written so far.
    written: u64,
}

/// Where a run of chunks stands in a file, to be put into another member as it is.
#[derive(Debug)]
pub(super) struct Run {
    pub(super) bytes: Range<u64>,
    crc: Crc,
}

impl<'a, W: Write> Member<'a, W> {
    pub(super) fn start(out: &'a mut W) -> io::Result<Self> {
        const START: [u8; 10] = [0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 4, 255]; // no name, no time, fastest, unknown system
        out.write_all(&START)?;
        Ok(Self { out, crc: Crc::new(), written: START.len() as u64 })
    }

    pub(super) fn add(&mut self, chunk: &Chunk) -> io::Result<()> {
        self.crc.combine(&chunk.crc);
        self.written += chunk.packed.len() as u64;
        self.out.write_all(&chunk.packed)
    }

    /// An empty run of the chunks that are added next.
    pub(super) fn run(&self) -> Run {
        Run { bytes: self.written..self.written, crc: Crc::new() }
    }

    /// Adds a chunk that belongs to `run`.
    pub(super) fn add_to(&mut self, run: &mut Run, chunk: &Chunk) -> io::Result<()> {
        self.add(chunk)?;
        run.crc.combine(&chunk.crc);
        run.bytes.end = self.written;
        Ok(())
    }

    /// Adds a run of chunks as it stands in the file `from`.
    pub(super) fn copy(&mut self, from: &mut (impl Read + Seek), run: &Run) -> io::Result<()> {
        from.seek(SeekFrom::Start(run.bytes.start))?;
        let length = run.bytes.end - run.bytes.start;
        if io::copy(&mut from.take(length), self.out)? != length {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        self.crc.combine(&run.crc);
        self.written += length;
        Ok(())
    }

    pub(super) fn finish(self) -> io::Result<()> {
        self.out.write_all(&FINISH)?;
        self.out.write_all(&self.crc.sum().to_le_bytes())?;
        self.out.write_all(&self.crc.amount().to_le_bytes())
    }
}

/// The first `length` bytes, or fewer when there are no more or the stream is damaged.
pub(super) fn peek(packed: impl BufRead, length: usize) -> Vec<u8> {
    let mut head = Vec::new();
    // A damaged stream is reported by `unpack`; what came before the damage may already say what the file is.
    let _ = flate2::bufread::MultiGzDecoder::new(packed).take(length as u64).read_to_end(&mut head);
    head
}

/// Unpacks at least `needed` bytes where there are so many, and checks the checksums on the way; what follows the
/// last member (padding) is ignored. Never holds more than `needed` and 1 MiB.
pub(super) fn unpack(packed: &[u8], needed: usize) -> io::Result<Vec<u8>> {
    if let Some(data) = unpack_single(packed, needed) {
        return Ok(data);
    }
    let mut data = Vec::new();
    let mut rest = packed;
    while data.len() < needed && is_gzip(rest) {
        let mut member = GzDecoder::new(rest);
        member.by_ref().take((needed - data.len()) as u64).read_to_end(&mut data)?;
        io::copy(&mut member.by_ref().take(SLACK as u64), &mut io::sink())?;
        rest = member.into_inner();
    }
    Ok(data)
}

/// The fast path: one member that ends the file, whose last four bytes say how long it is.
fn unpack_single(packed: &[u8], needed: usize) -> Option<Vec<u8>> {
    let size = u32::from_le_bytes(*packed.last_chunk()?) as usize;
    if !(needed..=needed + SLACK).contains(&size) {
        return None;
    }
    Vec::<u8>::new().try_reserve_exact(size).ok()?;
    let mut data = vec![0; size]; // pages that are never written cost nothing
    let found = libdeflater::Decompressor::new().gzip_decompress(packed, &mut data).ok()?;
    data.truncate(found);
    (found >= needed).then_some(data)
}
