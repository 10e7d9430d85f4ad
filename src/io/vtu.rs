//! Meshes as VTK XML unstructured grids (`.vtu`), for ParaView, PyVista, meshio and Slicer.
//!
//! Arrays are appended in base64, compressed with zlib; positions in world mm (RAS), float32. The
//! form is that of the VTK file formats guide, section "XML file formats": each array is a header
//! (number of blocks, block size, size of the last block where it is smaller, compressed sizes; all
//! u64) and then its blocks, each part in base64 by itself.

use super::atomic::write_atomic;
use super::{format, os};
use crate::error::IoError;
use crate::types::{Match, Mesh, QuadraticMesh, TetMesh, TriMesh, WorldPoint};
use base64::{Engine, engine::general_purpose::STANDARD};
use libdeflater::{CompressionLvl, Compressor};
use std::fmt::Write as _;
use std::io::{self, Write as _};
use std::path::Path;

/// Bytes compressed together.
const BYTES_PER_BLOCK: usize = 1 << 20;
/// VTK's numbers for the cells.
const VTK_TRIANGLE: u8 = 5;
const VTK_TETRA: u8 = 10;
const VTK_QUADRATIC_TETRA: u8 = 24;

/// Writes tetrahedra with `displacement` (mm, RAS) and its `magnitude` at the nodes, and one number
/// a cell for each `(name, values)` of `cell_data`.
///
/// # Errors
/// [`IoError`] when a length does not fit the mesh or the file cannot be written.
///
/// ```
/// use palpate::mesh::delaunay3::delaunay3;
/// use palpate::{WorldPoint, io};
/// let folder = tempfile::tempdir()?;
/// let path = folder.path().join("mesh.vtu");
/// let corners: Vec<WorldPoint> =
///     (0..8).map(|i| WorldPoint([0, 1, 2].map(|a| f64::from(i >> a & 1)))).collect();
/// io::write_tet_mesh(&path, &delaunay3(&corners)?.mesh, &[[0.0; 3]; 8], &[])?;
/// assert!(io::read_text(&path)?.contains("UnstructuredGrid"));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn write_tet_mesh(
    path: impl AsRef<Path>,
    mesh: &TetMesh,
    displacement: &[[f64; 3]],
    cell_data: &[(&str, &[f32])],
) -> Result<(), IoError> {
    write(path.as_ref(), mesh.nodes(), mesh.tetrahedra(), VTK_TETRA, (displacement, None), cell_data)
}

/// Writes a mesh through matches (mm, RAS): at each node the displacement, its `magnitude`, its
/// `sigma`, the `raw_displacement` that matching alone measured, and the `strain` where it is known
/// (xx, yy, zz, xy, xz, yz, RAS; VTK's order in the file).
///
/// # Errors
/// As [`write_tet_mesh`].
pub(crate) fn write_match_mesh(
    path: impl AsRef<Path>,
    mesh: &Mesh,
    matches: &[&Match],
    strain: Option<&[[f64; 6]]>,
) -> Result<(), IoError> {
    let displacement: Vec<[f64; 3]> = matches.iter().map(|m| m.displacement).collect();
    let measured = AtNodes {
        sigma: matches.iter().map(|m| m.sigma() as f32).collect(),
        raw: matches.iter().map(|m| m.raw.map_or(m.displacement, |raw| raw.displacement)).collect(),
        strain: strain.map(<[_]>::to_vec),
    };
    let (path, more) = (path.as_ref(), Some(&measured));
    match mesh {
        Mesh::Tetrahedra(m) => write(path, m.nodes(), m.tetrahedra(), VTK_TETRA, (&displacement, more), &[]),
        Mesh::Triangles(m) => write(path, m.nodes(), m.triangles(), VTK_TRIANGLE, (&displacement, more), &[]),
    }
}

/// Writes quadratic tetrahedra, as [`write_tet_mesh`] does linear ones.
///
/// # Errors
/// As [`write_tet_mesh`].
pub(crate) fn write_quadratic_mesh(
    path: impl AsRef<Path>,
    mesh: &QuadraticMesh,
    displacement: &[[f64; 3]],
    cell_data: &[(&str, &[f32])],
) -> Result<(), IoError> {
    write(path.as_ref(), mesh.nodes(), mesh.tetrahedra(), VTK_QUADRATIC_TETRA, (displacement, None), cell_data)
}

/// Writes triangles, as [`write_tet_mesh`] does tetrahedra.
///
/// # Errors
/// As [`write_tet_mesh`].
pub fn write_tri_mesh(
    path: impl AsRef<Path>,
    mesh: &TriMesh,
    displacement: &[[f64; 3]],
    cell_data: &[(&str, &[f32])],
) -> Result<(), IoError> {
    write(path.as_ref(), mesh.nodes(), mesh.triangles(), VTK_TRIANGLE, (displacement, None), cell_data)
}

/// What is known of the displacement at the nodes (mm).
struct AtNodes {
    sigma: Vec<f32>,
    raw: Vec<[f64; 3]>,
    strain: Option<Vec<[f64; 6]>>,
}

