//! Grasp scenes: TOML, SI units, angles in degrees. Every error names the file, the key, what is
//! wrong and what to try.

use super::{format, source};
use crate::error::{IoError, SceneError};
use crate::types::Fingertip;
use crate::types::fingertip::FingertipModel;
use crate::types::names;
use crate::types::scene::{
    Finger, Formulation, Gains, Initial, Integrator, Method, Motion, Object, Push, Rolling, Scene, Second, SweepCase,
    rectangle_inertia,
};
use serde::Deserialize;
use std::path::{Path, PathBuf};
use toml::{Table, Value};

/// Values set from outside the file, for all scenes in it.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct SceneOverrides {
    /// Instead of `fingertip.model`.
    pub model: Option<FingertipModel>,
    /// Instead of `integrator.formulation`.
    pub formulation: Option<Formulation>,
    /// Instead of `integrator.step` (s); `output_every` is lengthened to it where it is shorter.
    pub step: Option<f64>,
}

impl SceneOverrides {
    /// Whether they replace the value of a key.
    fn replace(&self, key: &str) -> bool {
        match key {
            "fingertip.model" => self.model.is_some(),
            "integrator.formulation" => self.formulation.is_some(),
            "integrator.step" => self.step.is_some(),
            _ => false,
        }
    }
}

/// What a scene file holds.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneFile {
    /// The scene without any sweep.
    pub scene: Scene,
    /// One case for each combination of the `[[sweep]]` tables' values, the last table's fastest;
    /// empty without one.
    pub sweep: Vec<SweepCase>,
    /// The file that `fingertip.file` names, where it does.
    pub fingertip_file: Option<PathBuf>,
}

/// Keys of each table; a test holds them against what is deserialised.
const KEYS: [(&str, &[&str]); 10] = [
    ("", &["fingertip", "finger", "object", "initial", "gravity", "integrator", "motion", "push", "sweep"]),
    (
        "fingertip",
        &[
            "file",
            "radius",
            "youngs_modulus",
            "youngs_modulus_sd",
            "youngs_modulus_bounds",
            "damping",
            "maxwell",
            "stiffening",
            "model",
            "profile_depth",
            "profile_modulus",
        ],
    ),
    ("finger", &["link", "links", "half_span", "base", "inertia", "gains", "fixed"]),
    ("object", &["width", "height", "mass", "inertia", "friction", "offset"]),
    ("initial", &["normal_displacement", "theta", "rest"]),
    ("gravity", &["y"]),
    ("integrator", &["method", "step", "output_every", "formulation", "baumgarte", "rolling", "tolerance"]),
    ("motion", &["theta", "move", "hold"]),
    ("push", &["start", "duration", "force", "at"]),
    ("sweep", &["key", "values"]),
];
const GAINS: [&str; 3] = ["kp", "kd", "ki"];
/// Keys of each of two `[[finger]]` tables: those of a finger, then those of its tip.
const FINGER: [&str; 6] = ["link", "links", "base", "inertia", "gains", "fixed"];
const TIP: [&str; 3] = ["radius", "youngs_modulus", "damping"];
/// Most cases of an ensemble.
const MAX_CASES: usize = 100_000;

/// Reads a scene file.
///
/// # Errors
/// [`IoError`] when the file or its fingertip file cannot be read or is no TOML, a key is unknown
/// (with the nearest known one), missing or of a wrong type, or a value of any case is out of
/// range.
///
/// ```
/// use palpate::io::{SceneOverrides, read_scene};
/// let path = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/eight_motions.toml");
/// let file = read_scene(path, &SceneOverrides::default())?;
/// assert_eq!(file.scene.motions.len(), 8);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn read_scene(path: impl AsRef<Path>, overrides: &SceneOverrides) -> Result<SceneFile, IoError> {
    let path = path.as_ref();
    let mut table = read_table(path)?;
    check_keys(path, &table)?;
    let fingertip_file = merge_fingertip(path, &mut table)?;
    pair_fingers(path, &mut table)?;
    let sweeps = take_sweeps(path, &mut table)?;
    if let Some((key, _)) = sweeps.iter().find(|(key, _)| overrides.replace(key)) {
        let what = format!("[[sweep]] changes {key}, which is set from outside for all scenes");
        return Err(format(path, what, "leave that flag out, or that [[sweep]] table"));
    }
    let scene = scene(path, table.clone(), overrides)?;
    let count = sweeps.iter().try_fold(1usize, |n, (_, values)| n.checked_mul(values.len()));
    if count.is_none_or(|n| n > MAX_CASES) {
        return Err(format(path, "[[sweep]] asks for more than 100,000 scenes", "give fewer values"));
    }
    let mut sweep = Vec::new();
    for case in 0..if sweeps.is_empty() { 0 } else { count.unwrap_or(0) } {
        let (mut changed, mut values, mut rest) = (table.clone(), Vec::new(), case);
        for (key, choices) in sweeps.iter().rev() {
            let value = &choices[rest % choices.len()];
            rest /= choices.len();
            set(path, &mut changed, key, value)?;
            values.push((key.clone(), value.to_string()));
        }
        values.reverse();
        sweep.push(SweepCase { values, scene: self::scene(path, changed, overrides)? });
    }
    Ok(SceneFile { scene, sweep, fingertip_file })
}

