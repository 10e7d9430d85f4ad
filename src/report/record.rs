//! What a run was asked for and has read: at the end of its page, and in its summary.

use crate::report::scale::thousands;
use crate::report::tables::{facts, table};
use crate::types::record::{InputFile, RunRecord};
use maud::html;
use serde_json::Value;

/// Digits of a hash that a page shows.
const HASH_DIGITS: usize = 12;

/// Arguments as a shell takes them.
fn quoted(argument: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=,:+@%".contains(c);
    match !argument.is_empty() && argument.chars().all(plain) {
        true => argument.into(),
        false => format!("'{}'", argument.replace('\'', r"'\''")),
    }
}

/// The command line of a run, with the program's name.
pub fn command_line(record: &RunRecord) -> String {
    let arguments: Vec<String> = record.command_line.iter().map(|a| quoted(a)).collect();
    format!("palpate {}", arguments.join(" "))
}

/// `summary` with the keys of `record` added.
pub(crate) fn in_summary(mut summary: Value, record: &RunRecord) -> Value {
    if let (Value::Object(all), Ok(Value::Object(keys))) = (&mut summary, serde_json::to_value(record)) {
        all.extend(keys);
    }
    summary
}

/// `page` with the run at its end, above the footer.
pub(crate) fn on_page(mut page: String, record: &RunRecord) -> String {
    let rows = [
        ("Command line", command_line(record)),
        ("Run from", record.working_folder.clone()),
        ("Version", format!("palpate {}", env!("CARGO_PKG_VERSION"))),
        ("Date", record.date.clone()),
    ];
    let file = |f: &InputFile| {
        let digits = f.sha256.get(..HASH_DIGITS).unwrap_or(&f.sha256);
        [f.role.clone(), f.path.clone(), thousands(f.bytes as usize), digits.into()]
    };
    let section = html! {
        section {
            h2 { "The run" }
            article.wide.words {
                (facts(rows))
                @if !record.files.is_empty() {
                    (table(&["Input", "File", "Bytes", "SHA-256"], record.files.iter().map(file)))
                }
            }
        }
    };
    let end = page.rfind("<footer>").or_else(|| page.rfind("</main>")).unwrap_or(page.len());
    page.insert_str(end, &section.into_string());
    page
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_ends_with_the_run_and_quotes_what_a_shell_would_split() {
        let file = InputFile {
            role: "mask".into(),
            path: "/data/a <b>.nii".into(),
            bytes: 1234,
            sha256: "0123456789abcdef".into(),
        };
        let record = RunRecord {
            command_line: ["field", "a b.nii", "it's", "--mask=m.nii"].map(String::from).to_vec(),
            working_folder: "/data".into(),
            date: "2026-02-28T09:05:07Z".into(),
            files: vec![file],
        };
        assert_eq!(command_line(&record), r"palpate field 'a b.nii' 'it'\''s' --mask=m.nii");
        let page = on_page("<main><footer>x</footer></main>".into(), &record);
        for part in ["/data/a &lt;b&gt;.nii", "1,234", "<td>0123456789ab</td>", "2026-02-28T09:05:07Z"] {
            assert!(page.contains(part), "{part} is missing in {page}");
        }
        assert!(page.ends_with("</section><footer>x</footer></main>"), "{page}");
        let summary = in_summary(serde_json::json!({ "version": "1" }), &record);
        assert_eq!(summary["files"][0]["sha256"], "0123456789abcdef");
        assert_eq!((&summary["version"], &summary["command_line"][0]), (&"1".into(), &"field".into()));
    }
}
