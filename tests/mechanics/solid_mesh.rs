//! A user's own mesh: read from each format, measured at its nodes, written with what was measured.

use crate::fixtures::run;
use base64::{Engine, engine::general_purpose::STANDARD};
use palpate::io::{self, SolidFile};
use palpate::pipeline::boundary::{Known, at_nodes};
use palpate::types::{
    Affine, DenseField, ElementModulus, ErrorSamples, Grid, Mask, Measured, MeasuredNode, SolidShape, Volume,
};
use std::fs;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// Corners of two cubes of 4 mm on each other.
const PLACES: [[f64; 3]; 12] = [
    [1.0, 9.0, 5.0],
    [5.0, 9.0, 5.0],
    [5.0, 13.0, 5.0],
    [1.0, 13.0, 5.0],
    [1.0, 9.0, 9.0],
    [5.0, 9.0, 9.0],
    [5.0, 13.0, 9.0],
    [1.0, 13.0, 9.0],
    [1.0, 9.0, 13.0],
    [5.0, 9.0, 13.0],
    [5.0, 13.0, 13.0],
    [1.0, 13.0, 13.0],
];
const CUBES: [[usize; 8]; 2] = [[0, 1, 2, 3, 4, 5, 6, 7], [4, 5, 6, 7, 8, 9, 10, 11]];

fn joined<T: ToString>(values: impl IntoIterator<Item = T>, by: &str) -> String {
    values.into_iter().map(|v| v.to_string()).collect::<Vec<_>>().join(by)
}

/// The cubes for Abaqus, with numbers that neither begin at 1 nor follow each other.
fn inp() -> String {
    let node = |(n, p): (usize, &[f64; 3])| format!("{}, {}\n", 10 * n + 7, joined(p, ", "));
    let nodes: String = PLACES.iter().enumerate().map(node).collect();
    let cube = |(e, c): (usize, &[usize; 8])| format!("{}, {}\n", 100 + e, joined(c.map(|n| 10 * n + 7), ", "));
    let cubes: String = CUBES.iter().enumerate().map(cube).collect();
    let shell = "*ELEMENT, TYPE=S4\n300, 7, 17, 27, 37\n";
    format!(
        "*HEADING\ntwo cubes\n*NODE\n{nodes}{shell}** solid\n*Element, type=C3D8R, elset=BODY\n{cubes}*NSET, NSET=Held\n7, 17,\n27, 37\n*NSET, NSET=LOADED, GENERATE\n87, 117, 10\n"
    )
}

/// The cubes for FEBio.
fn feb(version: &str) -> String {
    let node = |(n, p): (usize, &[f64; 3])| format!("<node id=\"{}\">{}</node>\n", n + 1, joined(p, ","));
    let nodes: String = PLACES.iter().enumerate().map(node).collect();
    let cube =
        |(e, c): (usize, &[usize; 8])| format!("<elem id=\"{}\">{}</elem>\n", e + 1, joined(c.map(|n| n + 1), ","));
    let cubes: String = CUBES.iter().enumerate().map(cube).collect();
    let held = match version {
        "3.0" => "<node id=\"1\"/><node id=\"2\"/>",
        _ => "1,2",
    };
    format!(
        "<?xml version=\"1.0\"?>\n<febio_spec version=\"{version}\">\n\t<Module type=\"solid\"/>\n\t<Mesh>\n<Nodes>\n{nodes}</Nodes>\n\
         <Elements type=\"hex8\" name=\"body\">\n{cubes}</Elements>\n<NodeSet name=\"held\">{held}</NodeSet>\n\t</Mesh>\n\
         \t<MeshDomains><SolidDomain name=\"body\" mat=\"m\"/></MeshDomains>\n</febio_spec>\n"
    )
}

