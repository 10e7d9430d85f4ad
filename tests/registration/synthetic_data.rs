//! data-synthetic/: what its README says made it does make it, and it can be measured.

use assert_cmd::Command;
use palpate::types::FieldParams;
use palpate::{evaluate, io, pipeline};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

fn data() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("data-synthetic")
}

/// The commands of the README, less the program's name; the last argument is the folder.
fn commands() -> Vec<Vec<String>> {
    let readme = std::fs::read_to_string(data().join("README.md")).unwrap();
    let command = |l: &str| l.trim().strip_prefix("palpate ").map(|c| c.split(' ').map(String::from).collect());
    readme.lines().filter_map(command).collect()
}

#[test]
fn the_readme_names_every_folder_and_no_file_is_large() {
    let mut named: Vec<String> = commands().into_iter().map(|mut c| c.pop().unwrap()).collect();
    let folders = std::fs::read_dir(data()).unwrap().map(|e| e.unwrap().path()).filter(|p| p.is_dir());
    let mut found: Vec<String> = folders.map(|p| p.file_name().unwrap().to_string_lossy().into_owned()).collect();
    named.sort();
    found.sort();
    assert_eq!(named, found);
    for folder in found {
        for entry in std::fs::read_dir(data().join(folder)).unwrap() {
            let entry = entry.unwrap();
            assert!(entry.metadata().unwrap().len() < 300_000, "{:?}", entry.path());
        }
    }
}

/// Elementary functions differ in the last digit between platforms: intensities may differ by one
/// step, voxels at the mask's rim by their side.
#[test]
fn the_commands_of_the_readme_make_the_data_again() {
    let again = TempDir::new().unwrap();
    for command in commands() {
        let program = assert_cmd::cargo::cargo_bin!("palpate");
        Command::new(program).current_dir(&again).args(&command).assert().success();
        let folder = command.last().unwrap();
        let both = |name: &str| [data(), again.path().into()].map(|root: PathBuf| root.join(folder).join(name));
        for name in ["initial.nii.gz", "deformed.nii.gz"] {
            let [a, b] = both(name).map(|p| io::read_volume(p).unwrap());
            assert!(a.grid().same_as(b.grid()));
            let most = a.as_slice().iter().zip(b.as_slice()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(most <= 1.0, "{folder}/{name} differs by {most}");
        }
        let [a, b] = both("truth.nii.gz").map(|p| io::read_field(p).unwrap());
        let most = a.as_slice().iter().zip(b.as_slice()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(most < 1e-4, "the truth of {folder} differs by {most} mm");
        let [a, b] = both("mask.nii.gz").map(|p| io::read_mask(p).unwrap());
        assert!(a.as_slice().iter().zip(b.as_slice()).filter(|(a, b)| a != b).count() <= 2, "the mask of {folder}");
        let [a, b] = both("landmarks.csv").map(|p| io::read_landmarks(p).unwrap());
        assert!(a.len() == b.len() && !a.is_empty(), "the landmarks of {folder}");
    }
}

#[test]
fn the_data_can_be_measured() {
    // Folder, largest mean error as a share of that before registration.
    for (name, share) in [("calf-press", 0.5), ("slice-smooth", 0.33), ("block-press", 0.5), ("fingertip-press", 0.5)] {
        let file = |f: &str| data().join(name).join(f);
        let [initial, deformed] = ["initial.nii.gz", "deformed.nii.gz"].map(|f| io::read_volume(file(f)).unwrap());
        let mask = io::read_mask(file("mask.nii.gz")).unwrap();
        let truth = io::read_field(file("truth.nii.gz")).unwrap();
        let landmarks = io::read_landmarks(file("landmarks.csv")).unwrap();
        let result =
            pipeline::field::run(&initial, &deformed, Some(&mask), &FieldParams::default(), &|_, _| {}).unwrap();
        let m = evaluate::metrics(&result.displacement, &truth, Some(&mask), &landmarks).unwrap();
        assert!(m.mean_mm < share * m.identity_mm, "{name}: {m:?}");
        assert_eq!(m.folds, 0.0, "{name}");
    }
}
