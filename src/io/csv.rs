//! Tables of matches, landmarks and points: comma-separated, one header line, world mm RAS.
//!
//! Columns are found by name, in any order and case. Every error names the file and the line.

use super::atomic::write_atomic;
use super::format_error::Flaw;
use super::{format, markups, os, source};
use crate::error::IoError;
use crate::error::Shown;
use crate::types::{Landmark, Match, RawMatch, SparseField, WorldPoint};
use csv::{Reader, ReaderBuilder, StringRecord, Trim, Writer};
use std::io::Cursor;
use std::path::Path;

const MATCH_COLUMNS: [&str; 9] = ["x", "y", "z", "dx", "dy", "dz", "ncc", "sigma", "kept"];
/// What matching alone measured: displacement (mm, RAS) and its sigma (mm).
const RAW_COLUMNS: [&str; 4] = ["raw_dx", "raw_dy", "raw_dz", "raw_sigma"];
const LANDMARK_COLUMNS: [&str; 6] = ["fx", "fy", "fz", "mx", "my", "mz"];
const POINT_COLUMNS: [&str; 3] = ["x", "y", "z"];

/// Points with the table's other columns, which are carried along as text.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PointTable {
    /// World mm, RAS.
    pub points: Vec<WorldPoint>,
    /// Names of the columns other than x, y, z.
    pub other_columns: Vec<String>,
    /// Their text, a row for each point.
    pub others: Vec<Vec<String>>,
}

/// What a table of places holds, by its columns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum TableKind {
    /// As [`write_matches`].
    Matches,
    /// As [`write_landmarks`].
    Landmarks,
    /// As [`write_points`], or of 3D Slicer.
    Points,
}

/// Looks at the header line of a table, or the name of a file of 3D Slicer.
///
/// # Errors
/// [`IoError`] when the file cannot be read or has none of the known columns.
pub(crate) fn table_kind(path: impl AsRef<Path>) -> Result<TableKind, IoError> {
    let path = path.as_ref();
    if markups::is_slicer(path) {
        return Ok(TableKind::Points);
    }
    let mut reader = reader_of(source::head(path, 1 << 16)?);
    let header = reader.headers().map_err(|e| damaged(path, e))?.clone();
    let has = |names: &[&str]| names.iter().all(|n| header.iter().any(|h| h.eq_ignore_ascii_case(n)));
    match (has(&MATCH_COLUMNS), has(&LANDMARK_COLUMNS), has(&POINT_COLUMNS)) {
        (true, ..) => Ok(TableKind::Matches),
        (_, true, _) => Ok(TableKind::Landmarks),
        (.., true) => Ok(TableKind::Points),
        _ => Err(format(
            path,
            "is no table of matches, landmarks or points",
            "see docs/reference/file-formats.md for the columns",
        )),
    }
}

/// Writes x,y,z,dx,dy,dz (mm), ncc, sigma (mm), kept (1 or 0) and what matching alone measured
/// (raw_dx, raw_dy, raw_dz, raw_sigma; mm), all matches in order, with six decimals.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
///
/// ```
/// use palpate::{Match, SparseField, WorldPoint, io};
/// let folder = tempfile::tempdir()?;
/// let path = folder.path().join("matches.csv");
/// let m = Match {
///     initial: WorldPoint([1.0, 2.0, 3.0]),
///     displacement: [0.5, 0.0, -0.25],
///     ncc: 0.75,
///     covariance: [0.25, 0.25, 0.25, 0.0, 0.0, 0.0],
///     kept: true,
///     raw: None,
/// };
/// let field = SparseField { matches: vec![m] };
/// io::write_matches(&path, &field)?;
/// assert_eq!(io::read_matches(&path)?, field);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn write_matches(path: impl AsRef<Path>, field: &SparseField) -> Result<(), IoError> {
    let rows = field.matches.iter().map(|m| {
        let numbers = [&m.initial.0[..], &m.displacement, &[f64::from(m.ncc), m.sigma()]].concat();
        let mut row: Vec<String> = numbers.into_iter().map(decimal).collect();
        row.push(u8::from(m.kept).to_string());
        let raw = m.raw.unwrap_or(RawMatch { displacement: m.displacement, sigma: m.sigma() });
        row.extend(raw.displacement.into_iter().chain([raw.sigma]).map(decimal));
        row
    });
    let columns = [&MATCH_COLUMNS[..], &RAW_COLUMNS].concat();
    write_table(path.as_ref(), &columns, rows)
}

