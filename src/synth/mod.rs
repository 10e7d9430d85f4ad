//! Phantoms: pairs of volumes whose displacement is known exactly.
//!
//! A body is an intensity B(p) at every world position, a motion a displacement u(x) in closed form
//! or, for the elastic ones, that of finite elements; so neither volume is interpolated. The same
//! settings give the same bytes for any number of threads. Fails when a setting is out of range or
//! the motion folds. Only [`imposed`] moves a real volume, which is interpolated once.

mod anatomy;

mod volume_faults;

mod body;

pub mod elastic;

pub mod imposed;

mod landmarks;

mod appearance;

mod motion;

mod noise;

pub mod params;

pub mod phantom;

mod scenes;

mod sequence;

pub mod degradation;

pub use degradation::{Trouble, troubled};
pub use params::{ElasticParams, MotionKind, PhantomKind, PhantomParams};
pub use phantom::{MIN_JACOBIAN, Phantom, Stiffness, phantom, phantom_on};
pub use sequence::{Sequence, SequenceKind, SequenceParams};
