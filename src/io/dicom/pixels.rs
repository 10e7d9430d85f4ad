//! The numbers of the frames of a DICOM file, unpacked (PS3.5 section 8 and annex A).

use super::data_elements::{Elements, Form, Tag};
use crate::io::format_error::Flaw;
use crate::io::voxels::{Kind, decode};
use std::borrow::Cow;
use std::io::Read;

const SYNTAX: Tag = (0x0002, 0x0010);
const SAMPLES: Tag = (0x0028, 0x0002);
const FRAMES: Tag = (0x0028, 0x0008);
const ROWS: Tag = (0x0028, 0x0010);
const COLUMNS: Tag = (0x0028, 0x0011);
const BITS: Tag = (0x0028, 0x0100);
const BITS_STORED: Tag = (0x0028, 0x0101);
const HIGH_BIT: Tag = (0x0028, 0x0102);
const SIGNED: Tag = (0x0028, 0x0103);
const PIXELS: Tag = (0x7fe0, 0x0010);

pub(super) const CONVERT: &str = "convert it with dcm2niix";
const UNPACK: &str = "unpack it with `gdcmconv --raw IN OUT`, or convert it with dcm2niix";
/// What no file unpacks to more than (bytes).
const MAX_UNPACKED_BYTES: u64 = 1 << 30;
/// A byte of a JPEG stream stands for at most this number of pixels: two bits for a block of 8 x 8.
const JPEG_RATIO: usize = 256;
/// Two bytes of RLE stand for at most 128.
const RLE_RATIO: usize = 64;

/// How the numbers are packed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Packing {
    None,
    Rle,
    Jpeg,
}

impl Packing {
    /// What packed bytes stand for at most (bytes), of numbers of `size` bytes.
    fn most(self, packed: usize, size: usize) -> usize {
        let ratio = match self {
            Self::None => 1,
            Self::Rle => RLE_RATIO,
            Self::Jpeg => JPEG_RATIO * size,
        };
        packed.saturating_mul(ratio)
    }
}

fn cut(of: &str, needed: usize, holds: usize) -> Flaw {
    let what = format!("needs {needed} bytes for the voxels of {of} but holds {holds}");
    Flaw::new(what, "the file is cut short: copy or export it again")
}

/// Transfer syntaxes that are not read (PS3.6, table A-1).
const NOT_READ: [(&str, &str); 14] = [
    ("1.2.840.10008.1.2.4.51", "JPEG extended, 12 bits"),
    ("1.2.840.10008.1.2.4.80", "JPEG-LS lossless"),
    ("1.2.840.10008.1.2.4.81", "JPEG-LS near-lossless"),
    ("1.2.840.10008.1.2.4.90", "JPEG 2000 lossless"),
    ("1.2.840.10008.1.2.4.91", "JPEG 2000"),
    ("1.2.840.10008.1.2.4.92", "JPEG 2000 multi-component lossless"),
    ("1.2.840.10008.1.2.4.93", "JPEG 2000 multi-component"),
    ("1.2.840.10008.1.2.4.110", "JPEG XL lossless"),
    ("1.2.840.10008.1.2.4.111", "JPEG XL from JPEG"),
    ("1.2.840.10008.1.2.4.112", "JPEG XL"),
    ("1.2.840.10008.1.2.4.201", "high-throughput JPEG 2000 lossless"),
    ("1.2.840.10008.1.2.4.202", "high-throughput JPEG 2000 lossless"),
    ("1.2.840.10008.1.2.4.203", "high-throughput JPEG 2000"),
    ("1.2.840.113619.5.2", "GE's own, with big-endian numbers"),
];

/// A file whose elements can be walked.
pub(super) struct Source<'a> {
    bytes: Cow<'a, [u8]>,
    start: usize,
    form: Form,
    packing: Packing,
}

