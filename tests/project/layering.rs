//! Holds the layer table of CONTRIBUTING.md: who may import whom, who opens files, who prints.

use std::fs;
use std::path::{Path, PathBuf};

/// What all but the data types build on.
const BASE: [&str; 3] = ["types", "error", "numerics"];

/// The steps of the work; none knows another.
const STAGES: [&str; 13] = [
    "features",
    "matching",
    "consistency",
    "mesh",
    "field",
    "transforms",
    "strain",
    "stiffness",
    "fingertip",
    "grasp",
    "skin",
    "synth",
    "evaluate",
];

/// What each part of `src` may import of this crate. `pipeline` and `cli` may import every stage.
fn allowed(part: &str) -> Vec<&'static str> {
    match part {
        "error" => vec![],
        "types" | "report" => vec!["types", "error"],
        "numerics" | "io" => BASE.to_vec(),
        "pipeline" => [&BASE[..], &STAGES].concat(),
        "cli" | "main" | "python" => [&BASE[..], &STAGES, &["io", "report", "pipeline", "cli"]].concat(),
        stage if STAGES.contains(&stage) => BASE.to_vec(),
        _ => panic!("src/{part} is not in the layer table"),
    }
}

/// The code without comments, text and character literals.
fn code_only(source: &str) -> String {
    let c: Vec<char> = source.chars().collect();
    let (mut out, mut i) = (String::new(), 0);
    let starts = |i: usize, s: &str| s.chars().enumerate().all(|(k, x)| c.get(i + k) == Some(&x));
    while i < c.len() {
        let word_before = i > 0 && (c[i - 1].is_alphanumeric() || c[i - 1] == '_');
        let hashes = c[i..].iter().skip(1).take_while(|x| **x == '#').count();
        if starts(i, "//") {
            i += c[i..].iter().position(|x| *x == '\n').unwrap_or(c.len() - i);
        } else if starts(i, "/*") {
            let mut depth = 0;
            loop {
                depth += i32::from(starts(i, "/*")) - i32::from(starts(i, "*/"));
                i += if starts(i, "/*") || starts(i, "*/") { 2 } else { 1 };
                if depth == 0 || i >= c.len() {
                    break;
                }
            }
        } else if c[i] == 'r' && !word_before && c.get(i + 1 + hashes) == Some(&'"') {
            let end = format!("\"{}", "#".repeat(hashes));
            i += 2 + hashes;
            while i < c.len() && !starts(i, &end) {
                i += 1;
            }
            i += 1 + hashes;
            out.push(' ');
        } else if c[i] == '"' {
            i += 1;
            while i < c.len() && c[i] != '"' {
                i += 1 + usize::from(c[i] == '\\');
            }
            i += 1;
            out.push(' ');
        } else if c[i] == '\'' && (c.get(i + 1) == Some(&'\\') || c.get(i + 2) == Some(&'\'')) {
            i += 2 + usize::from(c[i + 1] == '\\');
            while i < c.len() && c[i] != '\'' {
                i += 1;
            }
            i += 1;
            out.push(' ');
        } else {
            out.push(c[i]);
            i += 1;
        }
    }
    out
}

/// `code` (see [`code_only`]) without items under `#[cfg(test)]`.
fn without_tests(code: &str) -> String {
    let (mut out, mut rest) = (String::new(), code);
    while let Some(at) = rest.find("#[cfg(test)]") {
        out.push_str(&rest[..at]);
        let item = &rest[at..];
        let open = item.find('{').unwrap_or(item.len());
        let end = match item.find(';') {
            Some(semicolon) if semicolon < open => semicolon + 1,
            _ => {
                let mut depth = 0;
                let close = item.char_indices().skip_while(|(i, _)| *i < open).find(|(_, x)| {
                    depth += i32::from(*x == '{') - i32::from(*x == '}');
                    depth == 0
                });
                close.map_or(item.len(), |(i, _)| i + 1)
            }
        };
        rest = &item[end..];
    }
    out + rest
}

