//! consistency.