/// Reads the estimate that [`write_matches`] writes; the covariance becomes sigma squared along
/// each axis.
///
/// # Errors
/// [`IoError`] when the file cannot be read, a column is missing, a value is not a finite number or
/// kept neither 0 nor 1.
pub fn read_matches(path: impl AsRef<Path>) -> Result<SparseField, IoError> {
    let path = path.as_ref();
    let matches = read_table(path, MATCH_COLUMNS)?.numbers;
    if let Some(row) = matches.iter().position(|m| m[8] != 0.0 && m[8] != 1.0) {
        let what = format!("kept is {} in match {}, neither 0 nor 1", matches[row][8], row + 1);
        return Err(format(path, what, "1 is for a match to be used, 0 for one cast out"));
    }
    let matches = matches.into_iter().map(|[x, y, z, dx, dy, dz, ncc, sigma, kept]| Match {
        initial: WorldPoint([x, y, z]),
        displacement: [dx, dy, dz],
        ncc: ncc as f32,
        covariance: [sigma * sigma, sigma * sigma, sigma * sigma, 0.0, 0.0, 0.0],
        kept: kept != 0.0,
        raw: None,
    });
    Ok(SparseField { matches: matches.collect() })
}

/// What [`read_matches`] would read after [`write_matches`]: six decimals, one precision along all
/// axes.
pub fn stored_matches(field: &SparseField) -> SparseField {
    let kept = |v: f64| decimal(v).parse().unwrap_or(v);
    let one = |m: &Match| {
        let sigma = kept(m.sigma());
        Match {
            initial: WorldPoint(m.initial.0.map(kept)),
            displacement: m.displacement.map(kept),
            ncc: kept(f64::from(m.ncc)) as f32,
            covariance: [sigma * sigma, sigma * sigma, sigma * sigma, 0.0, 0.0, 0.0],
            kept: m.kept,
            raw: None,
        }
    };
    SparseField { matches: field.matches.iter().map(one).collect() }
}

/// Reads landmarks: fx,fy,fz in the initial (fixed) volume, mx,my,mz in the deformed (moving) one.
///
/// # Errors
/// As [`read_matches`]; also when there is no row.
pub fn read_landmarks(path: impl AsRef<Path>) -> Result<Vec<Landmark>, IoError> {
    let rows = read_table(path.as_ref(), LANDMARK_COLUMNS)?.numbers;
    some_rows(path.as_ref(), rows.len())?;
    let landmark =
        |[a, b, c, d, e, f]: [f64; 6]| Landmark { initial: WorldPoint([a, b, c]), deformed: WorldPoint([d, e, f]) };
    Ok(rows.into_iter().map(landmark).collect())
}