/// No scene and no fingertip is longer (bytes).
const MAX_FILE_BYTES: u64 = 1 << 22;

pub(super) fn read_table(path: &Path) -> Result<Table, IoError> {
    parse_table(path, &source::keyed(path, MAX_FILE_BYTES, source::MAX_VALUES)?)
}

pub(super) fn parse_table(path: &Path, text: &str) -> Result<Table, IoError> {
    text.parse().map_err(|error: toml::de::Error| {
        let line = error.span().map_or(1, |span| text[..span.start.min(text.len())].matches('\n').count() + 1);
        let what = format!("line {line}: {}", error.message().trim_end().replace('\n', ", "));
        format(path, what, "correct that line (TOML: one `key = value` a line under a [table])")
    })
}

/// Every key must be known.
fn check_keys(path: &Path, table: &Table) -> Result<(), IoError> {
    known(path, "the scene", table, KEYS[0].1)?;
    for (name, keys) in &KEYS[1..] {
        let Some(value) = table.get(*name) else { continue };
        if *name == "finger" && value.is_array() {
            continue;
        }
        let many = matches!(*name, "motion" | "push" | "sweep");
        let parts: Vec<&Table> = match value {
            Value::Table(part) if !many => vec![part],
            Value::Array(parts) if many => parts.iter().filter_map(Value::as_table).collect(),
            _ => {
                let brackets = if many { format!("[[{name}]]") } else { format!("[{name}]") };
                return Err(format(path, format!("{name} is not a table"), format!("write {brackets} above its keys")));
            }
        };
        for part in parts {
            let shown = if many { format!("[[{name}]]") } else { format!("[{name}]") };
            known(path, &shown, part, keys)?;
            if let Some(gains) = part.get("gains").and_then(Value::as_table) {
                known(path, "finger.gains", gains, &GAINS)?;
            }
        }
    }
    Ok(())
}

