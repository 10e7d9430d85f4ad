//! Choices by name, with the nearest known name in the error.

use crate::error::UnknownName;

/// The choice called `found`, where `what` says what is chosen (for the message). Case plays no part.
///
/// # Errors
/// [`UnknownName`] lists the known names and suggests the nearest one (at most a third of its letters wrong).
pub fn choose<T: Copy>(what: &'static str, found: &str, known: &[(&'static str, T)]) -> Result<T, UnknownName> {
    let wanted = found.to_lowercase();
    if let Some((_, value)) = known.iter().find(|(name, _)| *name == wanted) {
        return Ok(*value);
    }
    let nearest = known
        .iter()
        .map(|(name, _)| (edit_distance(&wanted, name), *name))
        .min()
        .filter(|(distance, name)| 3 * distance <= name.len().max(4))
        .map(|(_, name)| name);
    Err(UnknownName { what, found: found.into(), known: known.iter().map(|(name, _)| *name).collect(), nearest })
}

/// Insertions, deletions and replacements that turn `a` into `b` (Levenshtein).
fn edit_distance(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, ca) in a.chars().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, cb) in b.iter().enumerate() {
            let replaced = diagonal + usize::from(ca != *cb);
            diagonal = row[j + 1];
            row[j + 1] = replaced.min(diagonal + 1).min(row[j] + 1);
        }
    }
    row[b.len()]
}