/// The frame that each landmark of a sequence belongs to, in the order of the rows: the column
/// `frame` beside those of [`read_landmarks`], counted from 0.
///
/// # Errors
/// As [`read_landmarks`]; also when a frame is no whole number.
///
/// ```
/// use palpate::io;
/// let folder = tempfile::tempdir()?;
/// let path = folder.path().join("landmarks.csv");
/// std::fs::write(&path, "frame,fx,fy,fz,mx,my,mz\n1,0,0,0,1,0,0\n2,0,0,0,2,0,0\n")?;
/// assert_eq!(io::read_landmark_frames(&path)?, [1, 2]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn read_landmark_frames(path: impl AsRef<Path>) -> Result<Vec<usize>, IoError> {
    let rows = read_table(path.as_ref(), ["frame"])?.numbers;
    some_rows(path.as_ref(), rows.len())?;
    let frame = |(row, &[frame]): (usize, &[f64; 1])| {
        let is_whole = frame.fract() == 0.0 && (0.0..=f64::from(u32::MAX)).contains(&frame);
        is_whole.then_some(frame as usize).ok_or_else(|| {
            let what = format!("row {}: frame is {frame}, not a whole number from 0 on", row + 1);
            format(path.as_ref(), what, "give the number of the frame, counted from 0")
        })
    };
    rows.iter().enumerate().map(frame).collect()
}

/// Landmarks from two files of points: the places in the initial volume and in the deformed one,
/// paired by their labels where both files have all of them, else in order.
///
/// # Errors
/// As [`read_points`]; also when there are not as many in both.
pub fn read_landmark_pair(initial: impl AsRef<Path>, deformed: impl AsRef<Path>) -> Result<Vec<Landmark>, IoError> {
    let (a, b) = (read_points(initial.as_ref())?, read_points(deformed.as_ref())?);
    if a.points.len() != b.points.len() {
        let what = format!("has {} points, {} has {}", b.points.len(), initial.as_ref().shown(), a.points.len());
        return Err(format(deformed.as_ref(), what, "give the same landmarks in both, in the same order"));
    }
    let labels = |t: &PointTable| {
        let column = t.other_columns.iter().position(|c| c.eq_ignore_ascii_case("label"));
        let names = column.map(|c| t.others.iter().map(|row| row[c].clone()).collect::<Vec<_>>());
        let unique = |n: &Vec<String>| n.iter().collect::<std::collections::BTreeSet<_>>().len() == n.len();
        names.filter(unique)
    };
    let order: Option<Vec<usize>> = labels(&a)
        .zip(labels(&b))
        .and_then(|(first, second)| first.iter().map(|name| second.iter().position(|other| other == name)).collect());
    let order = order.unwrap_or_else(|| (0..a.points.len()).collect());
    let pair = |(&initial, at): (&WorldPoint, usize)| Landmark { initial, deformed: b.points[at] };
    Ok(a.points.iter().zip(order).map(pair).collect())
}

/// Writes what [`read_landmarks`] reads.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
///
/// ```
/// use palpate::{Landmark, WorldPoint, io};
/// let folder = tempfile::tempdir()?;
/// let path = folder.path().join("landmarks.csv");
/// let marks =
///     [Landmark { initial: WorldPoint([1.0, 2.0, 3.0]), deformed: WorldPoint([1.5, 2.0, 3.0]) }];
/// io::write_landmarks(&path, &marks)?;
/// assert_eq!(io::read_landmarks(&path)?, marks);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn write_landmarks(path: impl AsRef<Path>, landmarks: &[Landmark]) -> Result<(), IoError> {
    let rows = landmarks.iter().map(|l| [l.initial.0, l.deformed.0].concat().into_iter().map(decimal).collect());
    write_table(path.as_ref(), &LANDMARK_COLUMNS, rows)
}

/// Reads points: columns x,y,z and any others; from 3D Slicer's `.mrk.json` and `.fcsv` with one
/// column `label`.
///
/// # Errors
/// As [`read_landmarks`].
///
/// ```
/// use palpate::{WorldPoint, io};
/// let folder = tempfile::tempdir()?;
/// let path = folder.path().join("points.csv");
/// std::fs::write(&path, "x,y,z,name\n1,2,3,apex\n")?;
/// let table = io::read_points(&path)?;
/// assert_eq!(table.points, [WorldPoint([1.0, 2.0, 3.0])]);
/// assert_eq!(table.others[0], ["apex"]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn read_points(path: impl AsRef<Path>) -> Result<PointTable, IoError> {
    if markups::is_slicer(path.as_ref()) {
        return markups::read(path.as_ref());
    }
    let table = read_table(path.as_ref(), POINT_COLUMNS)?;
    some_rows(path.as_ref(), table.numbers.len())?;
    let points = table.numbers.into_iter().map(WorldPoint).collect();
    Ok(PointTable { points, other_columns: table.other_columns, others: table.others })
}