/// Modules of this crate that `code` names: `crate::x`, `crate::{x::y, z}`, the same with
/// `palpate::`.
fn imports(code: &str) -> Vec<String> {
    let word = |s: &str| s.chars().take_while(|x| x.is_alphanumeric() || *x == '_').collect::<String>();
    let mut found = Vec::new();
    for root in ["crate::", "palpate::"] {
        for (at, _) in code.match_indices(root) {
            if code[..at].ends_with(|x: char| x.is_alphanumeric() || x == '_') {
                continue;
            }
            let rest = code[at + root.len()..].trim_start();
            let Some(group) = rest.strip_prefix('{') else {
                found.push(word(rest));
                continue;
            };
            let (mut depth, mut start) = (0, 0);
            for (i, x) in group.char_indices() {
                match x {
                    '{' => depth += 1,
                    '}' if depth > 0 => depth -= 1,
                    ',' | '}' if depth == 0 => {
                        found.push(word(group[start..i].trim_start()));
                        start = i + 1;
                        if x == '}' {
                            break;
                        }
                    }
                    _ => {}
                }
            }
        }
    }
    found.retain(|f| !f.is_empty());
    found
}

/// Whether `name` stands in `code` as a whole word (`name` may end in `!` or `::`).
fn names(code: &str, name: &str) -> bool {
    let joins = |x: char| x.is_alphanumeric() || x == '_';
    code.match_indices(name).any(|(at, _)| {
        let after = code[at + name.len()..].chars().next();
        !code[..at].ends_with(joins) && (name.ends_with(['!', ':']) || !after.is_some_and(joins))
    })
}

/// What is wrong with one file of the part `part`.
fn violations(part: &str, source: &str) -> Vec<String> {
    let code = without_tests(&code_only(source));
    let mut wrong = Vec::new();
    for import in imports(&code) {
        if import != part && !allowed(part).contains(&import.as_str()) {
            wrong.push(format!("{part} imports {import}"));
        }
    }
    if code.contains("super::super") {
        wrong.push(format!("{part} climbs with super::super; write crate:: so that the import can be checked"));
    }
    if part != "io" {
        for name in ["std::fs", "fs::", "File::", "OpenOptions", "tempfile"] {
            if names(&code, name) {
                wrong.push(format!("{part} opens files ({name})"));
            }
        }
    }
    if !matches!(part, "cli" | "main") {
        for name in ["println!", "eprintln!", "print!", "eprint!", "dbg!", "stdout", "stderr", "std::process"] {
            if names(&code, name) {
                wrong.push(format!("{part} prints or ends the program ({name})"));
            }
        }
    }
    wrong
}

/// What is done in one place for all: files are opened to read where pipes are refused, and names
/// of others shown where what would steer a terminal is escaped.
fn elsewhere(inside: &str, source: &str) -> Vec<String> {
    let code = without_tests(&code_only(source));
    // Locks, a file that is being written, and what the system tells of itself.
    let opens = ["io/source.rs", "io/temporary_files.rs", "io/nifti/write.rs", "io/memory.rs"].contains(&inside);
    let reads = ["File::open", "fs::read", "read_to_string"].into_iter().filter(|name| !opens && names(&code, name));
    let mut wrong: Vec<String> = reads.map(|name| format!("{name} outside io/source.rs")).collect();
    if code.contains(".display()") {
        wrong.push("display() of a name, not shown()".into());
    }
    wrong
}

/// Every `.rs` file below `folder`.
fn sources(folder: &Path) -> Vec<PathBuf> {
    let mut out = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            out.extend(sources(&path));
        } else if path.extension().is_some_and(|e| e == "rs") {
            out.push(path);
        }
    }
    out.sort();
    out
}