impl<'a> Source<'a> {
    /// Of a whole file; a deflated one is unpacked.
    pub(super) fn of(file: &'a [u8]) -> Result<Self, Flaw> {
        let damaged = || Flaw::new("is damaged or cut short", "copy or export it again");
        let (about, start) = Elements::about(file).ok_or_else(damaged)?;
        let uid = about.get(SYNTAX).map(text).unwrap_or_default();
        let plain = Self { bytes: Cow::Borrowed(file), start, form: Form::EXPLICIT, packing: Packing::None };
        Ok(match uid.as_str() {
            "1.2.840.10008.1.2" => Self { form: Form { explicit: false, big_endian: false }, ..plain },
            "1.2.840.10008.1.2.1" => plain,
            "1.2.840.10008.1.2.2" => Self { form: Form { explicit: true, big_endian: true }, ..plain },
            "1.2.840.10008.1.2.1.99" => {
                let mut bytes = Vec::new();
                let packed =
                    flate2::read::DeflateDecoder::new(&file[start..]).take(MAX_UNPACKED_BYTES).read_to_end(&mut bytes);
                packed.map_err(|_| damaged())?;
                Self { bytes: Cow::Owned(bytes), start: 0, ..plain }
            }
            "1.2.840.10008.1.2.5" => Self { packing: Packing::Rle, ..plain },
            "1.2.840.10008.1.2.4.50" | "1.2.840.10008.1.2.4.57" | "1.2.840.10008.1.2.4.70" => {
                Self { packing: Packing::Jpeg, ..plain }
            }
            "" => return Err(Flaw::new("does not say its transfer syntax", UNPACK)),
            other => {
                let known = NOT_READ.iter().find(|(uid, _)| *uid == other);
                let name = known.map_or("another one", |(_, name)| name);
                let shown: String = other.chars().take(64).collect();
                return Err(Flaw::new(
                    format!("is in the transfer syntax {shown} ({name}), which is not read"),
                    UNPACK,
                ));
            }
        })
    }

    /// Its elements.
    pub(super) fn elements(&self) -> Result<Elements<'_>, Flaw> {
        Elements::of(&self.bytes, self.start..self.bytes.len(), self.form)
            .ok_or_else(|| Flaw::new("is damaged or cut short", "copy or export it again"))
    }

    /// The numbers of each frame, as bytes in the order of [`Pixels::values`].
    pub(super) fn frames(&self, elements: &Elements<'_>, pixels: &Pixels) -> Result<Vec<Vec<u8>>, Flaw> {
        let [columns, rows] = pixels.shape;
        let needed = columns * rows * pixels.kind.size();
        let cut = |holds: usize| cut("a frame", needed, holds);
        if self.packing == Packing::None {
            let all = elements.get(PIXELS).unwrap_or_default();
            let frame = |k: usize| all.get(k * needed..(k + 1) * needed).map(<[u8]>::to_vec);
            return (0..pixels.frames).map(|k| frame(k).ok_or_else(|| cut(all.len() / pixels.frames))).collect();
        }
        let pieces: Vec<&[u8]> = elements.pieces(PIXELS).collect();
        joined(&pieces, pixels.frames, self.form)?
            .iter()
            .map(|piece| {
                let most = self.packing.most(piece.len(), pixels.kind.size());
                if needed > most {
                    return Err(cut(most));
                }
                match self.packing {
                    Packing::Rle => rle(piece, columns * rows, pixels.kind.size()),
                    _ => jpeg(piece, pixels),
                }
            })
            .collect()
    }
}

/// The packed frames: one piece each, or as many as the table before them says (PS3.5, A.4).
fn joined<'a>(pieces: &[&'a [u8]], frames: usize, form: Form) -> Result<Vec<Cow<'a, [u8]>>, Flaw> {
    let [table, pieces @ ..] = pieces else {
        return Err(Flaw::new("holds no packed image", CONVERT));
    };
    if pieces.len() == frames {
        return Ok(pieces.iter().map(|piece| Cow::Borrowed(*piece)).collect());
    }
    let starts: Vec<usize> = table.chunks_exact(4).filter_map(|b| form.long(b)).collect();
    let mut out: Vec<Vec<u8>> = Vec::new();
    let mut at = 0;
    for piece in pieces {
        if at == 0 || (frames > 1 && starts.contains(&at)) {
            out.push(Vec::new());
        }
        out.last_mut().into_iter().for_each(|frame| frame.extend_from_slice(piece));
        at += 8 + piece.len();
    }
    match out.len() == frames {
        true => Ok(out.into_iter().map(Cow::Owned).collect()),
        false => Err(Flaw::new(
            format!("does not say which of its {} pieces make its {frames} frames", pieces.len()),
            UNPACK,
        )),
    }
}

