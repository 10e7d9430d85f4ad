//! What the program is built from: licences that may be passed on, no system libraries, one place
//! for each crate, no known flaw, no newer compiler. `deny.toml` says the same to cargo-deny.

use semver::{Version, VersionReq};
use serde_json::Value;
use std::collections::BTreeSet;
use std::process::{Command, Output};

/// Licences under which a part may be passed on with the program.
const PERMISSIVE: [&str; 10] = [
    "MIT",
    "Apache-2.0",
    "Apache-2.0 WITH LLVM-exception",
    "BSD-2-Clause",
    "BSD-3-Clause",
    "ISC",
    "Zlib",
    "Unlicense",
    "Unicode-3.0",
    "CC0-1.0",
];

/// Crates that carry C or a linked library: libdeflate brings its source with it.
const NATIVE: [&str; 1] = ["libdeflate-sys"];

/// What cargo prints.
fn cargo(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO")).args(arguments).current_dir(env!("CARGO_MANIFEST_DIR")).output().unwrap()
}

/// The packages that the program is built from on this system (not those of its tests), as
/// `cargo metadata` tells.
fn packages() -> Vec<Value> {
    let version = String::from_utf8(cargo(&["-vV"]).stdout).unwrap();
    let host = version.lines().find_map(|l| l.strip_prefix("host: ")).unwrap();
    // Where this is the first build, those of other systems are not there: nothing had asked for
    // them.
    let output = cargo(&["metadata", "--format-version", "1", "--locked", "--offline", "--filter-platform", host]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let all: Value = serde_json::from_slice(&output.stdout).unwrap();
    let nodes = all["resolve"]["nodes"].as_array().unwrap();
    let id = |name: &Value| name.as_str().unwrap().to_string();
    let mut wanted = vec![id(&all["resolve"]["root"])];
    let mut seen = BTreeSet::new();
    while let Some(next) = wanted.pop() {
        if !seen.insert(next.clone()) {
            continue;
        }
        let node = nodes.iter().find(|n| n["id"] == next.as_str()).unwrap();
        for dependency in node["deps"].as_array().unwrap() {
            if dependency["dep_kinds"].as_array().unwrap().iter().any(|k| k["kind"] != "dev") {
                wanted.push(id(&dependency["pkg"]));
            }
        }
    }
    all["packages"].as_array().unwrap().iter().filter(|p| seen.contains(p["id"].as_str().unwrap())).cloned().collect()
}

/// Whether an SPDX expression allows one of the permissive licences (`a OR b`, `a AND b`, brackets,
/// `a/b` of old).
fn allowed(expression: &str) -> bool {
    let expression = expression.replace('/', " OR ").replace(['(', ')'], "");
    let one = |name: &str| PERMISSIVE.contains(&name.trim());
    let each = |part: &str| part.split(" AND ").all(one);
    // `a AND (b OR c)` reads as `a AND b OR c` without brackets: then each name must be allowed.
    match expression.contains(" AND ") && expression.contains(" OR ") {
        true => expression.split(" OR ").all(each),
        false => expression.split(" OR ").any(each),
    }
}

#[test]
fn every_part_may_be_passed_on() {
    assert!(
        allowed("MIT OR GPL-3.0") && allowed("MIT/Apache-2.0") && !allowed("GPL-3.0") && !allowed("MIT AND GPL-3.0")
    );
    let packages = packages();
    assert!(packages.len() > 40, "{}", packages.len());
    for p in &packages {
        let licence = p["license"].as_str().unwrap_or_default();
        assert!(allowed(licence), "{} {}: {licence:?}", p["name"], p["version"]);
    }
}

#[test]
fn no_library_of_the_system_is_linked() {
    let linked: Vec<String> =
        packages().iter().filter(|p| !p["links"].is_null()).map(|p| p["name"].as_str().unwrap().to_string()).collect();
    // Crates that only keep themselves from being built in twice name a library of their own.
    let own = ["rayon-core", "prettyplease"];
    let native: Vec<&String> = linked.iter().filter(|l| !own.contains(&l.as_str())).collect();
    assert_eq!(native, NATIVE);
}

#[test]
fn every_part_comes_from_the_registry() {
    for p in packages().iter().filter(|p| p["name"] != "palpate") {
        let source = p["source"].as_str().unwrap_or_default();
        assert!(source.starts_with("registry+"), "{}: {source:?}", p["name"]);
    }
}

/// The compiler that `Cargo.toml` says is enough is enough for every part; clippy's
/// `incompatible_msrv` says the same of what our own code uses.
#[test]
fn no_part_needs_a_newer_compiler_than_we_say() {
    let version = |p: &Value| -> Option<Vec<u64>> {
        p["rust_version"].as_str().map(|v| v.split('.').map(|n| n.parse().unwrap()).collect())
    };
    let packages = packages();
    let ours = version(packages.iter().find(|p| p["name"] == "palpate").unwrap()).unwrap();
    for p in &packages {
        let needed = version(p).unwrap_or_default();
        assert!(needed[..needed.len().min(2)] <= ours[..2], "{} {} needs Rust {needed:?}", p["name"], p["version"]);
    }
}

/// Advisories of RustSec as they were when `fixtures/advisories.tsv` was made: a version with a
/// known vulnerability, or with code that is not sound, is no part of it.
#[test]
fn no_part_has_a_known_flaw() {
    let snapshot = include_str!("../fixtures/advisories.tsv");
    let lines: Vec<Vec<&str>> =
        snapshot.lines().filter(|l| !l.starts_with('#')).map(|l| l.split('\t').collect()).collect();
    assert!(lines.len() > 1000 && lines.iter().all(|l| l.len() == 5));
    let ranges = |text: &str| -> Vec<VersionReq> {
        text.split('|').filter(|r| !r.is_empty()).map(|r| VersionReq::parse(r).unwrap()).collect()
    };
    let flawed = |name: &str, version: &Version| -> Vec<&str> {
        let of = lines.iter().filter(|l| l[0] == name && matches!(l[2], "vulnerability" | "unsound"));
        of.filter(|l| !ranges(l[3]).iter().chain(&ranges(l[4])).any(|r| r.matches(version))).map(|l| l[1]).collect()
    };
    // One that is known to be bad, and what came after it.
    assert_eq!(flawed("smallvec", &Version::new(1, 6, 0)), ["RUSTSEC-2021-0003"]);
    assert!(flawed("smallvec", &Version::new(1, 6, 1)).is_empty());
    for p in packages() {
        let (name, version) = (p["name"].as_str().unwrap(), p["version"].as_str().unwrap());
        let found = flawed(name, &Version::parse(version).unwrap());
        assert!(found.is_empty(), "{name} {version}: {found:?}");
    }
}
