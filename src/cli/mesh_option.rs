//! `palpate stiffness --mesh`: measured displacements on the user's own mesh.

use super::Usage;
use super::inputs::name;
use anyhow::{Result, bail};
use clap::Args;
use palpate::error::Shown;
use palpate::io::{self, OutputFolder, SolidFile};
use palpate::pipeline::boundary::{Known, at_nodes, moduli};
use palpate::types::{DenseField, Grid, Mask, Measured, MeasuredNode, SolidMesh, StiffnessResult, WorldPoint};
use std::path::{Path, PathBuf};

/// All that may be written.
pub(super) const FILES: [&str; 5] = ["boundary.csv", "elements.csv", "boundary.vtu", "boundary.inp", "boundary.feb"];

/// What nodes are called where no set is named.
const SURFACE: &str = "surface";

#[derive(Debug, Args)]
pub struct MeshOption {
    /// Your own solid mesh of the body (world mm, RAS; .vtu, .inp or .feb): the measured
    /// displacement of its surface nodes is written as boundary conditions, with its covariance
    #[arg(long, value_name = "BODY", conflicts_with = "sequence")]
    mesh: Option<PathBuf>,
    /// Mesh: a set of nodes to prescribe in place of the whole surface, such as HELD; may be given
    /// several times (.vtu: an array at points that is not 0 there)
    #[arg(long = "mesh-set", value_name = "NAME", requires = "mesh")]
    sets: Vec<String>,
}

impl MeshOption {
    /// The file that `--mesh` names.
    pub fn path(&self) -> Option<&PathBuf> {
        self.mesh.as_ref()
    }

    /// The mesh with what was measured at its nodes; none where none is asked for.
    ///
    /// # Errors
    /// When the mesh cannot be read, lacks a set, or does not lie where the body is.
    pub fn measure(&self, field: &DenseField, body: &Mask, source: &Path) -> Result<Option<OnMesh>> {
        let Some(path) = &self.mesh else {
            if !self.sets.is_empty() {
                bail!(Usage("--mesh-set belongs to --mesh".into()));
            }
            return Ok(None);
        };
        let file = SolidFile::read(path)?;
        let patches = patches(path, file.mesh(), &self.sets)?;
        let deviation = beside(source, "uncertainty.nii.gz").map(io::read_volume).transpose()?;
        let deviation = deviation.filter(|d| d.grid().same_as(field.grid()));
        let draws = beside(source, "posterior.nii.gz").map(io::read_samples).transpose()?;
        let known = Known { field, body, deviation: deviation.as_ref(), draws: draws.as_ref() };
        let measured = |(patch, nodes): &(String, Vec<u32>)| at_nodes(&known, file.mesh(), nodes, patch);
        let nodes: Vec<MeasuredNode> = patches.iter().flat_map(measured).collect();
        let asked = patches.iter().map(|p| p.1.len()).sum();
        if nodes.is_empty() {
            bail!(elsewhere(path, file.mesh(), body));
        }
        Ok(Some(OnMesh { name: name(path), file, nodes, asked }))
    }
}

/// A file beside a field of `palpate field`.
fn beside(field: &Path, file: &str) -> Option<PathBuf> {
    let ours = field.with_file_name("summary.json").is_file();
    Some(field.with_file_name(file)).filter(|f| ours && f.is_file())
}

/// The nodes that are asked for: sets by name, or the whole surface. A node is in one of them only.
fn patches(path: &Path, mesh: &SolidMesh, sets: &[String]) -> Result<Vec<(String, Vec<u32>)>> {
    if sets.is_empty() {
        return Ok(vec![(SURFACE.into(), mesh.surface())]);
    }
    let mut seen = vec![false; mesh.nodes().len()];
    let mut out = Vec::new();
    for asked in sets {
        let Some((found, nodes)) = mesh.sets().iter().find(|s| s.0.eq_ignore_ascii_case(asked)) else {
            let all: Vec<&str> = mesh.sets().iter().map(|s| s.0.as_str()).collect();
            let has = if all.is_empty() { "it has none".into() } else { format!("it has {}", all.join(", ")) };
            bail!("{}: holds no set of nodes {asked:?}; {has}", path.shown());
        };
        let mut own = nodes.clone();
        own.sort_unstable();
        own.retain(|&n| !std::mem::replace(&mut seen[n as usize], true));
        out.push((found.clone(), own));
    }
    Ok(out)
}

/// Why no node of a mesh has a displacement.
fn elsewhere(path: &Path, mesh: &SolidMesh, body: &Mask) -> String {
    let spans = |low: [f64; 3], high: [f64; 3]| {
        let axis = |a: usize| format!("{} {:.1} to {:.1}", ["x", "y", "z"][a], low[a], high[a]);
        [0, 1, 2].map(axis).join(", ")
    };
    let (low, high) = bounds(mesh.nodes().iter().copied());
    let grid: &Grid = body.grid();
    let inside = (0..grid.len()).filter(|&o| body.as_slice()[o] > 0).map(|o| grid.centre(o));
    let (from, to) = bounds(inside);
    format!(
        "{}: no node lies at the body, so none has a measured displacement; the mesh spans {} mm and the body {} mm: the mesh \
         must be in world mm, RAS (from metres: times 1000; from LPS: x and y with the other sign)",
        path.shown(),
        spans(low, high),
        spans(from, to)
    )
}

fn bounds(places: impl Iterator<Item = WorldPoint>) -> ([f64; 3], [f64; 3]) {
    places.fold(([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]), |(low, high), p| {
        (std::array::from_fn(|a| low[a].min(p.0[a])), std::array::from_fn(|a| high[a].max(p.0[a])))
    })
}

/// A user's mesh with what was measured at its nodes.
#[derive(Debug)]
pub struct OnMesh {
    name: String,
    file: SolidFile,
    nodes: Vec<MeasuredNode>,
    asked: usize,
}

impl OnMesh {
    /// Writes the mesh with boundary conditions, and the two tables; says what was left out.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn write(self, folder: &mut OutputFolder, labels: &Mask, result: &StiffnessResult) -> Result<Vec<String>> {
        let Self { name, file, nodes, asked } = self;
        let mesh = file.mesh();
        let measured = Measured { nodes, elements: moduli(mesh, labels, result) };
        folder.write("boundary.csv", |p| io::write_boundary(p, mesh, &measured))?;
        folder.write("elements.csv", |p| io::write_element_moduli(p, mesh, &measured))?;
        folder.write(&format!("boundary.{}", file.ending()), |p| file.write(p, &measured))?;
        Ok(left_out(&name, asked, &measured))
    }
}

/// What has no displacement, no covariance or no modulus.
fn left_out(name: &str, asked: usize, measured: &Measured) -> Vec<String> {
    let mut out = Vec::new();
    let given = measured.nodes.len();
    if given < asked {
        out.push(format!(
            "{name}: {} of {asked} nodes are left free: they lie more than a voxel outside of the body, or the field gives nothing there",
            asked - given
        ));
    }
    if measured.nodes.iter().all(|m| m.covariance.is_none()) {
        out.push(format!(
            "{name}: the covariance is not known: there is no uncertainty.nii.gz of palpate field beside the field"
        ));
    }
    let bare = measured.elements.iter().filter(|e| e.is_none()).count();
    if bare > 0 {
        let all = measured.elements.len();
        out.push(format!("{name}: {bare} of {all} elements lie outside of the body and have no modulus"));
    }
    out
}