/// Writes x,y,z and the other columns; with a name in `.mrk.json` a point list of Slicer, without
/// the points that are not finite.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub fn write_points(path: impl AsRef<Path>, table: &PointTable) -> Result<(), IoError> {
    if markups::is_slicer(path.as_ref()) {
        let column = table.other_columns.iter().position(|c| c.eq_ignore_ascii_case("label"));
        let labels: Vec<String> =
            column.map_or(Vec::new(), |c| table.others.iter().map(|row| row[c].clone()).collect());
        let there: Vec<usize> =
            (0..table.points.len()).filter(|&i| table.points[i].0.iter().all(|v| v.is_finite())).collect();
        let points: Vec<WorldPoint> = there.iter().map(|&i| table.points[i]).collect();
        let labels: Vec<String> = there.iter().filter_map(|&i| labels.get(i).cloned()).collect();
        return markups::write_markups(path, &points, &labels, &[]);
    }
    let columns: Vec<&str> = POINT_COLUMNS.into_iter().chain(table.other_columns.iter().map(String::as_str)).collect();
    let rows = table.points.iter().enumerate().map(|(i, p)| {
        let others = table.others.get(i).into_iter().flatten().cloned();
        let mut row: Vec<String> = p.0.into_iter().map(decimal).chain(others).collect();
        row.resize(columns.len(), String::new());
        row
    });
    write_table(path.as_ref(), &columns, rows)
}

pub(super) fn decimal(v: f64) -> String {
    format!("{v:.6}")
}

fn some_rows(path: &Path, rows: usize) -> Result<(), IoError> {
    match rows {
        0 => Err(format(path, "there is no row after the header line", "give at least one point")),
        _ => Ok(()),
    }
}

pub(super) fn write_table(
    path: &Path,
    columns: &[&str],
    rows: impl Iterator<Item = Vec<String>>,
) -> Result<(), IoError> {
    write_atomic(path, |w| {
        let mut table = Writer::from_writer(w);
        table.write_record(columns)?;
        rows.into_iter().try_for_each(|row| table.write_record(row))?;
        table.flush()
    })
}

pub(super) struct Table<const N: usize> {
    pub(super) numbers: Vec<[f64; N]>,
    pub(super) other_columns: Vec<String>,
    pub(super) others: Vec<Vec<String>>,
}

fn reader_of(bytes: Vec<u8>) -> Reader<Cursor<Vec<u8>>> {
    ReaderBuilder::new().trim(Trim::All).from_reader(Cursor::new(bytes))
}

/// No table has more columns.
const MAX_COLUMNS: usize = 1000;

/// The header line of a table, and the reader of the lines after it.
pub(super) fn open_table(path: &Path) -> Result<(StringRecord, Reader<Cursor<Vec<u8>>>), IoError> {
    let bytes = source::bytes(path, source::MAX_TEXT_BYTES)?;
    check_quotes(&bytes).map_err(|flaw| flaw.at(path))?;
    let mut reader = reader_of(bytes);
    let header = reader.headers().map_err(|e| damaged(path, e))?.clone();
    Ok((header, reader))
}

