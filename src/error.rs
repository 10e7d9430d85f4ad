//! One small error enum an operation. Each message says what is wrong and, where it is known,
//! what to try.
//!
//! Errors about a file carry its path (added in `io`); the command line joins context with
//! `anyhow`.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use thiserror::Error;

/// Text on one line, without what would steer a terminal: control characters, and those that turn
/// the direction of writing, are escaped as in JSON.
pub fn plain(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '\n' => out.push_str("\\n"),
            '\r' => out.push_str("\\r"),
            '\t' => out.push_str("\\t"),
            '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}' => escape(&mut out, c),
            c if c.is_control() => escape(&mut out, c),
            c => out.push(c),
        }
    }
    out
}

fn escape(out: &mut String, c: char) {
    out.push_str(&format!("\\u{:04x}", u32::from(c)));
}

/// How a name that someone else gave is shown.
pub(crate) trait Shown {
    /// As [`plain`] text.
    fn shown(&self) -> String;
}

impl Shown for OsStr {
    fn shown(&self) -> String {
        plain(&self.to_string_lossy())
    }
}

impl Shown for Path {
    fn shown(&self) -> String {
        self.as_os_str().shown()
    }
}

/// Geometry: affines, grids, lengths.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum SpaceError {
    /// NaN or infinity in an affine.
    #[error("the voxel-to-world affine holds a value that is not finite")]
    NotFinite,
    /// The affine cannot be inverted.
    #[error("the voxel-to-world affine is singular (determinant {determinant:.3e}); set a valid sform or qform")]
    Singular {
        /// Its determinant (mm^3).
        determinant: f64,
    },
    /// A side of zero voxels.
    #[error("the grid {shape:?} has no voxels")]
    Empty {
        /// Voxels along each axis.
        shape: [usize; 3],
    },
    /// More voxels than can be handled.
    #[error("the grid {shape:?} has more than 2^31 voxels; crop or resample it first")]
    TooLarge {
        /// Voxels along each axis.
        shape: [usize; 3],
    },
    /// An affine map of world points that cannot be used.
    #[error("the affine transform {what}")]
    Transform {
        /// What is wrong.
        what: String,
    },
    /// As many values as the grid has voxels were expected.
    #[error("{found} values for a grid of {expected}")]
    Length {
        /// What the grid needs.
        expected: usize,
        /// What was given.
        found: usize,
    },
}

/// Meshing: Delaunay in 2D and 3D.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum MeshError {
    /// NaN or infinity in a coordinate.
    #[error("node {node} has a coordinate that is not finite")]
    NotFinite {
        /// Its number.
        node: usize,
    },
    /// An element names a node that is not there.
    #[error("an element names node {index}, but there are {nodes}")]
    Index {
        /// The number found.
        index: u32,
        /// How many nodes there are.
        nodes: usize,
    },
    /// Too few points for one simplex.
    #[error("{found} distinct points cannot be triangulated; at least {needed} are needed")]
    TooFew {
        /// Distinct points given.
        found: usize,
        /// Needed.
        needed: usize,
    },
    /// As many displacements as the mesh has nodes were expected.
    #[error("{found} displacements for a mesh of {expected} nodes")]
    Length {
        /// What the mesh needs.
        expected: usize,
        /// What was given.
        found: usize,
    },
    /// A triangle mesh can only fill a grid of one slice.
    #[error("triangles can only be interpolated on a grid of one slice, not on {shape:?}")]
    NotOneSlice {
        /// Voxels along each axis.
        shape: [usize; 3],
    },
    /// All points lie on one line.
    #[error("all points lie on one line, so there is no triangle among them")]
    Collinear,
    /// No element fits into a labelled part.
    #[error(
        "no element of the mesh falls into label {}: it is too small for the mesh; refine it with a larger --nodes, or \
         merge that label with its neighbour",
        .labels.iter().map(u8::to_string).collect::<Vec<_>>().join(", ")
    )]
    PartLost {
        /// All such labels.
        labels: Vec<u8>,
    },
    /// All points lie in one plane (use the 2D Delaunay).
    #[error("all points lie in one plane, so there is no tetrahedron among them")]
    Coplanar,
}

/// A parameter out of range.
#[derive(Debug, Clone, PartialEq, Error)]
#[error("{name} is {value}, but must be {range}")]
pub struct ParamError {
    /// The flag's name.
    pub name: &'static str,
    /// What was given.
    pub value: f64,
    /// What is allowed.
    pub range: &'static str,
}

