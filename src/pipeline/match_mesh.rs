//! Matches in world mm, their Delaunay mesh, and the field that is piecewise linear on it.

use crate::error::{FieldError, MeshError};
use crate::field::spline::{FieldSpline, ScalarSpline};
use crate::field::{interpolation, jacobian};
use crate::matching::levels::from_level;
use crate::mesh::{delaunay2::delaunay2, delaunay3::delaunay3};
use crate::pipeline::clock::Clock;
use crate::pipeline::level::LevelMatch;
use crate::types::params::Interpolation;
use crate::types::points::covariance_after;
use crate::types::*;
use rayon::prelude::*;

/// A level's match in world mm (RAS).
pub(super) fn world_match(grid: &Grid, m: &LevelMatch, factor: [usize; 3]) -> Match {
    let axes = grid.axes();
    Match {
        initial: grid.affine().to_world(from_level(m.voxel, factor)),
        displacement: grid.vector_to_world(GridVector(m.measured.displacement)),
        ncc: m.ncc,
        covariance: covariance_after(&axes, &m.measured.covariance),
        kept: m.kept,
        raw: None,
    }
}

/// Matches with what the final estimate says at their places.
pub(super) fn estimated(
    mut sparse: SparseField,
    grid: &Grid,
    coefficients: &FieldSpline,
    deviation: &ScalarSpline,
) -> SparseField {
    let of = |m: &mut Match| {
        let place = grid.affine().to_voxel(m.initial);
        *m = m.with_estimate(coefficients.at_place(place), f64::from(deviation.at_place(place)));
    };
    sparse.matches.par_iter_mut().for_each(of);
    sparse
}

/// At most `wanted` of the matches, evenly.
pub(super) fn thinned(sparse: SparseField, wanted: usize) -> SparseField {
    let count = sparse.matches.len();
    let every = |i: &usize| (i + 1) * wanted / count.max(1) > i * wanted / count.max(1);
    let matches = sparse.matches.into_iter().enumerate().filter(|(i, _)| wanted >= count || every(i));
    SparseField { matches: matches.map(|(_, m)| m).collect() }
}

/// The Delaunay mesh of the kept matches, and the kept match of each node.
///
/// # Errors
/// [`FieldError`] when they do not span the space, or the plane of a `flat` volume.
pub(crate) fn mesh_of(sparse: &SparseField, flat: bool) -> Result<(Mesh, Vec<u32>), FieldError> {
    let places: Vec<WorldPoint> = sparse.kept().map(|m| m.initial).collect();
    if !flat {
        match delaunay3(&places) {
            Ok(d) => return Ok((Mesh::Tetrahedra(d.mesh), d.source)),
            Err(MeshError::Coplanar) => {}
            Err(e) => return Err(e.into()),
        }
    }
    let d = delaunay2(&places)?;
    Ok((Mesh::Triangles(d.mesh), d.source))
}

/// The mesh of the kept matches, and the dense field as asked for.
pub(super) struct Meshed {
    pub mesh: Mesh,
    /// Displacement at the mesh's nodes (mm, RAS), and the kept match of each.
    pub node_displacement: Vec<[f64; 3]>,
    pub node_matches: Vec<u32>,
    pub displacement: DenseField,
}

impl Meshed {
    /// # Errors
    /// As [`mesh_of`], and where there is no memory for the field.
    pub fn of(
        sparse: &SparseField,
        coefficients: &FieldSpline,
        interpolation: Interpolation,
        flat: bool,
        clock: &mut Clock,
    ) -> Result<Self, FieldError> {
        let (mesh, node_matches) = mesh_of(sparse, flat)?;
        let kept: Vec<&Match> = sparse.kept().collect();
        let node_displacement: Vec<[f64; 3]> = node_matches.iter().map(|&i| kept[i as usize].displacement).collect();
        clock.book("mesh");
        let displacement = interpolated(interpolation, coefficients.dense()?, (&mesh, &node_displacement))?;
        clock.book("interpolation");
        Ok(Self { mesh, node_displacement, node_matches, displacement })
    }
}

/// Adds the mesh to the counts of the last level: these.
pub(super) fn with_mesh(reports: &mut [LevelReport], mesh: &Mesh) -> Counts {
    let mut nothing = Counts::default();
    let counts = reports.last_mut().map_or(&mut nothing, |r| &mut r.counts);
    (counts.nodes, counts.tetrahedra) = match mesh {
        Mesh::Tetrahedra(m) => (m.nodes().len(), m.tetrahedra().len()),
        Mesh::Triangles(m) => (m.nodes().len(), m.triangles().len()),
    };
    *counts
}

/// The field as asked for: `smooth`, or from the mesh inside it.
pub(super) fn interpolated(
    interpolation: Interpolation,
    smooth: DenseField,
    (mesh, nodes): (&Mesh, &[[f64; 3]]),
) -> Result<DenseField, FieldError> {
    match interpolation {
        Interpolation::Spline => Ok(smooth),
        Interpolation::Barycentric => {
            let mut field = barycentric(mesh, nodes, smooth)?;
            jacobian::unfold(&mut field, &[]);
            Ok(field)
        }
    }
}

/// Piecewise linear inside the mesh, `outside` elsewhere.
fn barycentric(mesh: &Mesh, nodes: &[[f64; 3]], mut outside: DenseField) -> Result<DenseField, FieldError> {
    let filled = match mesh {
        Mesh::Tetrahedra(m) => interpolation::interpolate_tetrahedra(m, nodes, outside.grid())?,
        Mesh::Triangles(m) => interpolation::interpolate_triangles(m, nodes, outside.grid())?,
    };
    let inside = filled.inside.as_slice();
    let (n, values) = (inside.len(), filled.displacement.as_slice());
    for (i, v) in outside.as_mut_slice().iter_mut().enumerate() {
        if inside[i % n] != 0 {
            *v = values[i];
        }
    }
    Ok(outside)
}
