//! Reading volumes and displacement fields.

use super::affine::{affine, disagreement};
use super::header::{Header, MAX_HEADER_BYTES};
use crate::error::IoError;
use crate::io::format_error::Flaw;
use crate::io::image::Stored;
use crate::io::memory::fits;
use crate::io::voxels::{self, Kind, count};
use crate::io::{gzip, os, source};
use crate::types::Grid;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// The grid and the values of a scalar volume.
pub(in crate::io) fn volume(path: &Path) -> Result<(Grid, Vec<f32>), IoError> {
    load(path, scalar_layout, decode).map(|(plan, values)| (plan.grid, values))
}

/// The grid and the whole numbers of a scalar volume; none where it may have fractions.
pub(in crate::io) fn integers(path: &Path) -> Result<(Grid, Option<Vec<i64>>), IoError> {
    let whole = |plan: &Plan, bytes: &[u8]| {
        let plain = plan.scaling == (1.0, 0.0);
        if plain { voxels::integers(plan.kind, plan.big_endian, bytes) } else { None }
    };
    load(path, scalar_layout, whole).map(|(plan, values)| (plan.grid, values))
}

/// The grid and the three components of a field, one after the other, as they are stored; and who
/// wrote it how.
pub(in crate::io) fn field(path: &Path, flat: bool) -> Result<(Grid, Vec<f32>, Intent), IoError> {
    let (plan, values) = load(path, if flat { flat_field_layout } else { field_layout }, decode)?;
    if plan.scaling.0 >= 0.0 && plan.scaling.1 >= 0.0 {
        plan.kind.check_signed().map_err(|flaw| flaw.at(path))?;
    }
    Ok((plan.grid, values, plan.intent))
}

/// The grid and the samples of a field's error (planar, three components each), LPS.
pub(in crate::io) fn samples(path: &Path) -> Result<(Grid, Vec<Vec<f32>>), IoError> {
    let (plan, values) = load(path, samples_layout, decode)?;
    let n = plan.grid.len();
    let frames = values.len() / (3 * n);
    let of = |frame: usize| (0..3).flat_map(|c| &values[(c * frames + frame) * n..][..n]).copied().collect();
    Ok((plan.grid, (0..frames).map(of).collect()))
}

/// What the header says about the file, and its intent.
pub(in crate::io) fn header(path: &Path) -> Result<(Stored, i64), IoError> {
    open(path)?.stored().map_err(|flaw| flaw.at(path))
}

/// What the header says about a scalar volume; refuses what [`volume`] would by it and the file's
/// size.
pub(in crate::io) fn volume_header(path: &Path) -> Result<Stored, IoError> {
    let opened = open(path)?;
    let plan = Plan::new(&opened.head, scalar_layout).and_then(|plan| plan.end_within(opened.most()));
    plan.and_then(|_| opened.stored()).map(|(stored, _)| stored).map_err(|flaw| flaw.at(path))
}

const EXPORT: &str = "export it again";
/// NIfTI's code of a label map.
const LABEL_INTENT: i64 = 1002;

/// Who wrote a field, and what its numbers are.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::io) struct Intent {
    pub(in crate::io) code: i64,
    /// Whether `intent_name` is that of NiftyReg.
    pub(in crate::io) niftyreg: bool,
    /// Its first parameter, NiftyReg's kind of transformation.
    pub(in crate::io) kind: f64,
}

/// A scalar volume has one component.
fn scalar_layout(h: &Header, axes: [usize; 7]) -> Result<usize, Flaw> {
    if axes[4] == 3 && axes[3] == 1 {
        let what = format!("is a vector field (dim {:?}, intent {}), not a scalar volume", axes, h.intent);
        return Err(Flaw::new(what, "give an image here; fields go to --field or to `palpate warp`"));
    }
    match count(&axes[3..]) {
        1 => Ok(1),
        n => Err(Flaw::new(
            format!("is a series of {n} volumes (dim {:?}), one is needed", &axes[..h.dim[0] as usize]),
            "take one volume out of it (for example fslroi IN OUT 0 1, or nibabel's slicer)",
        )),
    }
}

/// A displacement field has three.
fn field_layout(h: &Header, axes: [usize; 7]) -> Result<usize, Flaw> {
    let hint = "give a displacement field as palpate, ANTs or ITK write it, or say whose it is with --field-convention";
    if axes[3..] != [1, 3, 1, 1] {
        let dim = &axes[..h.dim[0] as usize];
        return Err(Flaw::new(format!("is not a displacement field: dim {dim:?} instead of (x, y, z, 1, 3)"), hint));
    }
    match h.intent {
        1006 | 1007 => Ok(3),
        code => Err(Flaw::new(format!("is not a displacement field: intent {code} instead of 1007 (vector)"), hint)),
    }
}

