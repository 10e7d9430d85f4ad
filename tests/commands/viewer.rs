//! The viewer of a report in a real browser, where Chromium is installed.

use crate::fixtures::{palpate, small_pair, text};
use palpate::report::colormap::ColorMap;
use palpate::report::scale::Scale;
use palpate::report::viewer::{Layer, Moment, Viewer};
use palpate::types::{Affine, Grid};
use std::path::Path;
use std::process::Command;
use tempfile::TempDir;

/// Catches every error before anything else runs.
const WATCH: &str = "<script>window.wrong=[];addEventListener('error',e=>wrong.push('FAILED: '+e.message));\
    addEventListener('unhandledrejection',e=>wrong.push('FAILED: '+e.reason));\
    console.error=(...a)=>wrong.push('FAILED: console: '+a.join(' '));</script>";

fn browser() -> Option<&'static str> {
    let found = |name: &&str| Command::new(name).arg("--version").output().is_ok_and(|o| o.status.success());
    ["chromium", "chromium-browser", "google-chrome"].into_iter().find(found)
}

/// Opens the report, works every control, and gives a line for each check.
fn work(report: &Path) -> Option<String> {
    let Some(browser) = browser() else {
        eprintln!("skipped: no Chromium is installed");
        return None;
    };
    let page = std::fs::read_to_string(report).unwrap();
    let check = format!("<script>{}</script></body>", include_str!("../fixtures/viewer_check.js"));
    let page = page.replacen("<head>", &format!("<head>{WATCH}"), 1).replacen("</body>", &check, 1);
    let folder = TempDir::new().unwrap();
    let file = folder.path().join("check.html");
    std::fs::write(&file, page).unwrap();
    let output = Command::new(browser)
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--window-size=1366,768"])
        .args(["--virtual-time-budget=60000", "--dump-dom"])
        .arg(format!("--user-data-dir={}", folder.path().join("profile").display()))
        .arg(format!("file://{}", file.display()))
        .output()
        .unwrap();
    let dom = text(&output.stdout);
    let from = dom.find("<pre id=\"said\">").unwrap_or_else(|| panic!("nothing was said: {}", text(&output.stderr)));
    Some(dom[from + 15..from + dom[from..].find("</pre>").unwrap()].to_string())
}

/// All checks pass and are `least` in number; gives what the readout says at first, empty without a
/// browser.
fn all_is_well(report: &Path, least: usize) -> String {
    let Some(said) = work(report) else { return String::new() };
    assert!(!said.contains("FAILED"), "{said}");
    let checks = said.lines().filter(|l| l.starts_with("ok: ")).count();
    assert!(checks >= least, "only {checks} checks:\n{said}");
    said.lines().find_map(|l| l.strip_prefix("reads: ")).unwrap().into()
}

#[test]
fn the_field_report_loads_without_errors_and_every_control_works() {
    let folder = small_pair();
    let arguments = ["field", "initial.nii.gz", "deformed.nii.gz", "--mask", "mask.nii.gz", "--quiet", "-o", "results"];
    palpate(folder.path()).args(arguments).assert().success();
    let report = folder.path().join("results/report.html");
    assert!(report.metadata().unwrap().len() < 2_000_000, "a small volume makes a small page");
    all_is_well(&report, 35);
}

#[test]
fn the_stiffness_report_too() {
    let folder = TempDir::new().unwrap();
    let phantom = ["phantom", "inclusion", "--size", "20", "--quiet", "-o", "block"];
    palpate(folder.path()).args(phantom).assert().success();
    let stiffness = ["stiffness", "--field", "block/truth.nii.gz", "--labels", "block/labels.nii.gz"];
    let images = ["--image", "block/initial.nii.gz", "--image", "block/deformed.nii.gz"];
    let rest = ["--nodes", "1500", "--model", "linear", "--quiet", "-o", "stiffness"];
    palpate(folder.path()).args(stiffness).args(images).args(rest).assert().success();
    let said = all_is_well(&folder.path().join("stiffness/report.html"), 25);
    assert!(!said.contains("at least") && !said.contains("unknown"), "{said}");
}

#[test]
fn the_report_of_a_sequence_too_at_every_moment() {
    let folder = TempDir::new().unwrap();
    let phantom = ["phantom", "pinch", "--size", "32", "--frames", "4", "--quiet", "-o", "pinch"];
    palpate(folder.path()).args(phantom).assert().success();
    let frames = [0, 1, 2, 3].map(|n| format!("pinch/frame_{n:03}.nii.gz"));
    let rest = ["--mask", "pinch/mask.nii.gz", "--quiet", "-o", "tracked"];
    palpate(folder.path()).arg("track").args(frames).args(rest).assert().success();
    let report = folder.path().join("tracked/report.html");
    assert!(std::fs::read_to_string(&report).unwrap().contains("Every frame measured, at first the one"));
    all_is_well(&report, 42);
}

#[test]
fn what_is_past_a_scale_or_unknown_is_said_and_what_ends_it_is_exact() {
    let grid = Grid::new([12; 3], Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap();
    let scale = |map| Scale { low: 0.0, high: 2.0, unit: "kPa", map };
    let stripes = |o: usize| (o % 7) as f32 / 3.0;
    let ramp = |o: usize| grid.voxel(o)[0] as f32 / 6.0;
    let overlay = |name, values| Layer { name, values, scale: scale(ColorMap::Viridis) };
    // Known but for a block around the centre.
    let hole = |o: usize| if grid.voxel(o).into_iter().all(|i| (3..10).contains(&i)) { f32::INFINITY } else { 1.0 };
    let overlays = [
        overlay("ramp", &ramp),
        overlay("end", &|o| 2.0 - (o % 12 / 11) as f32),
        overlay("past", &|o| 2.1 - (o % 12 / 11) as f32),
        overlay("hole", &hole),
    ];
    // Of the ramp: a lower bound before the centre, an upper one from there on.
    let bounds = |o: usize| 1 + u8::from(grid.voxel(o)[0] >= 6);
    let moment = Moment {
        name: None,
        images: &[],
        overlays: &overlays,
        bounds: Some(&bounds),
        displacement: None,
        matches: None,
        mesh: None,
    };
    let viewer = Viewer {
        grid: &grid,
        centre: grid.world(6, 6, 6),
        mask: None,
        images: &[Layer { name: "stripes", values: &stripes, scale: scale(ColorMap::Gray) }],
        shown: Some(0),
        moments: &[&moment.pack(&grid)],
        first: 0,
    };
    let folder = TempDir::new().unwrap();
    let page = folder.path().join("page.html");
    let body = viewer.html().into_string();
    std::fs::write(&page, format!("<!doctype html><html><head></head><body>{body}</body></html>")).unwrap();
    let said = all_is_well(&page, 5);
    if said.is_empty() {
        return;
    }
    for part in ["ramp at most 1.00 kPa", "end 2.00 kPa", "past at least 2.00 kPa", "hole unknown"] {
        assert!(said.contains(part), "no {part:?} in {said:?}");
    }
}