#[test]
fn every_file_keeps_to_its_layer() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut wrong = Vec::new();
    let mut seen = 0;
    for path in sources(&root) {
        let inside = path.strip_prefix(&root).unwrap();
        let part = inside.iter().next().unwrap().to_str().unwrap().trim_end_matches(".rs");
        if part == "lib" {
            continue;
        }
        seen += 1;
        let source = fs::read_to_string(&path).unwrap();
        let all = violations(part, &source).into_iter().chain(elsewhere(&inside.to_string_lossy(), &source));
        wrong.extend(all.map(|v| format!("{}: {v}", inside.display())));
    }
    assert!(seen > 20, "only {seen} files found");
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn the_checker_sees_what_is_forbidden() {
    let bad = [
        ("matching", "use crate::features::harris;", "imports features"),
        ("report", "use crate::{types::Volume, numerics::filters, error::{A, B}};", "imports numerics"),
        ("field", "fn f() { crate::mesh::delaunay::run(); }", "imports mesh"),
        ("types", "use palpate::numerics::x;", "imports numerics"),
        ("mesh", "use super::super::features::x;", "super::super"),
        ("field", "use std::fs;", "opens files"),
        ("cli", "let f = std::fs::File::open(p)?;", "opens files"),
        ("synth", "fn f() { println!(\"x\"); }", "prints"),
        ("pipeline", "use crate::io;", "imports io"),
        ("pipeline", "use crate::cli::x;", "imports cli"),
        ("pipeline", "use crate::python::x;", "imports python"),
        ("features", "#[cfg(test)]\nmod tests { fn f() {} }\nfn g() { eprintln!() }", "prints"),
    ];
    for (part, source, what) in bad {
        let found = violations(part, source);
        assert!(found.iter().any(|v| v.contains(what)), "{source}: {found:?}");
    }
}

#[test]
fn the_checker_sees_what_belongs_in_one_place() {
    for bad in ["let f = File::open(p)?;", "let t = fs::read_to_string(p)?;", "format!(\"{}\", p.display())"] {
        assert_eq!(elsewhere("io/csv.rs", bad).len(), 1, "{bad}");
    }
    assert!(elsewhere("io/source.rs", "File::open(p)").is_empty() && elsewhere("io/csv.rs", "p.shown()").is_empty());
}

#[test]
fn the_checker_lets_pass_what_is_allowed() {
    let good = [
        ("matching", "use crate::{numerics::filters, types::{Match, Volume}};"),
        ("field", "// use crate::mesh::x;\nconst A: &str = \"println! crate::mesh::x \\\" std::fs\";"),
        ("field", "#[cfg(test)]\nmod tests { use crate::mesh::x; fn f() { let c = '}'; println!() } }"),
        ("io", "use std::fs::File; use crate::error::IoError;"),
        ("report", "fn f(picture: r#\"crate::io::x\"#) -> sprint!()"),
        ("mesh", "use crate::mesh::predicates; fn f<'a>(x: &'a str) {}"),
        ("main", "fn main() { palpate::cli::run(words, own) }"),
    ];
    for (part, source) in good {
        assert_eq!(violations(part, source), Vec::<String>::new(), "{source}");
    }
}

/// A file that moves takes its name in the documents along.
#[test]
fn documents_name_source_files_that_exist() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut pages = vec![root.join("README.md"), root.join("CONTRIBUTING.md")];
    for shelf in ["tutorials", "how-to", "reference", "explanation"] {
        pages.extend(fs::read_dir(root.join("docs").join(shelf)).unwrap().map(|e| e.unwrap().path()));
    }
    let names: Vec<String> = sources(&root.join("src")).iter().map(|p| p.to_string_lossy().into_owned()).collect();
    let mut checked = 0;
    for page in pages.iter().filter(|p| p.extension().is_some_and(|e| e == "md")) {
        let text = fs::read_to_string(page).unwrap();
        for named in
            text.split('`').skip(1).step_by(2).filter(|n| n.ends_with(".rs") && !n.contains(char::is_whitespace))
        {
            let inside = named.strip_prefix("src/").unwrap_or(named);
            let is_one = |f: &String| f.ends_with(&format!("/{inside}"));
            let elsewhere = ["tests", "benches", "examples", ""].iter().any(|d| root.join(d).join(named).exists());
            assert!(names.iter().any(is_one) || elsewhere || named.contains("NAME"), "{}: {named}", page.display());
            checked += 1;
        }
    }
    assert!(checked > 100, "{checked}");
}
