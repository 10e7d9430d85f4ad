//! Putting text into a file without changing what is there.

use roxmltree::Node;
use std::ops::Range;

/// A part of a file and what stands in its place.
#[derive(Debug)]
pub(super) struct Edit {
    pub(super) at: Range<usize>,
    pub(super) text: String,
}

impl Edit {
    /// Puts `text` before the byte `at`.
    pub(super) fn insert(at: usize, text: String) -> Self {
        Self { at: at..at, text }
    }

    /// Puts `text` at the end of what an XML element holds.
    pub(super) fn into(source: &str, node: Node<'_, '_>, text: &str) -> Self {
        let range = node.range();
        let own = &source[range.clone()];
        let name = node.tag_name().name();
        match own.strip_suffix("/>") {
            Some(open) => Self { at: range.start + open.len()..range.end, text: format!(">\n{text}</{name}>") },
            None => {
                let inside = &own[..own.rfind("</").unwrap_or(own.len())];
                // A closing tag on a line of its own keeps its indentation.
                let indented = inside.trim_end_matches([' ', '\t']);
                let end = if indented.ends_with('\n') { indented.len() } else { inside.len() };
                Self::insert(range.start + end, text.into())
            }
        }
    }
}

/// The bytes with all edits made.
pub(super) fn apply(bytes: &[u8], mut edits: Vec<Edit>) -> Vec<u8> {
    edits.sort_by_key(|e| e.at.start);
    let mut out = Vec::with_capacity(bytes.len() + edits.iter().map(|e| e.text.len()).sum::<usize>());
    let mut from = 0;
    for Edit { at, text } in edits {
        out.extend_from_slice(&bytes[from..at.start]);
        out.extend_from_slice(text.as_bytes());
        from = at.end;
    }
    out.extend_from_slice(&bytes[from..]);
    out
}
