//! Choices by name, with the nearest known name in the error.

use crate::error::UnknownName;

/// The choice called `found`, where `what` says what is chosen (for the message). Case plays no
/// part.
///
/// # Errors
/// [`UnknownName`] lists the known names and suggests the nearest one (at most a third of its
/// letters wrong).
pub fn choose<T: Copy>(what: &'static str, found: &str, known: &[(&'static str, T)]) -> Result<T, UnknownName> {
    let (wanted, long) = (found.to_lowercase(), found.len() > MAX_NAME_BYTES);
    if let Some((_, value)) = known.iter().find(|(name, _)| *name == wanted) {
        return Ok(*value);
    }
    let nearest = known
        .iter()
        .filter(|_| !long)
        .map(|(name, _)| (edit_distance(&wanted, name), *name))
        .min()
        .filter(|(distance, name)| 3 * distance <= name.len().max(4))
        .map(|(_, name)| name);
    Err(UnknownName { what, found: cut(found), known: known.iter().map(|(name, _)| *name).collect(), nearest })
}

/// No name is longer (bytes): of a longer one nothing near is looked for, and messages show its
/// start.
const MAX_NAME_BYTES: usize = 100;

/// The text, or the start of a long one, as a message shows it.
pub fn cut(text: &str) -> String {
    match text.char_indices().nth(MAX_NAME_BYTES) {
        Some((at, _)) => format!("{}...", &text[..at]),
        None => text.into(),
    }
}

/// Insertions, deletions, replacements and swaps of neighbours that turn `a` into `b` (optimal
/// string alignment).
fn edit_distance(a: &str, b: &str) -> usize {
    let (a, b): (Vec<char>, Vec<char>) = (a.chars().collect(), b.chars().collect());
    let mut rows: Vec<Vec<usize>> = vec![(0..=b.len()).collect()];
    for i in 0..a.len() {
        let mut row = vec![i + 1];
        for j in 0..b.len() {
            let replaced = rows[i][j] + usize::from(a[i] != b[j]);
            let swapped = if i > 0 && j > 0 && a[i] == b[j - 1] && a[i - 1] == b[j] {
                rows[i - 1][j - 1] + 1
            } else {
                usize::MAX
            };
            row.push(replaced.min(rows[i][j + 1] + 1).min(row[j] + 1).min(swapped));
        }
        rows.push(row);
    }
    rows[a.len()][b.len()]
}

#[cfg(test)]
mod tests {
    use super::edit_distance;

    #[test]
    fn edits_are_counted() {
        let cases = [("width", "width", 0), ("wdith", "width", 1), ("", "ab", 2), ("mas", "mass", 1), ("abc", "ca", 3)];
        for (a, b, edits) in cases {
            assert_eq!(edit_distance(a, b), edits, "{a} {b}");
            assert_eq!(edit_distance(b, a), edits, "{b} {a}");
        }
    }
}
