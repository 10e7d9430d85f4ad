//! The page of the whole chain: one table of errors, then each part's own page.

use crate::report::html::{document, header};
use crate::report::tables::table;
use maud::{PreEscaped, html};
use serde::Serialize;

/// A quantity of one stage with its truth.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// The stage: field, stiffness, fingertip or grasp.
    pub stage: &'static str,
    /// What is compared.
    pub quantity: String,
    /// Its unit.
    pub unit: &'static str,
    /// What was found.
    pub found: f64,
    /// The truth; for an error, that before registration.
    pub truth: f64,
    /// Found over truth less 1 for a value; the error itself for an error.
    pub error: f64,
    /// `lower` or `upper` where `found` is only a bound.
    pub bound: Option<String>,
    /// Whether it is an error, 0 at best, and not a value.
    #[serde(skip)]
    is_error: bool,
}

impl Row {
    /// A value with its truth.
    pub fn value(stage: &'static str, quantity: &str, unit: &'static str, found: f64, truth: f64) -> Self {
        Self {
            stage,
            quantity: quantity.into(),
            unit,
            found,
            truth,
            error: found / truth - 1.0,
            bound: None,
            is_error: false,
        }
    }

    /// The same where it is only a bound, if it is one.
    pub fn bounded(self, bound: Option<String>) -> Self {
        Self { bound, ..self }
    }

    /// An error, 0 at best, with that before registration.
    pub fn error(stage: &'static str, quantity: &str, unit: &'static str, found: f64, nothing: f64) -> Self {
        Self {
            stage,
            quantity: quantity.into(),
            unit,
            found,
            truth: nothing,
            error: found,
            bound: None,
            is_error: true,
        }
    }

    /// The cells of a table.
    fn cells(&self) -> Vec<String> {
        let found = match self.bound.as_deref() {
            Some("lower") => format!("above {}", short(self.found)),
            Some(_) => format!("below {}", short(self.found)),
            None => short(self.found),
        };
        let truth =
            if self.is_error { format!("0 (before registration {})", short(self.truth)) } else { short(self.truth) };
        let error = match (&self.bound, self.is_error) {
            (Some(_), _) => "a bound".into(),
            (None, true) => format!("{} {}", short(self.error), self.unit),
            (None, false) => format!("{:+.1} %", 100.0 * self.error),
        };
        vec![self.stage.into(), self.quantity.clone(), self.unit.into(), found, truth, error]
    }
}

fn short(v: f64) -> String {
    match v.abs() {
        a if a >= 100.0 => format!("{v:.0}"),
        a if a >= 1.0 => format!("{v:.2}"),
        _ => format!("{v:.4}"),
    }
}

/// A part of the chain: its page or picture.
#[derive(Debug, Clone)]
pub struct Part {
    /// Its name.
    pub title: &'static str,
    /// Where it lies, from the page.
    pub file: &'static str,
    /// What the file holds, HTML or SVG.
    pub content: String,
}

const HEAD: [&str; 6] = ["Stage", "Quantity", "Unit", "Found", "Truth", "Error"];

/// The table as text.
pub fn text(rows: &[Row]) -> String {
    let all: Vec<Vec<String>> =
        std::iter::once(HEAD.map(String::from).to_vec()).chain(rows.iter().map(Row::cells)).collect();
    let width: Vec<usize> =
        (0..HEAD.len()).map(|c| all.iter().map(|r| r[c].chars().count()).max().unwrap_or(0)).collect();
    let line = |r: &Vec<String>| {
        let cells: Vec<String> = r.iter().zip(&width).map(|(c, &w)| format!("{c:w$}")).collect();
        format!("  {}\n", cells.join("  ").trim_end())
    };
    all.iter().map(line).collect()
}

/// Makes the frame of a part as tall as what is in it.
const GROW: &str = "new ResizeObserver(()=>this.style.height=this.contentDocument.documentElement.offsetHeight+9+'px')\
                    .observe(this.contentDocument.documentElement)";

/// The page under a title, with what it is about; parts are embedded whole, so it needs no other
/// file.
pub fn page(title: &str, about: &str, rows: &[Row], parts: &[Part]) -> String {
    let body = html! {
        (header(title, about, ""))
        section {
            h2 { "Errors" }
            div.grid { article.wide { (table(&HEAD, rows.iter().map(Row::cells))) } }
        }
        @for Part { title, file, content } in parts {
            section {
                h2 { (title) }
                @if file.ends_with(".svg") {
                    article.wide { (PreEscaped(content)) }
                } @else {
                    iframe title=(title) style="width:100%;height:46rem;border:1px solid #8884;border-radius:8px"
                        onload=(GROW) srcdoc=(content) {}
                }
                p { small { (file) } }
            }
        }
    };
    document(title, &body)
}
