//! CPU time: what a run costs, whatever else the machine does.

use std::time::Duration;

/// CPU seconds of all threads of this process so far, in user and system mode; none where the
/// system does not tell.
#[cfg(unix)]
pub fn spent() -> Option<f64> {
    use rustix::time::{ClockId, clock_gettime};
    let now = clock_gettime(ClockId::ProcessCPUTime);
    Some(now.tv_sec as f64 + now.tv_nsec as f64 * 1e-9)
}

/// CPU seconds of all threads of this process so far, in user and system mode; none where the
/// system does not tell.
#[cfg(not(unix))]
pub fn spent() -> Option<f64> {
    None
}

/// What `work` gives back, and the CPU seconds of this process meanwhile (wall seconds where those
/// are not told). Nothing else may run in the process.
pub fn timed<R>(work: impl FnOnce() -> R) -> (R, f64) {
    let (started, before) = (std::time::Instant::now(), spent());
    let out = work();
    let wall = started.elapsed();
    let seconds = before.zip(spent()).map_or_else(|| Duration::as_secs_f64(&wall), |(a, b)| b - a);
    (out, seconds)
}