fn write<const N: usize>(
    path: &Path,
    nodes: &[WorldPoint],
    cells: &[[u32; N]],
    cell_type: u8,
    (displacement, more): (&[[f64; 3]], Option<&AtNodes>),
    cell_data: &[(&str, &[f32])],
) -> Result<(), IoError> {
    let fits = |name: &str, found: usize, needed: usize| match found == needed {
        true => Ok(()),
        false => Err(format(path, format!("{found} values of {name} for {needed}"), "give one for each")),
    };
    fits("displacement", displacement.len(), nodes.len())?;
    cell_data.iter().try_for_each(|(name, values)| fits(name, values.len(), cells.len()))?;

    let mut file = Appended { xml: String::new(), data: String::new() };
    let packed = file.describe(nodes, cells, cell_type, (displacement, more), cell_data);
    packed.map_err(|e| os(path, "compress")(io::Error::other(e)))?;
    write_atomic(path, |w| {
        write!(
            w,
            "<?xml version=\"1.0\"?>\n<VTKFile type=\"UnstructuredGrid\" version=\"1.0\" byte_order=\"LittleEndian\" \
             header_type=\"UInt64\" compressor=\"vtkZLibDataCompressor\">\n<UnstructuredGrid>\n\
             <Piece NumberOfPoints=\"{}\" NumberOfCells=\"{}\">\n{}</Piece>\n</UnstructuredGrid>\n\
             <AppendedData encoding=\"base64\">\n_{}\n</AppendedData>\n</VTKFile>\n",
            nodes.len(),
            cells.len(),
            file.xml,
            file.data
        )
    })
}

/// The description of the arrays, and their data.
struct Appended {
    xml: String,
    data: String,
}

type Packed = Result<(), Box<dyn std::error::Error + Send + Sync>>;

impl Appended {
    fn describe<const N: usize>(
        &mut self,
        nodes: &[WorldPoint],
        cells: &[[u32; N]],
        cell_type: u8,
        (displacement, more): (&[[f64; 3]], Option<&AtNodes>),
        cell_data: &[(&str, &[f32])],
    ) -> Packed {
        let vectors = |v: &mut dyn Iterator<Item = [f64; 3]>| bytes(v.flatten().map(|x| (x as f32).to_le_bytes()));
        let length = |d: &[f64; 3]| (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt() as f32;

        self.xml += "<PointData Vectors=\"displacement\" Scalars=\"magnitude\">\n";
        self.array("displacement", "Float32", 3, &vectors(&mut displacement.iter().copied()))?;
        self.array("magnitude", "Float32", 1, &bytes(displacement.iter().map(|d| length(d).to_le_bytes())))?;
        if let Some(AtNodes { sigma, raw, strain }) = more {
            self.array("sigma", "Float32", 1, &bytes(sigma.iter().map(|v| v.to_le_bytes())))?;
            self.array("raw_displacement", "Float32", 3, &vectors(&mut raw.iter().copied()))?;
            if let Some(strain) = strain {
                let in_vtk = strain.iter().flat_map(|&[xx, yy, zz, xy, xz, yz]| [xx, yy, zz, xy, yz, xz]);
                self.array("strain", "Float32", 6, &bytes(in_vtk.map(|v| (v as f32).to_le_bytes())))?;
            }
        }
        self.xml += "</PointData>\n<CellData>\n";
        for (name, values) in cell_data {
            self.array(name, "Float32", 1, &bytes(values.iter().map(|v| v.to_le_bytes())))?;
        }
        self.xml += "</CellData>\n<Points>\n";
        self.array("Points", "Float32", 3, &vectors(&mut nodes.iter().map(|p| p.0)))?;
        self.xml += "</Points>\n<Cells>\n";
        let connectivity = cells.iter().flatten().map(|&node| i64::from(node).to_le_bytes());
        self.array("connectivity", "Int64", 1, &bytes(connectivity))?;
        self.array("offsets", "Int64", 1, &bytes((1..=cells.len()).map(|i| ((N * i) as i64).to_le_bytes())))?;
        self.array("types", "UInt8", 1, &vec![cell_type; cells.len()])?;
        self.xml += "</Cells>\n";
        Ok(())
    }

    fn array(&mut self, name: &str, number: &str, components: usize, raw: &[u8]) -> Packed {
        let offset = self.data.len();
        writeln!(
            self.xml,
            "<DataArray type=\"{number}\" Name=\"{name}\" NumberOfComponents=\"{components}\" format=\"appended\" \
             offset=\"{offset}\"/>"
        )?;
        let mut compressor = Compressor::new(CompressionLvl::default());
        let mut header = vec![raw.len().div_ceil(BYTES_PER_BLOCK), BYTES_PER_BLOCK, raw.len() % BYTES_PER_BLOCK];
        let mut blocks = Vec::new();
        for block in raw.chunks(BYTES_PER_BLOCK) {
            let mut packed = vec![0; compressor.zlib_compress_bound(block.len())];
            let size = compressor.zlib_compress(block, &mut packed)?;
            header.push(size);
            blocks.extend_from_slice(&packed[..size]);
        }
        STANDARD.encode_string(bytes(header.iter().map(|&v| (v as u64).to_le_bytes())), &mut self.data);
        STANDARD.encode_string(blocks, &mut self.data);
        Ok(())
    }
}

fn bytes<const N: usize>(values: impl Iterator<Item = [u8; N]>) -> Vec<u8> {
    values.flatten().collect()
}