/// A name that is not among the known ones.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("unknown {what} '{found}'{}; known: {}", .nearest.map(|n| format!(", did you mean '{n}'?")).unwrap_or_default(), .known.join(", "))]
pub struct UnknownName {
    /// What was to be chosen.
    pub what: &'static str,
    /// What was given.
    pub found: String,
    /// All names that are known.
    pub known: Vec<&'static str>,
    /// The nearest of them, when it is near.
    pub nearest: Option<&'static str>,
}

/// Reading and writing files.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum IoError {
    /// The operating system refused.
    #[error("{path}: cannot {action}: {source}; {hint}", path = path.shown(), hint = os_hint(source))]
    Os {
        /// The file.
        path: PathBuf,
        /// read, write, create ...
        action: &'static str,
        /// Why.
        source: std::io::Error,
    },
    /// The file is not what it should be.
    #[error("{path}: {what}; {hint}", path = path.shown())]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
        /// What to try.
        hint: String,
    },
}

/// A number above 0 to three digits, rounded down: advice must hold when it is followed.
pub fn below(v: f64) -> String {
    let unit = 10f64.powi(v.log10().floor() as i32 - 2);
    format!("{:.2e}", (v / unit).floor() * unit)
}

/// What to try when the operating system refuses.
fn os_hint(error: &std::io::Error) -> &'static str {
    use std::io::ErrorKind;
    match error.kind() {
        ErrorKind::NotFound => "check the spelling, and that the folder exists",
        ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem => "check its permissions or choose another folder",
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge => {
            "free some space or choose another folder"
        }
        _ => "check the path and the disk",
    }
}

/// Strain from a displacement field.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum StrainError {
    /// Two grids that had to be the same are not, or geometry.
    #[error(transparent)]
    Field(#[from] FieldError),
    /// NaN or infinity where strain is wanted.
    #[error("the field is no finite number in {voxels} voxels of the tissue; leave them out with --mask")]
    NotFinite {
        /// How many voxels.
        voxels: usize,
    },
    /// The field folds.
    #[error(
        "the field folds in {voxels} voxels of the tissue, which has no strain there; measure it again, or leave them out \
         with --mask"
    )]
    Folds {
        /// How many voxels.
        voxels: usize,
    },
    /// The tissue spans no volume.
    #[error(
        "the tissue is {voxels} voxel thick along an axis of a volume, so strain along it cannot be told; give a mask of two \
         voxels or more"
    )]
    Thin {
        /// How many voxels.
        voxels: usize,
    },
    /// Samples of the error do not lie over the field.
    #[error(
        "the samples of the error lie over another place than the field; take posterior.nii.gz of the same run, or none"
    )]
    Samples,
    /// No label lies in the tissue.
    #[error("no label lies in the tissue; check that labels and mask show the same place")]
    NoLabel,
    /// The gauge does not reach a voxel's neighbours.
    #[error("a gauge of {asked:.5} mm is under two voxels ({least:.5} mm); ask for that or more, or leave --gauge out")]
    ShortGauge {
        /// Asked for (mm).
        asked: f64,
        /// The shortest (mm).
        least: f64,
    },
    /// The gauge is wider than the body.
    #[error("a gauge of {asked:.5} mm is wider than the tissue ({width:.3} mm); ask for less, or leave --gauge out")]
    WideGauge {
        /// Asked for (mm).
        asked: f64,
        /// Least extent of the tissue along an axis (mm).
        width: f64,
    },
    /// Directions that are none.
    #[error("{what}; {hint}")]
    Directions {
        /// What is wrong.
        what: String,
        /// What to try.
        hint: String,
    },
}

/// The field pipeline.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum FieldError {
    /// A parameter out of range.
    #[error(transparent)]
    Param(#[from] ParamError),
    /// Geometry.
    #[error(transparent)]
    Space(#[from] SpaceError),
    /// Meshing.
    #[error(transparent)]
    Mesh(#[from] MeshError),
    /// A volume that cannot be used; `volume` is "initial", "deformed" or "mask".
    #[error("the {volume} volume {what}; {hint}")]
    Volume {
        /// Which one.
        volume: &'static str,
        /// What is wrong.
        what: String,
        /// What to try.
        hint: String,
    },
    /// Too little to work with.
    #[error("{found} {what}, {needed} are needed; {hint}")]
    TooFew {
        /// Found.
        found: usize,
        /// Of what.
        what: &'static str,
        /// Needed.
        needed: usize,
        /// What to try.
        hint: String,
    },
    /// The two volumes do not show the same place.
    #[error("the two volumes do not overlap in world space; {hint}")]
    NoOverlap {
        /// What to try.
        hint: String,
    },
    /// A start that no search can begin from, or something known that a method does not take.
    #[error("{what}; {hint}")]
    Start {
        /// What is wrong.
        what: String,
        /// What to try.
        hint: String,
    },
    /// The displacement makes the volumes less alike.
    #[error(
        "the volumes agree less under the displacement that was found ({found:.2}) than at rest ({at_rest:.2}; 1 is best), so nothing was measured; {hint}"
    )]
    Worse {
        /// Part of the variance that one volume explains of the other at rest.
        at_rest: f64,
        /// The same under the displacement.
        found: f64,
        /// What to try.
        hint: String,
    },
    /// A label map of which nothing lies on the grid that it is for.
    #[error("{what}: does not overlap {reference} in world space; check both headers (palpate info)")]
    Elsewhere {
        /// What.
        what: String,
        /// Of what the grid is.
        reference: String,
    },
    /// Two grids that had to be the same are not.
    #[error(
        "{what} is on another grid ({found:?}) than {reference} ({expected:?}{}); if both lie in the same \
         space, resample it with `palpate warp --reference` (masks and labels with --interpolation nearest)",
        if found == expected { ", but other voxels or another place" } else { "" }
    )]
    GridMismatch {
        /// What.
        what: String,
        /// Its shape.
        found: [usize; 3],
        /// Of what the grid should be.
        reference: String,
        /// The shape it should have.
        expected: [usize; 3],
    },
}

