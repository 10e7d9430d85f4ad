//! How long each stage of a run takes, and why it went as it did: both are logged as they come.

use std::fmt::Display;
use std::time::{Duration, Instant};

/// What was found, also logged.
pub(super) fn noted<T: Display>(found: T) -> T {
    log::debug!("{found}");
    found
}

/// Stage names and their wall seconds.
pub(super) struct Clock(pub(super) Vec<(String, f64)>, Instant);

impl Clock {
    /// Nothing booked yet.
    pub(super) fn start() -> Self {
        Self(Vec::new(), Instant::now())
    }

    /// Books the time since the last call to `stage`.
    pub(super) fn book(&mut self, stage: &str) {
        let seconds = self.1.elapsed().as_secs_f64();
        self.1 = Instant::now();
        log::debug!("{stage}: {seconds:.2} s");
        self.add(stage, seconds);
    }

    /// Books `seconds` that passed before now to `stage`, and leaves them out of what is booked
    /// next.
    pub(super) fn skip(&mut self, stage: &str, seconds: f64) {
        self.1 += Duration::from_secs_f64(seconds);
        self.add(stage, seconds);
    }

    fn add(&mut self, stage: &str, seconds: f64) {
        match self.0.iter_mut().find(|s| s.0 == stage) {
            Some(s) => s.1 += seconds,
            None => self.0.push((stage.into(), seconds)),
        }
    }
}