/// The cubes for VTK, with arrays as text, in base64, or appended and raw.
fn vtu(form: &str) -> Vec<u8> {
    let f64s = |v: &[f64]| v.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
    let i64s = |v: &[i64]| v.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
    let connectivity: Vec<i64> = CUBES.iter().flatten().map(|&n| n as i64).collect();
    let places: Vec<f64> = PLACES.iter().flatten().copied().collect();
    let held = [1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    let arrays = [
        ("held", "Float64", 1, joined(held, " "), f64s(&held)),
        ("Points", "Float64", 3, joined(&places, " "), f64s(&places)),
        ("connectivity", "Int64", 1, joined(&connectivity, " "), i64s(&connectivity)),
        ("offsets", "Int64", 1, "8 16".into(), i64s(&[8, 16])),
        ("types", "UInt8", 1, "12 12".into(), vec![12, 12]),
    ];
    let mut appended = Vec::new();
    let mut array = |i: usize| {
        let (name, kind, components, text, bytes) = &arrays[i];
        let size = (bytes.len() as u32).to_le_bytes().to_vec();
        let head = format!("<DataArray type=\"{kind}\" Name=\"{name}\" NumberOfComponents=\"{components}\"");
        match form {
            "ascii" => format!("{head} format=\"ascii\">{text}</DataArray>"),
            "binary" => {
                format!("{head} format=\"binary\">{}</DataArray>", STANDARD.encode([&size[..], bytes].concat()))
            }
            "padded" => {
                format!("{head} format=\"binary\">{}{}</DataArray>", STANDARD.encode(&size), STANDARD.encode(bytes))
            }
            _ => {
                let at = appended.len();
                appended.extend([&size[..], bytes].concat());
                format!("{head} format=\"appended\" offset=\"{at}\"/>")
            }
        }
    };
    let held = array(0);
    let points = array(1);
    let cells: String = (2..5).map(&mut array).collect();
    let start = format!(
        "<?xml version=\"1.0\"?>\n<VTKFile type=\"UnstructuredGrid\" version=\"0.1\" byte_order=\"LittleEndian\" header_type=\"UInt32\">\n\
         <UnstructuredGrid><Piece NumberOfPoints=\"12\" NumberOfCells=\"2\">\n<PointData>{held}</PointData>\n<CellData/>\n\
         <Points>{points}</Points>\n<Cells>{cells}</Cells>\n</Piece></UnstructuredGrid>\n"
    );
    let mut out = start.into_bytes();
    if form == "raw" {
        out.extend(b"<AppendedData encoding=\"raw\">\n_");
        out.extend(appended);
        out.extend(b"\n</AppendedData>\n");
    }
    out.extend(b"</VTKFile>\n");
    out
}

/// Every form of the cubes, by file name.
fn all() -> Vec<(&'static str, Vec<u8>)> {
    vec![
        ("a.inp", inp().into_bytes()),
        ("three.feb", feb("3.0").into_bytes()),
        ("four.feb", feb("4.0").into_bytes()),
        ("ascii.vtu", vtu("ascii")),
        ("binary.vtu", vtu("binary")),
        ("padded.vtu", vtu("padded")),
        ("raw.vtu", vtu("raw")),
    ]
}

fn put(folder: &TempDir, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.path().join(name);
    fs::write(&path, bytes).unwrap();
    path
}

fn measured() -> Measured {
    let node = |n: u32| MeasuredNode {
        node: n,
        patch: "held".into(),
        displacement: [0.1, -0.2, 0.01 * f64::from(n)],
        covariance: Some([4e-4, 1e-5, 2e-5, 5e-4, 3e-5, 6e-4]),
    };
    let soft = ElementModulus { label: 2, modulus: 12.5, poisson: 0.3 };
    Measured { nodes: vec![node(0), node(3)], elements: vec![Some(soft), None] }
}

#[test]
fn every_format_holds_the_same_mesh_and_keeps_it() {
    let folder = TempDir::new().unwrap();
    for (name, bytes) in all() {
        let file = SolidFile::read(put(&folder, name, &bytes)).unwrap();
        let mesh = file.mesh();
        assert_eq!(mesh.nodes().iter().map(|p| p.0).collect::<Vec<_>>(), PLACES, "{name}");
        assert_eq!(mesh.elements().len(), 2, "{name}");
        for (element, cube) in mesh.elements().iter().zip(CUBES) {
            assert_eq!(element.shape, SolidShape::Hexahedron, "{name}");
            assert_eq!(element.nodes, cube.map(|n| n as u32), "{name}");
        }
        assert_eq!(mesh.surface(), (0..12).collect::<Vec<u32>>(), "{name}");
        assert_eq!(mesh.centroid(&mesh.elements()[1]).0, [3.0, 11.0, 11.0], "{name}");
        assert_eq!(mesh.sets()[0].0.to_lowercase(), "held", "{name}");
        let out = folder.path().join(format!("with.{}", file.ending()));
        file.write(&out, &measured()).unwrap();
        let again = SolidFile::read(&out).unwrap();
        let same =
            |f: &SolidFile| (f.mesh().nodes().to_vec(), f.mesh().elements().to_vec(), f.mesh().numbers().to_vec());
        assert_eq!(same(&again), same(&file), "{name}");
        // Nothing that was there is gone.
        let (old, new) = (String::from_utf8_lossy(&bytes).into_owned(), fs::read(&out).unwrap());
        let new = String::from_utf8_lossy(&new).into_owned();
        let lost: Vec<&str> =
            old.lines().filter(|l| *l != "<CellData/>" && !new.contains(l.trim_end_matches("</PointData>"))).collect();
        assert!(lost.is_empty(), "{name}: {lost:?}");
    }
}

#[test]
fn each_format_says_what_was_measured() {
    let folder = TempDir::new().unwrap();
    let written = |name: &str, bytes: &[u8]| {
        let file = SolidFile::read(put(&folder, name, bytes)).unwrap();
        let out = folder.path().join(format!("with.{}", file.ending()));
        file.write(&out, &measured()).unwrap();
        String::from_utf8_lossy(&fs::read(out).unwrap()).into_owned()
    };
    let text = written("a.inp", inp().as_bytes());
    for part in [
        "7, 1, 1, 1.000000000e-1",
        "37, 3, 3, 3.000000000e-2",
        "ELSET=PALPATE2\n100,",
        "*ELASTIC\n1.250000000e-2, 0.3",
        "*STEP\n*STATIC\n",
    ] {
        assert!(text.contains(part), "{part}: {text}");
    }
    // A file with a step gets the displacements in it, one with sections keeps its materials, and
    // one with an instance names the node in it.
    let stepped = inp() + "*SOLID SECTION, ELSET=BODY, MATERIAL=M\n*STEP\n*STATIC\n*END STEP\n";
    let text = written("stepped.inp", stepped.as_bytes());
    assert_eq!(text.matches("*STEP").count(), 1);
    assert!(!text.contains("PALPATE2") && text.find("*BOUNDARY") < text.find("*END STEP"), "{text}");
    let text = written("part.inp", (inp() + "*INSTANCE, NAME=Part-1-1, PART=P\n*END INSTANCE\n").as_bytes());
    assert!(text.contains("Part-1-1.7, 1, 1, ") && !text.contains("PALPATE2"), "{text}");
    for (version, kind) in [("3.0", "type=\"prescribe\""), ("4.0", "type=\"prescribed displacement\"")] {
        let text = written("a.feb", feb(version).as_bytes());
        for part in
            [kind, "<NodeSet name=\"palpate1\">", "<node lid=\"2\">3.000000000e-2</node>", "<load_controller id=\"1\""]
        {
            assert!(text.contains(part), "{part}: {text}");
        }
        let places =
            ["<Mesh>", "<MeshDomains>", "<MeshData>", "<Boundary>", "<LoadData>"].map(|s| text.find(s).unwrap());
        assert!(places.is_sorted(), "{text}");
    }
    let file = SolidFile::read(folder.path().join("a.inp")).unwrap();
    io::write_boundary(folder.path().join("b.csv"), file.mesh(), &measured()).unwrap();
    let table = fs::read_to_string(folder.path().join("b.csv")).unwrap();
    assert!(
        table.starts_with("node,x,y,z,ux,uy,uz,cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz,patch\n7,1.000000,"),
        "{table}"
    );
    io::write_element_moduli(folder.path().join("e.csv"), file.mesh(), &measured()).unwrap();
    let table = fs::read_to_string(folder.path().join("e.csv")).unwrap();
    assert!(
        table.ends_with("100,3.000000,11.000000,7.000000,2,12.500000\n101,3.000000,11.000000,11.000000,,\n"),
        "{table}"
    );
}

#[test]
fn bad_meshes_are_refused_with_what_is_wrong() {
    let folder = TempDir::new().unwrap();
    let refused = |name: &str, bytes: &[u8], parts: &[&str]| {
        let error = SolidFile::read(put(&folder, name, bytes)).unwrap_err().to_string();
        assert!(error.contains(name), "{error}");
        parts.iter().for_each(|p| assert!(error.contains(p), "{p}: {error}"));
    };
    refused("mesh.stl", b"solid", &[".vtu"]);
    refused("none.inp", b"*NODE\n1, 0, 0, 0\n", &["no tetrahedron"]);
    refused("nan.inp", b"*NODE\n1, 0, x, 0\n", &["line 2", "\"x\""]);
    refused("twice.inp", b"*NODE\n1, 0, 0, 0\n1, 1, 0, 0\n", &["line 3", "node 1 is given twice"]);
    refused("far.inp", b"*NODE\n1, 0, 0, 0\n*ELEMENT, TYPE=C3D4\n1, 1, 1, 1, 9\n", &["line 4", "node 9"]);
    refused("wedge.inp", b"*NODE\n1, 0, 0, 0\n*ELEMENT, TYPE=C3D6\n", &["C3D6", "C3D10"]);
    refused("more.inp", b"*INCLUDE, INPUT=other.inp\n", &["another file"]);
    refused("short.inp", b"*NODE\n1, 0, 0, 0\n*ELEMENT, TYPE=C3D4\n1, 1, 1\n", &["within an element"]);
    refused("polar.inp", b"*NODE, SYSTEM=C\n1, 0, 0, 0\n", &["Cartesian"]);
    refused("old.feb", feb("2.5").as_bytes(), &["2.5", "FEBio Studio"]);
    refused("open.feb", b"<febio_spec version=\"4.0\"><Mesh>", &["XML"]);
    refused("odd.feb", feb("4.0").replace("hex8", "penta6").as_bytes(), &["penta6"]);
    refused("gap.feb", feb("4.0").replace(",12</elem>", ",99</elem>").as_bytes(), &["node 99"]);
    let text = String::from_utf8(vtu("ascii")).unwrap();
    refused("big.vtu", text.replace("Little", "Big").as_bytes(), &["big-endian"]);
    refused("wedge.vtu", text.replace("12 12", "13 12").as_bytes(), &["type 13"]);
    refused("point.vtu", text.replace("8 9 10 11<", "8 9 10 99<").as_bytes(), &["node 99"]);
    refused("many.vtu", text.replace("8 16", "8 1600").as_bytes(), &["cell 1"]);
    refused("lz4.vtu", text.replace("version=\"0.1\"", "compressor=\"vtkLZ4DataCompressor\"").as_bytes(), &["vtkLZ4"]);
    refused("poly.vtu", text.replace("UnstructuredGrid\"", "PolyData\"").as_bytes(), &["unstructured grid"]);
    // A header that claims four gigabytes, or blocks without end, asks for no memory.
    let claims = STANDARD.encode([0xff; 16]);
    let text = String::from_utf8(vtu("binary")).unwrap();
    let start = text.find("Name=\"Points\"").unwrap();
    let from = start + text[start..].find('>').unwrap() + 1;
    for packed in ["", " compressor=\"vtkZLibDataCompressor\""] {
        let claimed = format!("{}{claims}{}", &text[..from], &text[from + claims.len()..]);
        let claimed = claimed.replace(" header_type", &format!("{packed} header_type"));
        refused("claims.vtu", claimed.as_bytes(), &["damaged"]);
    }
}

/// No cut and no changed byte makes the reader panic.
#[test]
fn damaged_meshes_are_read_or_refused() {
    let folder = TempDir::new().unwrap();
    for (name, bytes) in all() {
        for at in (0..bytes.len()).step_by(7) {
            let _ = SolidFile::read(put(&folder, name, &bytes[..at]));
            let mut changed = bytes.clone();
            changed[at] ^= 1 << (at % 8);
            if let Ok(file) = SolidFile::read(put(&folder, name, &changed)) {
                let nodes = file.mesh().nodes().len() as u32;
                let whole =
                    Measured { nodes: measured().nodes.into_iter().filter(|m| m.node < nodes).collect(), ..measured() };
                let _ = file.write(folder.path().join(format!("out.{}", file.ending())), &whole);
            }
        }
    }
}

fn grid() -> Grid {
    Grid::new([16; 3], Affine::scaled([1.0; 3], [-3.0, 5.0, 1.0]).unwrap()).unwrap()
}

#[test]
fn a_linear_field_is_found_again_with_its_covariance() {
    let folder = TempDir::new().unwrap();
    let file = SolidFile::read(put(&folder, "a.inp", inp().as_bytes())).unwrap();
    let g = grid();
    let body = Mask::from_voxels(g, |o, _| u8::from(g.voxel(o).into_iter().all(|i| (4..13).contains(&i))));
    let motion = |p: [f64; 3]| [0.1 + 0.02 * p[2], -0.03 * p[0], 0.01 * p[1]];
    // What lies outside of the body is not read.
    let inside =
        |p: [f64; 3]| g.affine().to_voxel(palpate::types::WorldPoint(p)).0.iter().all(|v| (3.5..12.5).contains(v));
    let field = DenseField::from_fn(g, |p| if inside(p.0) { motion(p.0) } else { [99.0; 3] });
    let deviation = Volume::filled(g, 0.2f32);
    let nodes = file.mesh().surface();
    let known = Known { field: &field, body: &body, deviation: Some(&deviation), draws: None };
    let found = at_nodes(&known, file.mesh(), &nodes, "surface");
    assert_eq!(found.len(), 12);
    for m in &found {
        let wanted = motion(PLACES[m.node as usize]);
        (0..3).for_each(|a| assert!((m.displacement[a] - wanted[a]).abs() < 1e-5, "{m:?}"));
        let c = m.covariance.unwrap();
        let round = [0.04, 0.0, 0.0, 0.04, 0.0, 0.04];
        assert!(c.iter().zip(round).all(|(a, b)| (a - b).abs() < 1e-6), "{c:?}");
    }
    // Draws along (1, 1, 0) give the covariance that direction, and the map its size.
    let lattice = Grid::new([5; 3], Affine::scaled([4.0; 3], [-3.0, 5.0, 1.0]).unwrap()).unwrap();
    let draw = |s: f32| [vec![s; 250], vec![0.0; 125]].concat();
    let draws = ErrorSamples::new(lattice, vec![draw(1.0), draw(-2.0)]).unwrap();
    let known = Known { draws: Some(&draws), ..known };
    let c = at_nodes(&known, file.mesh(), &nodes, "surface")[0].covariance.unwrap();
    let wanted = [0.06, 0.06, 0.0, 0.06, 0.0, 0.0];
    assert!(c.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 1e-6), "{c:?}");
    // A body that ends below the upper cube leaves its top free.
    let low = Mask::from_voxels(g, |o, _| u8::from(body.as_slice()[o] > 0 && g.voxel(o)[2] < 9));
    let known = Known { body: &low, ..known };
    let found = at_nodes(&known, file.mesh(), &nodes, "surface");
    assert_eq!(found.iter().map(|m| m.node).collect::<Vec<_>>(), (0..8).collect::<Vec<u32>>());
}

