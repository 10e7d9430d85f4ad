//! How much memory this process may still take.

use super::format_error::Flaw;
use std::fs;
use std::path::Path;

/// Bytes that can still be taken: the least of what the machine has available, what each control
/// group above the process leaves, and what its own limit on addresses leaves. None where the
/// system does not tell.
pub(crate) fn memory_left() -> Option<u64> {
    let machine = meminfo(&fs::read_to_string("/proc/meminfo").ok()?);
    let groups = fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    machine.into_iter().chain(group_left(Path::new("/sys/fs/cgroup"), &groups)).chain(addresses_left()).min()
}

/// Refuses to read what memory does not hold, before it is asked for.
pub(super) fn fits(bytes: u64) -> Result<(), Flaw> {
    let left = memory_left().unwrap_or(u64::MAX);
    if bytes <= left {
        return Ok(());
    }
    let gb = |n: u64| n as f64 / 1e9;
    let what = format!("needs {:.2} GB of memory, and {:.2} GB are left", gb(bytes), gb(left));
    Err(Flaw::new(what, "close other programs, or crop or halve the volume"))
}

/// `MemAvailable` of /proc/meminfo (bytes).
fn meminfo(text: &str) -> Option<u64> {
    let line = text.lines().find_map(|l| l.strip_prefix("MemAvailable:"))?;
    Some(1024 * line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?)
}

/// What the tightest group of a process leaves, under version 2 and version 1 of control groups
/// (bytes). Files that are merely cached there can be given up, so they do not count.
fn group_left(root: &Path, groups: &str) -> Option<u64> {
    let number = |path: &Path| fs::read_to_string(path).ok()?.trim().parse::<u64>().ok();
    let cached = |folder: &Path| {
        let stat = fs::read_to_string(folder.join("memory.stat")).unwrap_or_default();
        let field = |name: &str| stat.lines().find_map(|l| l.strip_prefix(name)?.trim().parse::<u64>().ok());
        field("total_inactive_file ").or_else(|| field("inactive_file ")).unwrap_or(0)
    };
    let mut least = None;
    for line in groups.lines() {
        let mut parts = line.splitn(3, ':').skip(1);
        let (Some(kind), Some(path)) = (parts.next(), parts.next()) else { continue };
        let (base, limit, used) = match kind {
            "" => (root.to_path_buf(), "memory.max", "memory.current"),
            kind if kind.split(',').any(|k| k == "memory") => {
                (root.join("memory"), "memory.limit_in_bytes", "memory.usage_in_bytes")
            }
            _ => continue,
        };
        let own = base.join(path.trim_start_matches('/'));
        for folder in own.ancestors().take_while(|f| f.starts_with(&base)) {
            if let (Some(limit), Some(used)) = (number(&folder.join(limit)), number(&folder.join(used))) {
                let left = limit.saturating_sub(used.saturating_sub(cached(folder)));
                least = Some(least.map_or(left, |l: u64| l.min(left)));
            }
        }
    }
    least
}

/// What the limit on the process's addresses (`ulimit -v`) leaves (bytes).
#[cfg(unix)]
fn addresses_left() -> Option<u64> {
    let limit = rustix::process::getrlimit(rustix::process::Resource::As).current?;
    let pages = fs::read_to_string("/proc/self/statm").ok()?.split_whitespace().next()?.parse::<u64>().ok()?;
    Some(limit.saturating_sub(pages * rustix::param::page_size() as u64))
}

#[cfg(not(unix))]
fn addresses_left() -> Option<u64> {
    None
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn available_memory_is_read_in_bytes() {
        assert_eq!(meminfo("MemTotal:  100 kB\nMemAvailable:    24 kB\n"), Some(24 * 1024));
        assert_eq!(meminfo("MemTotal:  100 kB\n"), None);
    }

    #[test]
    fn the_tightest_group_counts_and_cached_files_do_not() {
        let root = tempfile::tempdir().unwrap();
        let put = |at: &str, text: &str| {
            let path = root.path().join(at);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        };
        put("jobs/memory.max", "1000\n");
        put("jobs/memory.current", "900\n");
        put("jobs/memory.stat", "anon 500\ninactive_file 400\n");
        put("jobs/one/memory.max", "max\n");
        put("jobs/one/memory.current", "300\n");
        assert_eq!(group_left(root.path(), "0::/jobs/one\n"), Some(500));
        put("memory/old/memory.limit_in_bytes", "700");
        put("memory/old/memory.usage_in_bytes", "300");
        assert_eq!(group_left(root.path(), "3:cpu,memory:/old\n0::/\n"), Some(400));
        assert_eq!(group_left(root.path(), "0::/elsewhere\n"), None);
    }
}
