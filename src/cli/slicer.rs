//! The Slicer Execution Model: `palpate field --xml` describes the command, so that 3D Slicer lists
//! it as a module and nipype makes an interface of it. The description is made from the command
//! line's own definitions.
//!
//! A caller of that kind may add `--filter-progress` (progress as lines of XML on stdout) and
//! `--return-NAME FILE` (a copy of the result NAME.nii.gz).

use super::Usage;
use anyhow::{Context, Result, bail};
use clap::{Arg, ArgAction, Command};
use palpate::io;
use std::any::TypeId;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// Commands that are described, and the results that they return: name, element and label.
const MODULES: [(&str, &[[&str; 3]]); 5] = [
    (
        "field",
        &[
            ["displacement", "transform", "Displacement field"],
            ["warped", "image", "Deformed volume, resampled"],
            ["uncertainty", "image", "Standard deviation of the displacement (mm)"],
        ],
    ),
    ("warp", &[]),
    ("strain", &[["shear", "image", "Largest shear strain"]]),
    ("stiffness", &[["stiffness", "image", "Young's modulus"]]),
    ("track", &[]),
];
/// Arguments that are volumes, and those that are label maps.
const IMAGES: [&str; 4] = ["initial", "deformed", "image", "reference"];
const LABELS: [&str; 5] = ["mask", "labels", "bodies", "deformed_mask", "ignore"];
/// Arguments of every command that a caller has no use for.
const LEFT_OUT: [&str; 6] = ["help", "quiet", "verbose", "timeout", "dry_run", "version"];

const PROGRESS: &str = "--filter-progress";
const RETURN: &str = "--return-";

/// What a caller asks for beside the command line.
#[derive(Debug, Default)]
pub struct Asked {
    /// Progress as XML on stdout.
    pub progress: bool,
    /// Results to copy: name and file.
    returns: Vec<(String, PathBuf)>,
}

impl Asked {
    /// Takes what belongs here out of the words of a command line.
    ///
    /// # Errors
    /// When a result is asked for that the command does not have, or without a file for it.
    pub fn taken(typed: &mut Vec<OsString>) -> Result<Self> {
        let mut out = Self::default();
        let command = typed.get(1).map(|word| word.to_string_lossy().into_owned()).unwrap_or_default();
        let mut rest = Vec::with_capacity(typed.len());
        let mut words = std::mem::take(typed).into_iter();
        while let Some(word) = words.next() {
            let text = word.to_string_lossy().into_owned();
            match text.strip_prefix(RETURN).map(|name| name.split_once('=').unwrap_or((name, ""))) {
                Some((name, "")) => {
                    let Some(file) = words.next() else { bail!(Usage(format!("{RETURN}{name} needs a file"))) };
                    out.returns.push((returned_by(&command, name)?, file.into()));
                }
                Some((name, file)) => out.returns.push((returned_by(&command, name)?, file.into())),
                None if text == PROGRESS => out.progress = true,
                None => rest.push(word),
            }
        }
        *typed = rest;
        Ok(out)
    }

    /// Copies results out of the folder that the command wrote.
    ///
    /// # Errors
    /// When there is no such result, or its copy cannot be written.
    pub fn hand_over(&self, results: Option<&Path>) -> Result<()> {
        for (name, file) in &self.returns {
            let folder = results.with_context(|| format!("{RETURN}{name}: this command has no folder of results"))?;
            io::copy(folder.join(format!("{name}.nii.gz")), file).with_context(|| format!("{RETURN}{name}"))?;
        }
        Ok(())
    }
}

/// The name of a result, if the command has it.
fn returned_by(command: &str, name: &str) -> Result<String> {
    let all = MODULES.iter().find(|m| m.0 == command).map(|m| m.1).unwrap_or_default();
    if all.iter().any(|r| r[0] == name) {
        return Ok(name.into());
    }
    let names: Vec<&str> = all.iter().map(|r| r[0]).collect();
    let has = if names.is_empty() { "none".into() } else { names.join(", ") };
    bail!(Usage(format!("{RETURN}{name}: palpate {command} does not return {name}.nii.gz; it returns {has}")))
}