/// Phantoms.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SynthError {
    /// A parameter out of range.
    #[error(transparent)]
    Param(#[from] ParamError),
    /// A body whose stiffness is not known.
    #[error("this phantom has no known stiffness; an elastic motion needs fingertip, inclusion or slab")]
    NotElastic,
    /// Geometry.
    #[error(transparent)]
    Space(#[from] SpaceError),
}

/// The stiffness.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum StiffnessError {
    /// A parameter out of range.
    #[error(transparent)]
    Param(#[from] ParamError),
    /// Geometry.
    #[error(transparent)]
    Space(#[from] SpaceError),
    /// Meshing.
    #[error(transparent)]
    Mesh(#[from] MeshError),
    /// The body is in several pieces.
    #[error(
        "{what} is in {pieces} pieces, the largest of {largest} and the next of {next} voxels; elasticity needs one piece: keep \
         the largest component, or join them"
    )]
    Disconnected {
        /// The mask or the labels.
        what: String,
        /// How many.
        pieces: usize,
        /// Voxels of the largest.
        largest: usize,
        /// Voxels of the second.
        next: usize,
    },
    /// A body without a third dimension.
    #[error(
        "the body (mask or labels) is one voxel thick along voxel axis {axis}: stiffness needs a volume; image several slices"
    )]
    Flat {
        /// x, y or z.
        axis: char,
    },
    /// A patch without a surface.
    #[error("the {which} patch ({name}) {what}; {hint}")]
    Patch {
        /// `held` or `loaded`.
        which: &'static str,
        /// As given.
        name: String,
        /// What is wrong.
        what: String,
        /// What to try.
        hint: String,
    },
    /// Nothing is deformed.
    #[error(
        "no load: the loaded patch moves {moved:.3} mm against the held one, where the field is good to {noise:.3} mm; {}",
        if *moved < -noise {
            "they move apart: check that the volumes, and with them the field, are not in the wrong order (`palpate invert`), \
             and --held and --load"
        } else {
            "check --held and --load, and that the field is not of a body at rest"
        }
    )]
    NoLoad {
        /// Inward motion (mm).
        moved: f64,
        /// Precision (mm).
        noise: f64,
    },
    /// No force.
    #[error("no force acts, by --forces, so there is nothing to tell moduli from")]
    NoForce,
    /// Too few samples.
    #[error(
        "{found} places of the field lie in the body, {needed} are needed; check that field and labels belong together"
    )]
    TooFew {
        /// Found.
        found: usize,
        /// Needed.
        needed: usize,
    },
    /// The matrix cannot be factorised.
    #[error(
        "the equations of the body cannot be solved: a part of it can move freely, or memory is short; check that the held \
         patch is part of the body, or take fewer --nodes"
    )]
    Unsolvable,
    /// An element is inside out.
    #[error("an element turns inside out under the measured load; check the field, or use --model linear")]
    InsideOut,
    /// Newton's method does not converge.
    #[error("no equilibrium was found under the measured load; check the field, or use --model linear")]
    NoEquilibrium,
}

/// Pictures and pages.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum ReportError {
    /// A picture could not be encoded.
    #[error("a picture of the report could not be encoded: {what}")]
    Picture {
        /// What the encoder said.
        what: String,
    },
}