/// Refuses quotes that could make one cell of the rest of a table (RFC 4180, 2.5 to 2.7): one that
/// is not closed, and text after a closed one. Also a first line that is no header.
fn check_quotes(bytes: &[u8]) -> Result<(), Flaw> {
    let (mut line, mut opened, mut columns) = (1, None, Some(1));
    let mut at = if bytes.starts_with(b"\xef\xbb\xbf") { 3 } else { 0 };
    let mut start = true;
    while let Some(&b) = bytes.get(at) {
        line += usize::from(b == b'\n');
        match (opened, b) {
            (Some(_), b'"') if bytes.get(at + 1) == Some(&b'"') => at += 1,
            (Some(from), b'"') => {
                opened = None;
                if !matches!(bytes.get(at + 1), None | Some(b',' | b'\r' | b'\n')) {
                    let what = format!("line {line}: text follows the quote that closes what line {from} opened");
                    return Err(Flaw::new(what, "put a comma after it, or write a quote in a cell twice"));
                }
            }
            (Some(_), _) => {}
            (None, b'"') if start => opened = Some(line),
            (None, b',') => {
                columns = columns.map(|n| n + 1);
                if columns.is_some_and(|n| n > MAX_COLUMNS) {
                    let what = format!("line 1: has more than {MAX_COLUMNS} columns");
                    return Err(Flaw::new(what, "the first line must name the columns; check which file it is"));
                }
            }
            (None, b'\n' | b'\r') if !start || columns.is_some_and(|n| n > 1) => columns = None,
            _ => {}
        }
        start = opened.is_none() && matches!(b, b',' | b'\n' | b'\r');
        at += 1;
    }
    match opened {
        Some(from) => Err(Flaw::new(format!("line {from}: a quote opens there and is never closed"), "close it")),
        None => Ok(()),
    }
}

/// All rows: the named columns as finite numbers, the others as text.
pub(super) fn read_table<const N: usize>(path: &Path, names: [&str; N]) -> Result<Table<N>, IoError> {
    let (header, mut reader) = open_table(path)?;
    let mut columns = [0; N];
    for (column, name) in columns.iter_mut().zip(names) {
        *column = header.iter().position(|h| h.eq_ignore_ascii_case(name)).ok_or_else(|| {
            let found = header.iter().take(20).collect::<Vec<_>>().join(",");
            let hint = format!("the first line must name {}, separated by commas", names.join(","));
            format(path, format!("line 1: there is no column {name:?} among {found:?}"), hint)
        })?;
    }
    let rest: Vec<usize> = (0..header.len()).filter(|c| !columns.contains(c)).collect();
    let text = |record: &StringRecord| rest.iter().map(|&c| record[c].to_string()).collect();
    let mut table = Table { numbers: Vec::new(), other_columns: text(&header), others: Vec::new() };
    for record in reader.records() {
        let record = record.map_err(|e| damaged(path, e))?;
        let mut row = [0.0; N];
        for (value, (&column, name)) in row.iter_mut().zip(columns.iter().zip(names)) {
            let found = &record[column];
            *value = found.parse().ok().filter(|v: &f64| v.is_finite()).ok_or_else(|| {
                let line = record.position().map_or(0, csv::Position::line);
                let what = format!("line {line}: {name} is {found:?}, not a finite number");
                format(path, what, "correct or remove that line")
            })?;
        }
        table.numbers.push(row);
        table.others.push(text(&record));
    }
    Ok(table)
}

/// The `csv` crate's messages name the line themselves.
pub(super) fn damaged(path: &Path, error: csv::Error) -> IoError {
    match error.into_kind() {
        csv::ErrorKind::Io(source) => os(path, "read")(source),
        csv::ErrorKind::UnequalLengths { pos, expected_len, len } => {
            let line = pos.map_or(0, |p| p.line());
            let what = format!("line {line}: {len} values, but the header line has {expected_len}");
            format(path, what, "give each line the same number of commas")
        }
        csv::ErrorKind::Utf8 { pos, .. } => {
            let what = format!("line {}: is not UTF-8 text", pos.map_or(0, |p| p.line()));
            format(path, what, "save it as plain CSV")
        }
        _ => format(path, "is not a table of comma-separated values", "save it as plain CSV"),
    }
}