/// The description that a command line asks for, if it does, of the whole `program`.
pub fn description(typed: &[OsString], program: impl FnOnce() -> Command) -> Option<String> {
    let [_, name, flag] = typed else { return None };
    if flag != "--xml" {
        return None;
    }
    let (name, returns) = MODULES.iter().find(|m| name == m.0)?;
    let mut program = program();
    // Places of arguments are numbered then.
    program.build();
    Some(xml(program.find_subcommand(name)?, returns))
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

fn xml(command: &Command, returns: &[[&str; 3]]) -> String {
    let about = command.get_about().map(ToString::to_string).unwrap_or_default();
    let arguments: Vec<&Arg> =
        command.get_arguments().filter(|a| !LEFT_OUT.contains(&a.get_id().as_str()) && !a.is_hide_set()).collect();
    let part = |title: &str, of: &dyn Fn(&Arg) -> bool| {
        let inside: String = arguments.iter().filter(|a| of(a)).map(|a| parameter(a)).collect();
        format!(
            "  <parameters>\n    <label>{title}</label>\n    <description>{title}</description>\n{inside}  </parameters>\n"
        )
    };
    let needed = |a: &Arg| a.is_required_set() || a.get_id() == "output";
    let returned: String = returns.iter().map(returned).collect();
    format!(
        "<?xml version=\"1.0\" encoding=\"utf-8\"?>\n<executable>\n  <category>Palpate</category>\n  <title>palpate {}</title>\n  \
         <description>{}</description>\n  <version>{}</version>\n  <license>MIT OR Apache-2.0</license>\n{}{}  <parameters \
         advanced=\"true\">\n    <label>Results in the scene</label>\n    <description>Results to load</description>\n{returned}    \
         <boolean hidden=\"true\">\n      <name>filterProgress</name>\n      <longflag>{PROGRESS}</longflag>\n      \
         <label>Progress</label>\n      <description>Progress as XML</description>\n      <default>true</default>\n    \
         </boolean>\n  </parameters>\n</executable>\n",
        command.get_name(),
        escaped(&about),
        env!("CARGO_PKG_VERSION"),
        part("Data", &needed),
        part("Options", &|a| !needed(a)),
    )
}

/// The element of an argument, with its attributes.
fn element(argument: &Arg) -> (&'static str, &'static str) {
    let (id, parser) = (argument.get_id().as_str(), argument.get_value_parser().type_id());
    let is = |t: TypeId| parser == t;
    let folder = argument.get_value_names().is_some_and(|names| names.iter().any(|n| n.as_str() == "DIR"));
    let defaulted = !argument.get_default_values().is_empty();
    match () {
        _ if !argument.get_action().takes_values() => ("boolean", ""),
        _ if !argument.get_possible_values().is_empty() && defaulted => ("string-enumeration", ""),
        _ if folder => ("directory", ""),
        _ if is(TypeId::of::<PathBuf>()) && LABELS.contains(&id) => {
            ("image", " type=\"label\" fileExtensions=\".nii.gz\"")
        }
        _ if is(TypeId::of::<PathBuf>()) && (IMAGES.contains(&id) || id == "output") => {
            ("image", " fileExtensions=\".nii.gz\"")
        }
        _ if is(TypeId::of::<PathBuf>()) => ("file", ""),
        // A number without a default is left out where its text is empty.
        _ if defaulted && is(TypeId::of::<f64>()) => ("double", ""),
        _ if defaulted && [TypeId::of::<usize>(), TypeId::of::<u64>(), TypeId::of::<u8>()].into_iter().any(is) => {
            ("integer", "")
        }
        _ => ("string", ""),
    }
}

fn parameter(argument: &Arg) -> String {
    let (element, attributes) = element(argument);
    let id = argument.get_id().as_str();
    let help = argument.get_help().map(ToString::to_string).unwrap_or_default();
    let label = id.replace('_', " ");
    let mut lines = vec![format!("<name>{id}</name>")];
    match (argument.get_index(), argument.get_long()) {
        (Some(index), _) => lines.push(format!("<index>{}</index>", index - 1)),
        (None, long) => lines.push(format!("<longflag>--{}</longflag>", long.unwrap_or(id))),
    }
    lines.push(format!("<label>{}{}</label>", label[..1].to_uppercase(), &label[1..]));
    lines.push(format!("<description>{}</description>", escaped(&help)));
    if matches!(element, "image" | "file" | "directory") {
        lines.push(format!("<channel>{}</channel>", if id == "output" { "output" } else { "input" }));
    }
    let default = argument.get_default_values().first().map(|v| v.to_string_lossy().into_owned());
    let default = if element == "boolean" { Some("false".to_string()) } else { default };
    lines.extend(default.map(|text| format!("<default>{}</default>", escaped(&text))));
    if element == "string-enumeration" {
        let values = argument.get_possible_values();
        lines.extend(values.iter().map(|v| format!("<element>{}</element>", escaped(v.get_name()))));
    }
    let several = matches!(argument.get_action(), ArgAction::Append) && matches!(element, "image" | "file");
    let several = if several { " multiple=\"true\"" } else { "" };
    let inside: String = lines.iter().map(|line| format!("      {line}\n")).collect();
    format!("    <{element}{attributes}{several}>\n{inside}    </{element}>\n")
}

fn returned([name, element, label]: &[&str; 3]) -> String {
    format!(
        "    <{element} fileExtensions=\".nii.gz\">\n      <name>return_{name}</name>\n      <longflag>{RETURN}{name}</longflag>\n      \
         <label>{label}</label>\n      <description>{label}, loaded into the scene</description>\n      \
         <channel>output</channel>\n    </{element}>\n"
    )
}