/// Samples of a field's error have it on the fourth axis, and three components.
fn samples_layout(h: &Header, axes: [usize; 7]) -> Result<usize, Flaw> {
    match (axes[4..] == [3, 1, 1], h.intent) {
        (true, 1007) => Ok(3 * axes[3]),
        _ => Err(Flaw::new("does not hold samples of a field's error", "give posterior.nii.gz of palpate field")),
    }
}

/// FNIRT's has its components on the fourth axis.
fn flat_field_layout(h: &Header, axes: [usize; 7]) -> Result<usize, Flaw> {
    let hint = "give what `fnirt --fout` or `convertwarp` writes";
    match (axes[3..] == [3, 1, 1, 1], h.intent) {
        (true, 0 | 1006 | 1007 | 2006) => Ok(3),
        (true, 2007..=2016) => Err(Flaw::new("holds coefficients of a field, not the field", hint)),
        _ => Err(Flaw::new("is not a displacement field of FSL, (x, y, z, 3)", hint)),
    }
}

type Layout = fn(&Header, [usize; 7]) -> Result<usize, Flaw>;

/// The regular file with the voxels, to be read from its start, and the header, which stands in
/// another file of a pair.
pub(super) struct Opened {
    pub(super) file: File,
    pub(super) voxels: PathBuf,
    /// As it is stored.
    pub(super) size: u64,
    /// The first bytes of the file with the header, unpacked, at most [`MAX_HEADER_BYTES`].
    pub(super) head: Vec<u8>,
    pub(super) packed: bool,
}

impl Opened {
    /// Bytes that the file can unpack to.
    pub(super) fn most(&self) -> u64 {
        if self.packed { self.size.saturating_mul(gzip::MAX_DEFLATE_RATIO) } else { self.size }
    }

    /// What the header says about the file, and its intent.
    fn stored(&self) -> Result<(Stored, i64), Flaw> {
        let header = Header::parse(&self.head)?;
        let axes = header.axes()?;
        let format = match (header.version, header.pair, self.packed) {
            (1, false, false) => "NIfTI-1",
            (1, false, true) => "NIfTI-1, gzip",
            (1, true, false) => "NIfTI-1 pair",
            (1, true, true) => "NIfTI-1 pair, gzip",
            (_, false, false) => "NIfTI-2",
            (_, false, true) => "NIfTI-2, gzip",
            (_, true, false) => "NIfTI-2 pair",
            (_, true, true) => "NIfTI-2 pair, gzip",
        };
        let placed = match (header.sform_code, header.qform_code) {
            (1.., _) => "sform",
            (_, 1..) => "qform",
            _ => "neither sform nor qform: the voxel size alone",
        };
        let used = header.dim[0].clamp(3, 7) as usize;
        let datatype = kind(header.datatype)?.name();
        let shape = [axes[0], axes[1], axes[2]];
        let grid = Grid::new(shape, affine(&header, shape)?).map_err(|e| Flaw::new(e.to_string(), EXPORT))?;
        let apart_mm = disagreement(&header, shape);
        let axes = axes[..used].to_vec();
        let (labels, description) = (header.intent == LABEL_INTENT, header.description);
        let stored = Stored { format, datatype, axes, placed, apart_mm, grid, labels, bytes: self.size, description };
        Ok((stored, header.intent))
    }
}

/// Opens the file at `path`, and the other one of a `.hdr`/`.img` pair.
pub(super) fn open(path: &Path) -> Result<Opened, IoError> {
    let own = open_one(path)?;
    match (Header::parse(&own.head), beside(path, "img", "hdr")) {
        (Ok(header), _) if header.pair => {
            let voxels = beside(path, "hdr", "img").ok_or_else(|| {
                let what = "is the header of a .hdr/.img pair whose .img is not there";
                Flaw::new(what, "put the .img beside it, under the same name").at(path)
            })?;
            Ok(Opened { head: own.head, ..open_one(&voxels)? })
        }
        (Err(_), Some(header)) => Ok(Opened { head: open_one(&header)?.head, ..own }),
        _ => Ok(own),
    }
}

/// The other file of a pair: that at `path` with the ending `to` in place of `from`, packed or not,
/// where it is there.
pub(in crate::io) fn beside(path: &Path, from: &str, to: &str) -> Option<PathBuf> {
    let name = path.file_name()?.to_str()?;
    let lower = name.to_ascii_lowercase();
    let stem = lower.strip_suffix(".gz").unwrap_or(&lower).strip_suffix(from)?;
    let stem = name.get(..stem.len()).filter(|s| s.ends_with('.'))?;
    let names = [to, &format!("{to}.gz"), &to.to_uppercase()].map(|end| path.with_file_name(format!("{stem}{end}")));
    names.into_iter().find(|other| other.is_file())
}

