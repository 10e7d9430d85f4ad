//! The Slicer Execution Model: what `--xml` says, and a caller that runs commands by it alone.

use crate::fixtures::{palpate, run, small_pair, text};
use roxmltree::{Document, Node};
use std::fs;
use std::process::Command;

const MODULES: [&str; 5] = ["field", "warp", "strain", "stiffness", "track"];
/// Elements that the model's schema has for parameters.
const ELEMENTS: [&str; 10] = [
    "boolean",
    "directory",
    "double",
    "file",
    "image",
    "integer",
    "label",
    "string",
    "string-enumeration",
    "transform",
];

fn child<'a>(node: Node<'a, 'a>, name: &str) -> Option<&'a str> {
    node.children().find(|c| c.has_tag_name(name)).and_then(|c| c.text())
}

fn parameters<'a>(document: &'a Document<'a>) -> Vec<Node<'a, 'a>> {
    let groups = document.root_element().children().filter(|n| n.has_tag_name("parameters"));
    groups.flat_map(|g| g.children().filter(|n| child(*n, "name").is_some())).collect()
}

#[test]
fn each_module_is_described_as_the_schema_asks() {
    let folder = small_pair();
    for module in MODULES {
        let (xml, _) = run(folder.path(), &[module, "--xml"], 0);
        let document = Document::parse(&xml).unwrap();
        let root = document.root_element();
        assert!(root.has_tag_name("executable"));
        for needed in ["category", "title", "description", "version"] {
            assert!(child(root, needed).is_some_and(|t| !t.is_empty()), "{module}: {needed}");
        }
        let (help, _) = run(folder.path(), &[module, "--help"], 0);
        let (mut names, mut places) = (Vec::new(), Vec::new());
        for parameter in parameters(&document) {
            let name = child(parameter, "name").unwrap();
            assert!(ELEMENTS.contains(&parameter.tag_name().name()), "{module}: {name}");
            assert!(
                name.chars().all(|c| c.is_alphanumeric() || c == '_') && !names.contains(&name),
                "{module}: {name}"
            );
            names.push(name);
            for needed in ["label", "description"] {
                assert!(child(parameter, needed).is_some(), "{module}: {name} has no {needed}");
            }
            match (child(parameter, "index"), child(parameter, "longflag")) {
                (Some(index), None) => places.push(index.parse::<usize>().unwrap()),
                (None, Some(flag)) => {
                    let ours = ["--return-", "--filter-progress"].iter().any(|f| flag.starts_with(f));
                    assert!(ours || help.contains(flag), "{module}: {flag}");
                }
                both => panic!("{module}: {name} has {both:?}"),
            }
            let typed = ["image", "file", "directory", "transform"].contains(&parameter.tag_name().name());
            assert_eq!(child(parameter, "channel").is_some(), typed, "{module}: {name}");
        }
        places.sort_unstable();
        assert!(places.iter().copied().eq(0..places.len()), "{module}: {places:?}");
        assert!(names.contains(&"output"), "{module}");
    }
    assert!(run(folder.path(), &["grasp", "--xml"], 2).1.contains("--xml"));
}

/// As 3D Slicer calls a module: a program named for it, every default spelt out, results by flag.
#[cfg(unix)]
#[test]
fn a_caller_runs_a_module_by_its_description_alone() {
    let folder = small_pair();
    let program = folder.path().join("palpate-field");
    std::os::unix::fs::symlink(palpate(folder.path()).get_program(), &program).unwrap();
    let call = |arguments: &[String]| Command::new(&program).args(arguments).current_dir(&folder).output().unwrap();
    let xml = text(&call(&["--xml".into()]).stdout);
    let document = Document::parse(&xml).unwrap();
    let given = [
        ("mask", "mask.nii.gz"),
        ("output", "results"),
        ("preset", "fast"),
        ("return_displacement", "u.nii.gz"),
        ("return_warped", "w.nii.gz"),
    ];
    let (mut flags, mut places) = (Vec::new(), vec![String::new(); 2]);
    for parameter in parameters(&document) {
        let name = child(parameter, "name").unwrap();
        let value = given.iter().find(|g| g.0 == name).map(|g| g.1).or(child(parameter, "default"));
        match (child(parameter, "index"), child(parameter, "longflag"), value) {
            (Some(index), ..) => places[index.parse::<usize>().unwrap()] = format!("{name}.nii.gz"),
            (_, Some(flag), Some("true")) => flags.push(flag.to_string()),
            (_, Some(flag), Some(value)) if value != "false" => flags.extend([flag.into(), value.into()]),
            _ => {}
        }
    }
    flags.extend(places);
    let done = call(&flags);
    assert!(done.status.success(), "{}", text(&done.stderr));
    let out = text(&done.stdout);
    let steps: Vec<f64> = out
        .lines()
        .filter_map(|l| l.strip_prefix("<filter-progress>")?.strip_suffix("</filter-progress>")?.parse().ok())
        .collect();
    assert!(steps.len() > 3 && steps.iter().all(|s| (0.0..=1.0).contains(s)), "{out}");
    for (copy, result) in [("u", "displacement"), ("w", "warped")] {
        let [copy, result] = [format!("{copy}.nii.gz"), format!("results/{result}.nii.gz")];
        assert_eq!(fs::read(folder.path().join(copy)).unwrap(), fs::read(folder.path().join(result)).unwrap());
    }
    // What a caller adds is no part of the record.
    let summary = fs::read_to_string(folder.path().join("results/summary.json")).unwrap();
    assert!(!summary.contains("filter-progress") && !summary.contains("--return-"));

    flags.extend(["--force".into(), "--return-nothing".into(), "n.nii.gz".into()]);
    let lost = call(&flags);
    assert!(!lost.status.success() && text(&lost.stderr).contains("nothing.nii.gz"), "{}", text(&lost.stderr));
    assert_eq!(lost.status.code(), Some(2), "it is refused before any work");
    let (_, err) = run(folder.path(), &["field", "a.nii.gz", "b.nii.gz", "-o", "r", "--return-warped"], 2);
    assert!(err.contains("--return-warped needs a file"), "{err}");
}