/// A block of 12 mm pressed by 3 %, and its mask.
fn pressed() -> TempDir {
    let folder = TempDir::new().unwrap();
    let g = grid();
    let body = |o: usize| g.voxel(o).into_iter().all(|i| (2..14).contains(&i));
    let field = DenseField::from_fn(g, |p| [0.009 * p.0[0], 0.009 * p.0[1], -0.03 * p.0[2]]);
    io::write_field(folder.path().join("field.nii.gz"), &field).unwrap();
    io::write_labels(folder.path().join("labels.nii.gz"), &Mask::from_voxels(g, |o, _| u8::from(body(o))), "").unwrap();
    folder
}

const BASE: [&str; 13] = [
    "stiffness",
    "--field",
    "field.nii.gz",
    "--labels",
    "labels.nii.gz",
    "--nodes",
    "500",
    "--poisson",
    "0.3",
    "--force",
    "0.1",
    "-o",
    "results",
];

fn stiffness(folder: &Path, more: &[&str], code: i32) -> (String, String) {
    run(folder, &[&BASE, more].concat(), code)
}

#[test]
fn a_run_writes_the_mesh_with_its_boundary() {
    let folder = pressed();
    put(&folder, "body.inp", inp().as_bytes());
    let (_, err) = stiffness(folder.path(), &["--mesh", "body.inp", "--mesh-set", "held", "--mesh-set", "LOADED"], 0);
    assert!(err.contains("body.inp: the covariance is not known"), "{err}");
    let results = folder.path().join("results");
    let table = fs::read_to_string(results.join("boundary.csv")).unwrap();
    let rows: Vec<Vec<&str>> = table.lines().skip(1).map(|l| l.split(',').collect()).collect();
    assert_eq!(rows.iter().map(|r| r[13]).collect::<Vec<_>>(), [["Held"; 4], ["LOADED"; 4]].concat());
    for row in &rows {
        let v: Vec<f64> = row[1..7].iter().map(|v| v.parse().unwrap()).collect();
        assert!((v[5] + 0.03 * v[2]).abs() < 2e-3 && (v[3] - 0.009 * v[0]).abs() < 2e-3, "{row:?}");
    }
    let moduli = fs::read_to_string(results.join("elements.csv")).unwrap();
    let modulus: f64 = moduli.lines().nth(1).unwrap().rsplit(',').next().unwrap().parse().unwrap();
    assert!((modulus / (0.1 / (144.0 * 0.03) * 1000.0) - 1.0).abs() < 0.1, "{moduli}");
    assert!(fs::read_to_string(results.join("boundary.inp")).unwrap().contains("PALPATE1"));
    // What an earlier mesh left does not stay.
    stiffness(folder.path(), &["--overwrite"], 0);
    assert!(!results.join("boundary.inp").exists() && !results.join("boundary.csv").exists());
}