fn open_one(path: &Path) -> Result<Opened, IoError> {
    let mut file = source::open(path)?;
    let size = file.metadata().map_err(os(path, "read"))?.len();
    let mut head = Vec::new();
    file.by_ref().take(MAX_HEADER_BYTES as u64).read_to_end(&mut head).map_err(os(path, "read"))?;
    let packed = gzip::is_gzip(&head);
    if packed {
        head = gzip::peek(head.chain(BufReader::new(&mut file)), MAX_HEADER_BYTES);
    }
    file.rewind().map_err(os(path, "read"))?;
    Ok(Opened { file, voxels: path.into(), size, head, packed })
}

/// The grid and what `decode` makes of the bytes of all values, component after component; `layout`
/// judges the axes and gives the number of components.
fn load<T>(path: &Path, layout: Layout, decode: impl Fn(&Plan, &[u8]) -> T) -> Result<(Plan, T), IoError> {
    let opened = open(path)?;
    let plan = Plan::new(&opened.head, layout).map_err(|flaw| flaw.at(path))?;
    let end = plan.end_within(opened.most()).map_err(|flaw| flaw.at(path))?;
    // As they are stored, and as numbers.
    fits(end as u64 + 4 * plan.bytes / plan.kind.size() as u64).map_err(|flaw| flaw.at(path))?;
    let Opened { mut file, packed, .. } = opened;
    let values = match packed {
        true => {
            let mut packed = Vec::new();
            file.read_to_end(&mut packed).map_err(os(path, "read"))?;
            let data = gzip::unpack(&packed, end).map_err(|e| gzip::damaged(&e).at(path))?;
            plan.end_within(data.len() as u64).map_err(|flaw| flaw.at(path))?;
            decode(&plan, &data[plan.start as usize..end])
        }
        false => {
            let mut data = vec![0; end - plan.start as usize];
            file.seek(SeekFrom::Start(plan.start))
                .and_then(|_| file.read_exact(&mut data))
                .map_err(os(path, "read"))?;
            decode(&plan, &data)
        }
    };
    Ok((plan, values))
}

/// What the header says about the voxels, checked.
pub(super) struct Plan {
    pub(super) grid: Grid,
    kind: Kind,
    big_endian: bool,
    scaling: (f64, f64),
    /// First byte and number of bytes.
    pub(super) start: u64,
    pub(super) bytes: u64,
    intent: Intent,
}

impl Plan {
    pub(super) fn new(head: &[u8], layout: Layout) -> Result<Self, Flaw> {
        let header = Header::parse(head)?;
        let axes = header.axes()?;
        let kind = kind(header.datatype)?;
        let components = layout(&header, axes)?;
        let shape = [axes[0], axes[1], axes[2]];
        let grid = Grid::new(shape, affine(&header, shape)?)
            .map_err(|e| Flaw::new(e.to_string(), "if that is not its true size, the header is damaged"))?;
        Ok(Self {
            grid,
            kind,
            big_endian: header.big_endian,
            scaling: header.scaling()?,
            start: header.data_offset()?,
            bytes: count(&[grid.len(), components, kind.size()]) as u64,
            intent: Intent { code: header.intent, niftyreg: header.niftyreg, kind: header.intent_p1 },
        })
    }

    /// The end of the voxels, when a file that unpacks to at most `size` bytes can hold them.
    pub(super) fn end_within(&self, size: u64) -> Result<usize, Flaw> {
        let end = self.start.saturating_add(self.bytes);
        usize::try_from(end).ok().filter(|_| end <= size).ok_or_else(|| {
            let shape = self.grid.shape();
            let what = format!("needs {end} bytes for its {shape:?} voxels but holds at most {size}");
            Flaw::new(what, "the file is cut short or its header is damaged: copy or export it again")
        })
    }
}

/// From a `NIFTI_TYPE_*` code.
fn kind(code: i16) -> Result<Kind, Flaw> {
    let name = match code {
        2 => return Ok(Kind::U8),
        4 => return Ok(Kind::I16),
        8 => return Ok(Kind::I32),
        16 => return Ok(Kind::F32),
        64 => return Ok(Kind::F64),
        256 => return Ok(Kind::I8),
        512 => return Ok(Kind::U16),
        768 => return Ok(Kind::U32),
        1024 => return Ok(Kind::I64),
        1280 => return Ok(Kind::U64),
        32 | 1792 | 2048 => "complex numbers",
        128 | 2304 => "RGB colours",
        1536 => "float128",
        _ => return Err(Flaw::new(format!("has an unknown datatype ({code})"), "export it again as float32")),
    };
    Err(Flaw::new(format!("holds {name} (datatype {code})"), "convert it to one real number a voxel, such as float32"))
}

/// The numbers of a stretch of the file.
pub(super) fn decode(plan: &Plan, bytes: &[u8]) -> Vec<f32> {
    voxels::decode(plan.kind, plan.big_endian, plan.scaling, bytes)
}