/// Unpacks a frame (PS3.5, annex G): a segment for each byte of a number, the highest first.
fn rle(frame: &[u8], count: usize, size: usize) -> Result<Vec<u8>, Flaw> {
    let damaged = || Flaw::new("its RLE stream is damaged or cut short", "copy or export it again");
    let number = |at: usize| frame.get(4 * at..).and_then(|b| Some(u32::from_le_bytes(*b.first_chunk()?) as usize));
    if number(0) != Some(size) {
        return Err(damaged());
    }
    let mut out = vec![0; count * size];
    for segment in 0..size {
        let start = number(1 + segment).ok_or_else(damaged)?;
        let mut rest = frame.get(start..).ok_or_else(damaged)?.iter().copied();
        let mut places = out.iter_mut().skip(size - 1 - segment).step_by(size);
        let mut left = count;
        while left > 0 {
            let head = rest.next().ok_or_else(damaged)?;
            match head {
                0..=127 => {
                    let n = left.min(usize::from(head) + 1);
                    for _ in 0..n {
                        *places.next().ok_or_else(damaged)? = rest.next().ok_or_else(damaged)?;
                    }
                    left -= n;
                }
                128 => {}
                129.. => {
                    let (n, byte) = (left.min(257 - usize::from(head)), rest.next().ok_or_else(damaged)?);
                    places.by_ref().take(n).for_each(|place| *place = byte);
                    left -= n;
                }
            }
        }
    }
    Ok(out)
}

/// Unpacks a frame of JPEG: eight bits, or lossless.
fn jpeg(frame: &[u8], pixels: &Pixels) -> Result<Vec<u8>, Flaw> {
    let flaw = |what: String| Flaw::new(format!("its JPEG stream {what}"), UNPACK);
    let mut decoder = jpeg_decoder::Decoder::new(frame);
    decoder.read_info().map_err(|e| flaw(format!("is damaged, or of a kind that is not read ({e})")))?;
    let info = decoder.info().ok_or_else(|| flaw("says nothing about its size".into()))?;
    let bytes = match info.pixel_format {
        jpeg_decoder::PixelFormat::L8 => 1,
        jpeg_decoder::PixelFormat::L16 => 2,
        _ => return Err(flaw("holds colours".into())),
    };
    if [info.width, info.height].map(usize::from) != pixels.shape || bytes != pixels.kind.size() {
        let (w, h) = (info.width, info.height);
        return Err(flaw(format!("holds {w} x {h} numbers of {} bits, not what the file says", 8 * bytes)));
    }
    let mut numbers = decoder.decode().map_err(|e| flaw(format!("is damaged, or of a kind that is not read ({e})")))?;
    // They come in the machine's order.
    if bytes == 2 && cfg!(target_endian = "big") {
        numbers.as_chunks_mut().0.iter_mut().for_each(|b: &mut [u8; 2]| b.reverse());
    }
    Ok(numbers)
}

/// How the numbers of a file are stored.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Pixels {
    /// Columns and rows.
    pub(super) shape: [usize; 2],
    pub(super) kind: Kind,
    /// Highest bits of a number that are none of it (PS3.5, 8.1.1): whatever stands there.
    unused: usize,
    pub(super) frames: usize,
    /// What the packed numbers stand for at most (bytes).
    most: usize,
    big_endian: bool,
}

