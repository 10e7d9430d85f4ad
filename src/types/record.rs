//! What a run was asked for, when, and what it has read.

use serde::{Deserialize, Serialize};

/// A file, or a folder of files, that a run has read.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct InputFile {
    /// What it was to the run, such as `initial` or `mask`.
    pub role: String,
    /// Its full path.
    pub path: String,
    /// Its size; of a folder, that of its files together.
    pub bytes: u64,
    /// SHA-256 of its content in hexadecimal digits; of a folder, of its files one after the other
    /// by name. Empty where it was gone before it could be read again.
    pub sha256: String,
}

/// What is needed to repeat a run.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct RunRecord {
    /// The arguments of the program, the command first.
    pub command_line: Vec<String>,
    /// The full path of the folder from which relative paths among them count.
    pub working_folder: String,
    /// When the run began: UTC, RFC 3339.
    pub date: String,
    /// What was read.
    pub files: Vec<InputFile>,
}

/// A count of seconds since the start of 1970 (UTC) as RFC 3339, such as `2026-02-28T09:05:07Z`.
pub(crate) fn rfc3339(seconds: u64) -> String {
    let (days, rest) = (seconds / 86_400, seconds % 86_400);
    // Years of 400 begin on the first of March of the year 0.
    let shifted = days + 719_468;
    let (era, day) = (shifted / 146_097, shifted % 146_097);
    let year = (day - day / 1_460 + day / 36_524 - day / 146_096) / 365;
    let of_year = day - (365 * year + year / 4 - year / 100);
    let month = (5 * of_year + 2) / 153;
    let date = of_year - (153 * month + 2) / 5 + 1;
    let (month, after) = if month < 10 { (month + 3, 0) } else { (month - 9, 1) };
    let year = 400 * era + year + after;
    format!("{year:04}-{month:02}-{date:02}T{:02}:{:02}:{:02}Z", rest / 3_600, rest / 60 % 60, rest % 60)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_are_those_of_the_calendar() {
        // `date -u -d @N` tells them.
        for (seconds, date) in [
            (0, "1970-01-01T00:00:00Z"),
            (951_782_399, "2000-02-28T23:59:59Z"),
            (951_782_400, "2000-02-29T00:00:00Z"),
            (951_868_800, "2000-03-01T00:00:00Z"),
            (1_735_689_599, "2024-12-31T23:59:59Z"),
            (1_772_269_507, "2026-02-28T09:05:07Z"),
            (4_107_542_400, "2100-03-01T00:00:00Z"),
        ] {
            assert_eq!(rfc3339(seconds), date);
        }
    }
}