pub(super) fn known(path: &Path, place: &str, table: &Table, keys: &[&'static str]) -> Result<(), IoError> {
    known_names(path, place, table.keys().map(String::as_str), keys)
}

pub(super) fn known_names<'a>(
    path: &Path,
    place: &str,
    found: impl IntoIterator<Item = &'a str>,
    keys: &[&'static str],
) -> Result<(), IoError> {
    let choices: Vec<(&'static str, ())> = keys.iter().map(|k| (*k, ())).collect();
    for key in found {
        if !keys.contains(&key) {
            let found = names::choose("key", key, &choices).err();
            let hint =
                found.as_ref().and_then(|e| e.nearest).map_or(String::new(), |n| format!("did you mean '{n}'? "));
            let what = format!("{place} has the unknown key '{}'", names::cut(key));
            return Err(format(path, what, format!("{hint}known: {}", keys.join(", "))));
        }
    }
    Ok(())
}

/// Puts the keys of the file that `fingertip.file` names under those of `[fingertip]`.
fn merge_fingertip(path: &Path, table: &mut Table) -> Result<Option<PathBuf>, IoError> {
    let Some(tip) = table.get_mut("fingertip").and_then(Value::as_table_mut) else { return Ok(None) };
    let Some(file) = tip.remove("file") else { return Ok(None) };
    let Some(file) = file.as_str() else {
        return Err(format(path, "fingertip.file is not text", "give the name of a TOML file in quotes"));
    };
    let file = path.parent().unwrap_or(Path::new("")).join(file);
    let mut other = read_table(&file)?;
    // The keys may stand alone or under [fingertip]; other tables of the file say where it comes
    // from.
    let keys = match other.remove("fingertip") {
        Some(Value::Table(keys)) => keys,
        _ => other.into_iter().filter(|(_, v)| !v.is_table()).collect(),
    };
    known(&file, "the fingertip", &keys, &KEYS[1].1[1..])?;
    for (key, value) in keys {
        tip.entry(key).or_insert(value);
    }
    Ok(Some(file))
}

/// Two `[[finger]]` tables become the pairs of `[finger]` and of `[fingertip]`.
fn pair_fingers(path: &Path, table: &mut Table) -> Result<(), IoError> {
    let Some(Value::Array(list)) = table.get("finger") else { return Ok(()) };
    let all: Option<Vec<Table>> = list.iter().map(|v| v.as_table().cloned()).collect();
    let Some([left, right]) = all.as_deref().and_then(|l| <&[Table; 2]>::try_from(l).ok()) else {
        let what = format!("has {} [[finger]] tables, and a grasp has two fingers", list.len());
        return Err(format(path, what, "give two, the left one first, or one [finger] for fingers that are alike"));
    };
    // A finger of one joint beside one of two has a list of one link.
    let mut pair = [left.clone(), right.clone()];
    if pair.iter().any(|f| f.contains_key("links")) {
        for finger in &mut pair {
            if let (Some(link), false) = (finger.remove("link"), finger.contains_key("links")) {
                finger.insert("links".into(), Value::Array(vec![link]));
            }
        }
    }
    let [left, right] = &pair;
    let (mut fingers, mut tips) = (Table::new(), Table::new());
    for keys in [&FINGER[..], &TIP] {
        for finger in [left, right] {
            known(path, "[[finger]]", finger, &[&FINGER[..], &TIP].concat())?;
            if let Some(gains) = finger.get("gains").and_then(Value::as_table) {
                known(path, "[[finger]] gains", gains, &GAINS)?;
            }
        }
        for key in keys {
            let pair = match [left, right].map(|f| f.get(*key).cloned()) {
                [None, None] => continue,
                [Some(a), Some(b)] => Value::Array(vec![a, b]),
                _ => {
                    let what = format!("one [[finger]] has {key}, the other has not");
                    return Err(format(path, what, "give it for both"));
                }
            };
            let into = if TIP.contains(key) { &mut tips } else { &mut fingers };
            into.insert((*key).to_string(), pair);
        }
    }
    table.insert("finger".into(), Value::Table(fingers));
    let tip = table.entry("fingertip").or_insert_with(|| Value::Table(Table::new()));
    if let Some(tip) = tip.as_table_mut() {
        tip.extend(tips);
    }
    Ok(())
}

/// One value for both fingers, or one for each, the left one first.
#[derive(Debug, Clone)]
enum Each<T> {
    Both(T),
    Two([T; 2]),
}

impl<T: Clone> Each<T> {
    fn pair(self) -> [T; 2] {
        match self {
            Self::Both(v) => [v.clone(), v],
            Self::Two(pair) => pair,
        }
    }
}

impl<'de, T: serde::de::DeserializeOwned> Deserialize<'de> for Each<T> {
    fn deserialize<D: serde::Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        let value = Value::deserialize(from)?;
        if let Value::Array(list) = &value
            && list.len() == 2
            && let Ok(pair) = value.clone().try_into::<[T; 2]>()
        {
            return Ok(Self::Two(pair));
        }
        let one = value.try_into::<T>().map(Self::Both);
        one.map_err(|e| {
            let message = e.message().trim_end().to_string();
            serde::de::Error::custom(format!("{message} (one value for both fingers, or [left, right])"))
        })
    }
}

/// Keys and values of the `[[sweep]]` tables, which are removed.
fn take_sweeps(path: &Path, table: &mut Table) -> Result<Vec<(String, Vec<Value>)>, IoError> {
    #[derive(Deserialize)]
    struct Sweep {
        key: String,
        values: Vec<Value>,
    }
    let Some(sweeps) = table.remove("sweep") else { return Ok(Vec::new()) };
    let sweeps: Vec<Sweep> = sweeps.try_into().map_err(|e: toml::de::Error| {
        format(path, format!("[[sweep]]: {}", e.message()), "give key = \"table.key\" and values = [...]")
    })?;
    if sweeps.iter().any(|s| s.values.is_empty()) {
        return Err(format(path, "[[sweep]] has no values", "give at least one, or remove the table"));
    }
    Ok(sweeps.into_iter().map(|s| (s.key, s.values)).collect())
}

/// Sets `table.key`, `motion.0.theta` or the like.
fn set(path: &Path, table: &mut Table, key: &str, value: &Value) -> Result<(), IoError> {
    let parts: Vec<&str> = key.split('.').collect();
    let wrong = |what: String, hint: &str| format(path, format!("[[sweep]] key '{key}': {what}"), hint);
    let (Some((last, inner)), Some(first)) = (parts.split_last(), parts.first()) else {
        return Err(wrong("is empty".into(), "write table.key"));
    };
    if inner.is_empty() {
        return Err(wrong("names no key of a table".into(), "write table.key, such as object.mass"));
    }
    if key == "fingertip.file" {
        return Err(wrong(
            "is read once, before the sweep".into(),
            "sweep its values, such as fingertip.youngs_modulus",
        ));
    }
    let Some((_, keys)) = KEYS.iter().find(|(name, _)| !name.is_empty() && name == first) else {
        let tables: Vec<&str> = KEYS[1..9].iter().map(|k| k.0).collect();
        return Err(wrong(format!("there is no table '{first}'"), &format!("known: {}", tables.join(", "))));
    };
    let mut at = table.entry(*first).or_insert_with(|| Value::Table(Table::new()));
    for part in &inner[1..] {
        let next = match (part.parse::<usize>(), at) {
            (Ok(i), Value::Array(list)) => list.get_mut(i),
            (_, Value::Table(inside)) => inside.get_mut(*part),
            _ => None,
        };
        at = next.ok_or_else(|| wrong(format!("there is no '{part}' in the scene"), "count tables from 0"))?;
    }
    match (last.parse::<usize>(), at) {
        (Ok(i), Value::Array(list)) if i < list.len() => list[i] = value.clone(),
        (_, Value::Table(inside)) => {
            let one = Table::from_iter([((*last).to_string(), Value::Boolean(true))]);
            let keys = if inner.last() == Some(&"gains") { &GAINS[..] } else { keys };
            known(path, &format!("[[sweep]] key '{key}': {}", inner.join(".")), &one, keys)?;
            inside.insert((*last).to_string(), value.clone());
        }
        _ => return Err(wrong(format!("there is no '{last}' in the scene"), "write table.key; count tables from 0")),
    }
    Ok(())
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawScene {
    fingertip: RawFingertip,
    finger: RawFinger,
    object: RawObject,
    initial: Option<RawInitial>,
    gravity: Option<RawGravity>,
    integrator: Option<RawIntegrator>,
    #[serde(default)]
    motion: Vec<RawMotion>,
    #[serde(default)]
    push: Vec<RawPush>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawFingertip {
    radius: Each<f64>,
    youngs_modulus: Each<f64>,
    youngs_modulus_sd: Option<f64>,
    youngs_modulus_bounds: Option<[f64; 2]>,
    maxwell: Option<Vec<[f64; 2]>>,
    stiffening: Option<f64>,
    damping: Option<Each<[f64; 2]>>,
    model: Option<String>,
    profile_depth: Option<Vec<f64>>,
    profile_modulus: Option<Vec<f64>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawFinger {
    link: Option<Each<f64>>,
    links: Option<Each<Vec<f64>>>,
    half_span: Option<f64>,
    base: Option<[[f64; 2]; 2]>,
    inertia: Each<f64>,
    gains: Option<Each<Gains>>,
    fixed: Option<Each<bool>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawObject {
    width: f64,
    height: f64,
    mass: f64,
    inertia: Option<f64>,
    friction: Option<f64>,
    offset: Option<f64>,
}

#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields)]
struct RawInitial {
    normal_displacement: Option<f64>,
    theta: Option<[f64; 2]>,
    rest: Option<f64>,
}

#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields)]
struct RawGravity {
    y: Option<f64>,
}

#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields)]
struct RawIntegrator {
    method: Option<String>,
    step: Option<f64>,
    output_every: Option<f64>,
    formulation: Option<String>,
    baumgarte: Option<f64>,
    rolling: Option<String>,
    tolerance: Option<f64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawMotion {
    theta: [f64; 2],
    #[serde(rename = "move")]
    duration: Option<f64>,
    hold: Option<f64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawPush {
    start: f64,
    duration: f64,
    force: [f64; 2],
    at: Option<[f64; 2]>,
}

/// Depths (m) and moduli (Pa) of a tabulated fingertip.
fn profile(path: &Path, depths: Option<Vec<f64>>, moduli: Option<Vec<f64>>) -> Result<Vec<[f64; 2]>, IoError> {
    let (depths, moduli) = (depths.unwrap_or_default(), moduli.unwrap_or_default());
    if depths.len() != moduli.len() {
        let what = format!("fingertip.profile_depth has {} values, profile_modulus {}", depths.len(), moduli.len());
        return Err(format(path, what, "give both with as many"));
    }
    Ok(depths.into_iter().zip(moduli).map(|(d, e)| [d, e]).collect())
}

/// Lengths of an upper link, where a finger has two, and of the last one (m).
fn links(path: &Path, finger: &RawFinger) -> Result<([Option<f64>; 2], [f64; 2]), IoError> {
    match (finger.link.clone(), finger.links.clone()) {
        (Some(link), None) => Ok(([None; 2], link.pair())),
        (None, Some(links)) => {
            let (mut upper, mut last) = ([None; 2], [0.0; 2]);
            for (i, list) in links.pair().iter().enumerate() {
                (upper[i], last[i]) = match list[..] {
                    [one] => (None, one),
                    [one, two] => (Some(one), two),
                    _ => {
                        let what = format!("finger.links has {} lengths", list.len());
                        return Err(format(path, what, "give one length for each joint, from the base: one or two"));
                    }
                };
            }
            Ok((upper, last))
        }
        (Some(_), Some(_)) => Err(format(path, "finger has link and links", "leave one of them out")),
        (None, None) => {
            Err(format(path, "finger has no link", "give link in m, or links = [upper, lower] for two joints"))
        }
    }
}

/// Heights of the joints at which tips hang level at joint angles 0, the left joint at 0 (m).
fn level(upper: [Option<f64>; 2], link: [f64; 2]) -> [f64; 2] {
    let [left, right] = [0, 1].map(|i| upper[i].unwrap_or(0.0) + link[i]);
    [0.0, right - left]
}

/// Where the fingers stand at the start: half spans and heights of their bases, and the depth to
/// which the tips are pressed (m).
fn placed(
    path: &Path,
    raw: &RawScene,
    upper: [Option<f64>; 2],
    link: [f64; 2],
) -> Result<([f64; 2], [f64; 2], f64), IoError> {
    let (finger, width, radius) = (&raw.finger, raw.object.width, raw.fingertip.radius.clone().pair());
    let depth = raw.initial.as_ref().and_then(|initial| initial.normal_displacement);
    let (spans, lifts) = match (finger.base, finger.half_span) {
        (Some(_), Some(_)) => {
            return Err(format(path, "finger has base and half_span", "leave one of them out"));
        }
        (Some([left, right]), None) => ([-left[0], right[0]], [left[1], right[1]]),
        (None, Some(half_span)) => ([half_span; 2], level(upper, link)),
        (None, None) => {
            let depth = depth.unwrap_or(Scene::reference().initial.normal_displacement);
            return Ok((radius.map(|a| a + 0.5 * width - depth), level(upper, link), depth));
        }
    };
    let own = 0.5 * (radius[0] + radius[1] + width - spans[0] - spans[1]);
    Ok((spans, lifts, depth.unwrap_or(own)))
}

/// A checked scene from its table; what the file leaves out is as in [`Scene::reference`].
fn scene(path: &Path, table: Table, overrides: &SceneOverrides) -> Result<Scene, IoError> {
    let raw: RawScene = Value::Table(table).try_into().map_err(|error: toml::de::Error| {
        // The message's further lines name the place: "in `object.mass`".
        let message = error.to_string().trim_end().replace('\n', " ");
        format(path, message, "docs/reference/grasp.md shows a whole scene")
    })?;
    let named = |error: crate::error::UnknownName, key: &str| format(path, error.to_string(), format!("correct {key}"));
    let default = Scene::reference();
    let (upper, link) = links(path, &raw.finger)?;
    let (spans, lifts, depth) = placed(path, &raw, upper, link)?;
    let (tip, finger, object) = (raw.fingertip, raw.finger, raw.object);
    let (initial, integrator) = (raw.initial.unwrap_or_default(), raw.integrator.unwrap_or_default());

    let radius = tip.radius.pair();
    let profile = profile(path, tip.profile_depth, tip.profile_modulus)?;
    let model = tip.model.as_deref().map(str::parse::<FingertipModel>).transpose();
    let model = model.map_err(|e| named(e, "fingertip.model"))?.unwrap_or_default();
    let method = integrator.method.as_deref().map(str::parse::<Method>).transpose();
    let formulation = integrator.formulation.as_deref().map(str::parse::<Formulation>).transpose();
    let rolling = integrator.rolling.as_deref().map(str::parse::<Rolling>).transpose();
    let step = overrides.step.or(integrator.step).unwrap_or(default.integrator.step);
    let every = integrator.output_every.unwrap_or(default.integrator.output_every);
    let (moduli, inertia) = (tip.youngs_modulus.pair(), finger.inertia.pair());
    let damping = tip.damping.map_or([default.fingertip.damping; 2], Each::pair);
    let gains = finger.gains.map_or([default.finger.gains; 2], Each::pair);
    let fixed = finger.fixed.map_or([false; 2], Each::pair);
    let model = overrides.model.unwrap_or(model);
    let [left, right] = [0, 1].map(|i| {
        let fingertip = Fingertip {
            radius: radius[i],
            youngs_modulus: moduli[i],
            damping: damping[i],
            model,
            maxwell: tip.maxwell.clone().unwrap_or_default(),
            stiffening: tip.stiffening,
            deviation: tip.youngs_modulus_sd.unwrap_or(0.0) / moduli[0],
            bounds: tip.youngs_modulus_bounds.map(|b| b.map(|v| v / moduli[0])),
            profile: profile.clone(),
        };
        let finger = Finger {
            link: link[i],
            upper: upper[i],
            half_span: spans[i],
            lift: lifts[i],
            inertia: inertia[i],
            gains: gains[i],
            fixed: fixed[i],
        };
        Second { fingertip, finger }
    });
    let differ = left != right;
    let motion = |m: RawMotion| Motion {
        target: m.theta.map(f64::to_radians),
        duration: m.duration.unwrap_or(0.5),
        hold: m.hold.unwrap_or(1.0),
    };
    let push = |p: RawPush| Push { start: p.start, duration: p.duration, force: p.force, at: p.at.unwrap_or_default() };
    let scene = Scene {
        fingertip: left.fingertip,
        finger: left.finger,
        second: differ.then_some(right),
        object: Object {
            width: object.width,
            height: object.height,
            mass: object.mass,
            inertia: object.inertia.unwrap_or(rectangle_inertia(object.mass, object.width, object.height)),
            friction: object.friction,
            offset: object.offset.unwrap_or(0.0),
        },
        initial: Initial {
            normal_displacement: depth,
            joints: initial.theta.unwrap_or_default().map(f64::to_radians),
            rest: initial.rest.unwrap_or(default.initial.rest),
        },
        gravity: raw.gravity.and_then(|g| g.y).unwrap_or(default.gravity),
        integrator: Integrator {
            method: method.map_err(|e| named(e, "integrator.method"))?.unwrap_or_default(),
            step,
            output_every: if overrides.step.is_some() { every.max(step) } else { every },
            formulation: match overrides.formulation {
                Some(formulation) => formulation,
                None => formulation.map_err(|e| named(e, "integrator.formulation"))?.unwrap_or_default(),
            },
            baumgarte: integrator.baumgarte.unwrap_or(default.integrator.baumgarte),
            rolling: rolling.map_err(|e| named(e, "integrator.rolling"))?.unwrap_or_default(),
            tolerance: integrator.tolerance.unwrap_or(default.integrator.tolerance),
        },
        motions: raw.motion.into_iter().map(motion).collect(),
        pushes: raw.push.into_iter().map(push).collect(),
    };
    scene.check().map_err(|error| {
        let hint = match &error {
            SceneError::Param(param) => format!("change {}", param.name),
            _ => "correct the scene".into(),
        };
        format(path, error.to_string(), hint)
    })?;
    Ok(scene)
}
