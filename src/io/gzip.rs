//! gzip (RFC 1952): one member written by all threads, any number of members read.
//!
//! What is written does not depend on the number of threads: the data is cut at fixed places and
//! the packed chunks are joined in order into a single member, which even readers that stop after
//! the first member accept.

use super::deflate::{FINISH, deflate};
use super::format_error::Flaw;
use flate2::Crc;
use flate2::bufread::GzDecoder;
use std::io::{self, BufRead, Read, Seek, SeekFrom, Write};
use std::ops::Range;

/// No DEFLATE stream unpacks to more than this many times its size.
pub(super) const MAX_DEFLATE_RATIO: u64 = 1032;
/// Bytes after the voxels that are still read, to check the checksum behind them.
const MAX_TRAILING_BYTES: u64 = 1 << 20;
/// How every member begins.
const MAGIC: [u8; 2] = [0x1f, 0x8b];

/// Whether the bytes start as gzip does.
pub(super) fn is_gzip(bytes: &[u8]) -> bool {
    bytes.starts_with(&MAGIC)
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
    // A damaged stream is reported by `unpack`; what came before the damage may already say what
    // the file is.
    let _ = flate2::bufread::MultiGzDecoder::new(packed).take(length as u64).read_to_end(&mut head);
    head
}

/// Unpacks at least `needed` bytes where there are that many, and checks the checksums on the way;
/// what follows the last member (padding) is ignored. Never holds more than `needed` and 1 MiB.
pub(super) fn unpack(packed: &[u8], needed: usize) -> io::Result<Vec<u8>> {
    if let Some(data) = unpack_single(packed, needed) {
        return Ok(data);
    }
    let (mut data, mut members) = (Vec::new(), Members::new(packed));
    members.by_ref().take(needed as u64).read_to_end(&mut data)?;
    check_end(&mut members)?;
    Ok(data)
}

/// Reads on behind the voxels so that the checksum there is checked; the bytes that were skipped.
pub(super) fn check_end(unpacked: &mut impl Read) -> io::Result<u64> {
    io::copy(&mut unpacked.take(MAX_TRAILING_BYTES), &mut io::sink())
}

/// What is wrong with a file that does not unpack.
pub(super) fn damaged(e: &io::Error) -> Flaw {
    Flaw::new(format!("its gzip stream is damaged or cut short ({e})"), "copy or export it again")
}

/// Unpacks members one after the other and checks the checksum of each; ends where no further
/// member starts (padding).
pub(super) struct Members<R>(Option<GzDecoder<R>>);

impl<R: BufRead> Members<R> {
    pub(super) fn new(packed: R) -> Self {
        Self(Some(GzDecoder::new(packed)))
    }
}

impl<R: BufRead> Read for Members<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        while let Some(mut member) = self.0.take() {
            let count = member.read(buffer);
            if !matches!(count, Ok(0)) || buffer.is_empty() {
                self.0 = Some(member);
                return count;
            }
            let mut rest = member.into_inner();
            // One byte is all that a buffer is sure to hold.
            self.0 = rest.fill_buf()?.starts_with(&MAGIC[..1]).then(|| GzDecoder::new(rest));
        }
        Ok(0)
    }
}

/// The fast path: one member that ends the file, whose last four bytes say how long it is.
fn unpack_single(packed: &[u8], needed: usize) -> Option<Vec<u8>> {
    let size = u32::from_le_bytes(*packed.last_chunk()?) as usize;
    if !(needed..=needed + MAX_TRAILING_BYTES as usize).contains(&size) {
        return None;
    }
    Vec::<u8>::new().try_reserve_exact(size).ok()?;
    let mut data = vec![0; size]; // pages that are never written cost nothing
    let found = libdeflater::Decompressor::new().gzip_decompress(packed, &mut data).ok()?;
    data.truncate(found);
    (found >= needed).then_some(data)
}