/// A grasp scene.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum SceneError {
    /// A value out of range.
    #[error(transparent)]
    Param(#[from] ParamError),
    /// A value that does not go with the others.
    #[error("{key} is {value}, but must be {range}")]
    Value {
        /// Its place in the scene.
        key: String,
        /// What was given.
        value: String,
        /// What may be given.
        range: &'static str,
    },
    /// The half span and the normal displacement contradict each other.
    #[error(
        "finger.half_span {half_span} m and initial.normal_displacement {depth} m do not go together: \
         radius + width / 2 - half_span is {by_geometry:.6} m; leave one of the two out"
    )]
    Geometry {
        /// As given (m).
        half_span: f64,
        /// Normal displacement as given (m).
        depth: f64,
        /// Normal displacement by the geometry (m).
        by_geometry: f64,
    },
    /// A layer of skin that yields too fast to be followed.
    #[error(
        "some layer yields faster than the load lasts by a factor of {factor:.0e}, so rounding leaves no digit of the response; leave out \
         the dashpot that does so, or correct the modulus beside it"
    )]
    Stiff {
        /// Duration of the load over the shortest time constant (1).
        factor: f64,
    },
    /// Motions of joints that are locked.
    #[error("finger.fixed is true, but there are motions; remove the [[motion]] tables or set fixed = false")]
    FixedMotion,
    /// Maxwell branches where there is no spring beside them, or in the multiplier form.
    #[error(
        "fingertip.maxwell needs soft tips and the minimal form; leave it out, or change fingertip.model or \
         integrator.formulation"
    )]
    Relaxing,
    /// Stiffening of tips of one modulus.
    #[error(
        "fingertip.stiffening is of tabulated tips, and these are {model}; give model = \"tabulated\" or leave it out"
    )]
    Stiffening {
        /// The model of the scene.
        model: &'static str,
    },
    /// Fingers of two joints that should move.
    #[error(
        "fingers of two joints are not simulated; leave finger.links out and give finger.link, or look at them with \
         `palpate grasp-analysis`"
    )]
    TwoJoints,
    /// Rigid tips and locked joints.
    #[error("rigid tips and fixed joints leave nothing to move; choose another fingertip.model or set fixed = false")]
    NothingMoves,
    /// Rigid tips away from joint angles 0.
    #[error("rigid tips start at joint angles 0; remove initial.theta or choose another fingertip.model")]
    RigidStart,
    /// More steps or samples than a run may have.
    #[error("{duration} s take more than 2e9 steps or 2e6 samples; lengthen integrator.step or output_every")]
    TooLong {
        /// Of the whole run (s).
        duration: f64,
    },
}

/// Reducing a stiffness map to a fingertip.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum FingertipError {
    /// Nothing hard under the tissue.
    #[error(
        "no bone or back plate lies under the pad; name that region bone (palpate stiffness --names 3=bone), or check the \
         side that was pressed"
    )]
    NoBone,
    /// Hardly any tissue.
    #[error(
        "only {found} columns of tissue lie between the surface and the bone, {needed} are needed; check the labels"
    )]
    TooFew {
        /// How many there are.
        found: usize,
        /// How many are needed.
        needed: usize,
    },
    /// The grid is askew to the contact.
    #[error(
        "the volume's axes are {degrees:.0} degrees off the pressed side; resample the labels along it (10 at most)"
    )]
    Askew {
        /// Angle between the side and the nearest voxel axis (degrees).
        degrees: f64,
    },
    /// Moduli without unit.
    #[error("the stiffness map holds ratios; run palpate stiffness with --total-force, so that it is in kPa")]
    NotAbsolute,
    /// A number out of range.
    #[error(transparent)]
    Param(#[from] ParamError),
}

/// The grasp simulator.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum GraspError {
    /// The scene.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// No equilibrium to start from.
    #[error("at time 0, {what}; {hint}")]
    NoStart {
        /// What is wrong.
        what: String,
        /// What to try.
        hint: String,
    },
    /// The step is too long from the start.
    #[error(
        "at time 0, a step of {step} s grows {growth:.3}-fold each time it is taken ({method}); \
         take integrator.step at or under {} s", below(*stable)
    )]
    BadStep {
        /// The step (s).
        step: f64,
        /// Spectral radius of one step.
        growth: f64,
        /// Integrator and formulation.
        method: String,
        /// Largest stable step (s).
        stable: f64,
    },
    /// The gain of the constraint stabilisation is too high for the step.
    #[error(
        "at time 0, a Baumgarte gain of {gain} 1/s is too high for a step of {step} s (growth {growth:.3} a step); \
         take integrator.baumgarte at or under {} 1/s, or a shorter step", stable.floor()
    )]
    BadGain {
        /// The gain (1/s).
        gain: f64,
        /// The step (s).
        step: f64,
        /// Spectral radius of one step.
        growth: f64,
        /// Largest stable gain (1/s).
        stable: f64,
    },
}
