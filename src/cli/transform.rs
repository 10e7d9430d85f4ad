//! Transforms on the command line: `FILE`, `fsl:FILE`, `FILE,-1`.

use super::console::Console;
use anyhow::Result;
use clap::Args;
use palpate::error::Shown;
use palpate::error::UnknownName;
use palpate::io::{self, TransformSource};
use palpate::transforms::Chain;
use palpate::types::Grid;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// One transform: a file, whose it is, and whether it is turned round.
#[derive(Debug, Clone, PartialEq)]
pub struct Given {
    pub path: PathBuf,
    source: Option<TransformSource>,
    pub inverse: bool,
}

impl FromStr for Given {
    type Err = UnknownName;

    fn from_str(text: &str) -> Result<Self, UnknownName> {
        let (rest, inverse) = match text.strip_suffix(",-1") {
            Some(rest) if !Path::new(text).exists() => (rest, true),
            _ => (text, false),
        };
        // A single letter is a drive, and what is there as a whole is a file.
        let named = rest.split_once(':').filter(|(name, _)| name.len() > 1 && !name.contains(['/', '\\']));
        let (source, path) = match named {
            Some((name, path)) if !Path::new(rest).exists() => (Some(name.parse()?), path),
            _ => (None, rest),
        };
        Ok(Self { path: path.into(), source, inverse })
    }
}

/// Volumes whose headers FSL's numbers refer to.
#[derive(Debug, Args)]
pub struct Volumes {
    /// The fixed volume that a transform of FSL was made for (FLIRT's -ref)
    #[arg(long, value_name = "IMAGE")]
    pub initial: Option<PathBuf>,
    /// The moving volume that a transform of FSL was made for (FLIRT's -in)
    #[arg(long, value_name = "IMAGE")]
    pub deformed: Option<PathBuf>,
}

impl Volumes {
    /// Their files.
    pub fn paths(&self) -> impl Iterator<Item = &Path> {
        [&self.initial, &self.deformed].into_iter().flatten().map(PathBuf::as_path)
    }

    /// Their grids.
    pub fn grids(&self) -> Result<[Option<Grid>; 2]> {
        let grid = |path: &Option<PathBuf>| -> Result<Option<Grid>> {
            Ok(path.as_ref().map(io::read_header).transpose()?.map(|(stored, _)| stored.grid))
        };
        Ok([grid(&self.initial)?, grid(&self.deformed)?])
    }
}

/// The chain of the transforms, the first listed first. `grids` are those of the fixed and the
/// moving volume, for FSL.
pub fn read_chain(given: &[Given], grids: &[Option<Grid>; 2], console: &Console) -> Result<Chain> {
    let mut chain = Chain::default();
    for Given { path, source, inverse } in given {
        let found = io::read_transform(path, *source, grids[0].as_ref(), grids[1].as_ref())?;
        if found.guessed {
            console.warn(&format!(
                "{}: 4 x 4 numbers do not say whose they are, and were taken as greedy's or NiftyReg's (RAS mm, fixed to \
                 moving); write fsl: before the name for FLIRT's, greedy: to be sure",
                path.shown()
            ));
        }
        let part = Chain(found.transforms);
        chain.0.extend(if *inverse { part.inverse().0 } else { part.0 });
    }
    Ok(chain)
}

/// How many voxels of `all`, in per cent.
pub fn percent(count: usize, all: usize) -> String {
    match 100.0 * count as f64 / all as f64 {
        share if share < 0.1 => "under 0.1 %".into(),
        share if share < 0.95 => format!("{share:.1} %"),
        share if share > 99.0 && count < all => "over 99 %".into(),
        share => format!("{share:.0} %"),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn names_and_turns_are_told_from_the_file() {
        let given = |text: &str| text.parse::<Given>().unwrap();
        let of = |path: &str, source, inverse| Given { path: path.into(), source, inverse };
        assert_eq!(given("a/b.mat"), of("a/b.mat", None, false));
        assert_eq!(given("fsl:a/b.mat,-1"), of("a/b.mat", Some(TransformSource::Fsl), true));
        assert_eq!(given("ANTS:w.nii.gz"), of("w.nii.gz", Some(TransformSource::Itk), false));
        assert_eq!(given("C:\\a.tfm"), of("C:\\a.tfm", None, false));
        assert_eq!(given("./od:d.tfm"), of("./od:d.tfm", None, false));
        let error = "flirt:a.mat".parse::<Given>().unwrap_err().to_string();
        assert!(error.contains("fsl") && error.contains("niftyreg"), "{error}");
    }

    #[test]
    fn shares_are_never_nothing_or_all_by_rounding() {
        let cases = [(1, 1_000_000, "under 0.1 %"), (5, 1000, "0.5 %"), (12, 100, "12 %"), (999, 1000, "over 99 %")];
        for (count, all, expected) in cases {
            assert_eq!(percent(count, all), expected);
        }
    }
}