#[test]
fn a_mesh_that_cannot_be_used_is_told_before_any_work() {
    let folder = pressed();
    put(&folder, "body.inp", inp().as_bytes());
    let refused = |more: &[&str], code: i32, parts: &[&str]| {
        let (_, err) = stiffness(folder.path(), more, code);
        parts.iter().for_each(|p| assert!(err.contains(p), "{p}: {err}"));
        assert!(!folder.path().join("results").exists());
    };
    refused(&["--mesh", "body.inp", "--mesh-set", "TOP"], 1, &["body.inp", "\"TOP\"", "Held, LOADED"]);
    refused(&["--mesh", "nowhere.vtu"], 1, &["nowhere.vtu"]);
    refused(&["--mesh-set", "TOP"], 2, &["--mesh"]);
    let far = String::from_utf8(vtu("ascii")).unwrap();
    let shifted = PLACES.map(|p| joined(p.map(|v| v + 500.0), " ")).join(" ");
    let start = far.find("Name=\"Points\"").unwrap();
    let from = start + far[start..].find('>').unwrap() + 1;
    let to = from + far[from..].find('<').unwrap();
    put(&folder, "far.vtu", format!("{}{shifted}{}", &far[..from], &far[to..]).as_bytes());
    refused(&["--mesh", "far.vtu"], 1, &["far.vtu", "world mm, RAS", "x 501.0 to 505.0"]);
    refused(&["--mesh", "far.vtu", "--dry-run"], 1, &["world mm, RAS"]);
}