impl Pixels {
    /// None where the file holds no image.
    pub(super) fn of(elements: &Elements<'_>, source: &Source<'_>) -> Result<Option<Self>, Flaw> {
        let Some(stored) = elements.get(PIXELS) else { return Ok(None) };
        let count = |tag| elements.get(tag).and_then(|v| elements.form.short(v)).map(usize::from);
        if count(SAMPLES).unwrap_or(1) != 1 {
            return Err(Flaw::new("holds colours", CONVERT));
        }
        let side = |tag, name: &str| {
            count(tag).filter(|n| *n > 0).ok_or_else(|| Flaw::new(format!("has no {name}, or an odd one"), CONVERT))
        };
        let kind = match (count(BITS), count(SIGNED).unwrap_or(0) == 1) {
            (Some(8), false) => Kind::U8,
            (Some(8), true) => Kind::I8,
            (Some(16), false) => Kind::U16,
            (Some(16), true) => Kind::I16,
            (bits, _) => return Err(Flaw::new(format!("holds {} bits a voxel", bits.unwrap_or(0)), CONVERT)),
        };
        let bits = 8 * kind.size();
        let used = count(BITS_STORED).unwrap_or(bits);
        if !(1..=bits).contains(&used) || count(HIGH_BIT).unwrap_or(used - 1) != used - 1 {
            return Err(Flaw::new(format!("holds {used} bits in {bits} that are not the lowest ones"), CONVERT));
        }
        let frames = match elements.get(FRAMES).map(text) {
            None => 1,
            Some(n) => n
                .parse()
                .ok()
                .filter(|&n| n > 0 && n <= stored.len().max(1))
                .ok_or_else(|| Flaw::new(format!("says that it has {n} frames"), CONVERT))?,
        };
        let shape = [side(COLUMNS, "Columns")?, side(ROWS, "Rows")?];
        let packed = match source.packing {
            Packing::None => stored.len(),
            _ => elements.pieces(PIXELS).map(<[u8]>::len).sum(),
        };
        let most = source.packing.most(packed, kind.size());
        // Packed numbers have an order of their own.
        let big_endian = source.packing == Packing::None && source.form.big_endian;
        Ok(Some(Self { shape, kind, unused: bits - used, frames, most, big_endian }))
    }

    /// Refuses frames that are larger than what the file holds, before memory is taken for them.
    pub(super) fn held(&self) -> Result<(), Flaw> {
        let needed = (self.shape[0] * self.shape[1] * self.kind.size()).saturating_mul(self.frames);
        match self.most {
            0 => Err(Flaw::new("holds neither numbers nor a packed image", CONVERT)),
            most if needed > most => Err(cut("its frames", needed, most)),
            _ => Ok(()),
        }
    }

    /// The numbers of a frame.
    pub(super) fn values(&self, frame: &[u8], scaling: (f64, f64)) -> Vec<f32> {
        let mut numbers = frame.to_vec();
        if self.big_endian && self.kind.size() == 2 {
            numbers.as_chunks_mut().0.iter_mut().for_each(|b: &mut [u8; 2]| b.reverse());
        }
        let unused = self.unused;
        match self.kind {
            _ if unused == 0 => {}
            Kind::U8 => numbers.iter_mut().for_each(|b| *b = *b << unused >> unused),
            Kind::I8 => numbers.iter_mut().for_each(|b| *b = (b.cast_signed() << unused >> unused).cast_unsigned()),
            Kind::U16 => words(&mut numbers, |w| w << unused >> unused),
            _ => words(&mut numbers, |w| (w.cast_signed() << unused >> unused).cast_unsigned()),
        }
        decode(self.kind, false, scaling, &numbers)
    }
}

/// Changes every 16-bit number.
fn words(bytes: &mut [u8], change: impl Fn(u16) -> u16) {
    bytes.as_chunks_mut().0.iter_mut().for_each(|b| *b = change(u16::from_le_bytes(*b)).to_le_bytes());
}

/// A value as text, without what fills it up.
pub(super) fn text(value: &[u8]) -> String {
    String::from_utf8_lossy(value).trim_matches([' ', '\0']).to_string()
}
