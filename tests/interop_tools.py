#!/usr/bin/env python3
"""More programs read our files, and we read theirs.

    PALPATE=target/debug/palpate python tests/interop_tools.py

needs numpy, nibabel, SimpleITK and meshio; picsl_greedy, itk-elastix and pyvista are used where they are installed.
"""
import csv, json, os, subprocess, sys, tempfile
import xml.etree.ElementTree as xml
import meshio, nibabel as nib, numpy as np, SimpleITK as sitk
from interop import LPS, moved, palpate, turned

PALPATE = os.path.abspath(os.environ.get("PALPATE", "target/debug/palpate"))


def info(path):
    out = subprocess.run([PALPATE, "info", path, "--json"], check=True, capture_output=True, text=True).stdout
    return json.loads(out)[0]


def affine_ras(image):
    """The affine of a SimpleITK image, as NIfTI has it."""
    direction = np.array(image.GetDirection()).reshape(3, 3)
    out = np.eye(4)
    out[:3, :3] = np.diag(LPS) @ direction @ np.diag(image.GetSpacing())
    out[:3, 3] = LPS * image.GetOrigin()
    return out


def formats(folder):
    """SimpleITK's NRRD and MetaImage, plain and packed, on an oblique grid, are the volume that its NIfTI is."""
    image = sitk.ReadImage(folder("initial.nii.gz"))
    field = sitk.ReadImage(folder("results/displacement.nii.gz"), sitk.sitkVectorFloat32)
    palpate("warp", folder("deformed.nii.gz"), "--field", folder("results/displacement.nii.gz"), "-o", folder("ours.nii.gz"))
    ours = nib.load(folder("ours.nii.gz")).get_fdata()
    for ending in ("nrrd", "nhdr", "mha", "mhd"):
        for packed in (False, True):
            name = folder(f"image{int(packed)}.{ending}")
            sitk.WriteImage(image, name, useCompression=packed)
            found = info(name)
            assert np.allclose(found["affine_ras"], affine_ras(image)[:3], atol=1e-4), (name, found)
            assert found["shape"] == list(image.GetSize()) and found["datatype"] == "int16", (name, found)
            low, high = sitk.MinimumMaximum(image) if hasattr(sitk, "MinimumMaximum") else found["values"]
            assert found["values"] == [low, high], (name, found)
            other = folder(f"field{int(packed)}.{ending}")
            sitk.WriteImage(field, other, useCompression=packed)
            moving = folder(f"moving{int(packed)}.{ending}")
            sitk.WriteImage(sitk.ReadImage(folder("deformed.nii.gz")), moving, useCompression=packed)
            palpate("warp", moving, "--field", other, "-o", folder("theirs.nii.gz"))
            theirs = nib.load(folder("theirs.nii.gz"))
            assert np.allclose(theirs.affine, affine_ras(image), atol=1e-4), name
            assert np.abs(theirs.get_fdata() - ours).max() < 0.5, name
    print("SimpleITK's .nrrd, .nhdr, .mha and .mhd come to the same voxels, places and field")


def nifti2(folder):
    image = nib.load(folder("initial.nii.gz"))
    nib.save(nib.Nifti2Image(np.asanyarray(image.dataobj), image.affine), folder("two.nii.gz"))
    found = info(folder("two.nii.gz"))
    assert found["format"].startswith("NIfTI-2") and np.allclose(found["affine_ras"], image.affine[:3], atol=1e-4), found
    print("nibabel's NIfTI-2 is read")


def greedy(folder):
    """greedy -r warps with our field as palpate warp does."""
    try:
        from picsl_greedy import Greedy3D
    except ImportError:
        return print("skipped: picsl_greedy is not installed")
    fixed, moving, field = folder("initial.nii.gz"), folder("deformed.nii.gz"), folder("results/displacement.nii.gz")
    Greedy3D().execute(f"-rf {fixed} -rm {moving} {folder('greedy.nii.gz')} -ri LINEAR -r {field}")
    palpate("warp", moving, "--field", field, "--interpolation", "linear", "-o", folder("ours.nii.gz"))
    inside = np.asarray(nib.load(folder("mask.nii.gz")).dataobj) > 0
    ours, theirs = (nib.load(folder(f)).get_fdata()[inside] for f in ("ours.nii.gz", "greedy.nii.gz"))
    apart, span = np.abs(ours - theirs).mean(), ours.max() - ours.min()
    still = np.abs(ours - nib.load(moving).get_fdata()[inside]).mean()
    print(f"greedy: mean difference {apart / span:.1e} of the range (doing nothing: {still / span:.1e})")
    assert apart < 5e-3 * span and apart < 0.1 * still, (apart, still, span)


def transformix(folder):
    """Points through transformix with our field go where palpate sends them."""
    try:
        import itk
        itk.transformix_pointset
    except (ImportError, AttributeError):
        return print("skipped: itk-elastix is not installed")
    field = sitk.ReadImage(folder("results/displacement.nii.gz"), sitk.sitkVectorFloat32)
    sitk.WriteImage(field, folder("field.mha"))
    size, spacing, origin, direction = field.GetSize(), field.GetSpacing(), field.GetOrigin(), field.GetDirection()
    # elastix lists the direction column by column.
    columns = np.array(direction).reshape(3, 3).T.ravel()
    text = lambda values: " ".join(repr(float(v)) for v in values)
    with open(folder("transform.txt"), "w") as out:
        out.write(f'''(Transform "DeformationFieldTransform")
(NumberOfParameters 0)
(InitialTransformParametersFileName "NoInitialTransform")
(HowToCombineTransforms "Compose")
(FixedImageDimension 3)
(MovingImageDimension 3)
(FixedInternalImagePixelType "float")
(MovingInternalImagePixelType "float")
(Size {" ".join(map(str, size))})
(Index 0 0 0)
(Spacing {text(spacing)})
(Origin {text(origin)})
(Direction {text(columns)})
(UseDirectionCosines "true")
(DeformationFieldFileName "{folder("field.mha")}")
(DeformationFieldInterpolationOrder 1)
(ResampleInterpolator "FinalLinearInterpolator")
(Resampler "DefaultResampler")
(DefaultPixelValue 0)
(ResultImagePixelType "float")
(ResultImageFormat "mha")
(CompressResultImage "false")
''')
    rng = np.random.default_rng(3)
    inside = np.argwhere(np.asarray(nib.load(folder("mask.nii.gz")).dataobj) > 0)
    voxels = inside[rng.choice(len(inside), 40, replace=False)]
    points = nib.affines.apply_affine(nib.load(folder("initial.nii.gz")).affine, voxels)
    with open(folder("points.txt"), "w") as out:
        out.write(f"point\n{len(points)}\n" + "\n".join(" ".join(f"{v:.6f}" for v in p) for p in points * LPS) + "\n")
    np.savetxt(folder("points.csv"), points, delimiter=",", fmt="%.6f", header="x,y,z", comments="")
    parameters = itk.ParameterObject.New()
    parameters.AddParameterFile(folder("transform.txt"))
    image = itk.imread(folder("initial.nii.gz"), itk.F)
    os.makedirs(folder("transformix"), exist_ok=True)
    itk.transformix_pointset(
        image, parameters, fixed_point_set_file_name=folder("points.txt"), output_directory=folder("transformix"))
    with open(folder("transformix/outputpoints.txt")) as file:
        rows = [line.split("OutputPoint = [")[1].split("]")[0].split() for line in file if "OutputPoint" in line]
    theirs = np.array(rows, float) * LPS
    palpate("warp", "--points", folder("points.csv"), "--field", folder("results/displacement.nii.gz"), "-o", folder("moved.csv"))
    with open(folder("moved.csv"), newline="") as file:
        ours = np.array([[float(row[c]) for c in "xyz"] for row in csv.DictReader(file)])
    apart, motion = np.abs(ours - theirs).max(), np.linalg.norm(ours - points, axis=1).max()
    print(f"transformix: points at most {apart:.1e} mm apart, motion up to {motion:.2f} mm")
    assert motion > 0.5 and apart < 5e-3


def markups(folder):
    """The point lists hold what Slicer's markups schema asks for, in LPS."""
    for deformed in (False, True):
        palpate("markups", folder("results/matches.csv"), "-o", folder("m.mrk.json"), "--most", 50, *["--deformed"] * deformed)
        file = json.load(open(folder("m.mrk.json")))
        assert "markups-schema-v1" in file["@schema"] and len(file["markups"]) == 1
        points = file["markups"][0]
        assert (points["type"], points["coordinateSystem"], points["coordinateUnits"]) == ("Fiducial", "LPS", "mm")
        with open(folder("results/matches.csv"), newline="") as table:
            rows = [r for r in csv.DictReader(table) if r["kept"] == "1"]
        first = np.array([float(rows[0][c]) for c in "xyz"])
        first += deformed * np.array([float(rows[0]["d" + c]) for c in "xyz"])
        assert np.allclose(np.array(points["controlPoints"][0]["position"]) * LPS, first, atol=1e-5)
        assert 0 < len(points["controlPoints"]) <= 50
        keys = {"id": str, "label": str, "description": str, "position": list, "orientation": list, "selected": bool,
                "locked": bool, "visibility": bool, "positionStatus": str}
        for point in points["controlPoints"]:
            assert all(type(point[key]) is kind for key, kind in keys.items()), point
            assert len(point["position"]) == 3 and len(point["orientation"]) == 9
    print("Slicer's point lists hold the matches in LPS")


def grid_transform(folder):
    """Slicer takes a grid transform as ITK's displacement field image: three components, LPS, from the fixed grid."""
    field = sitk.ReadImage(folder("results/displacement.nii.gz"))
    assert field.GetDimension() == 3 and field.GetNumberOfComponentsPerPixel() == 3, field
    transform = sitk.DisplacementFieldTransform(sitk.Cast(field, sitk.sitkVectorFloat64))
    sitk.WriteTransform(transform, folder("grid.h5"))
    again = sitk.ReadTransform(folder("grid.h5"))
    point = field.TransformIndexToPhysicalPoint([s // 2 for s in field.GetSize()])
    assert np.allclose(again.TransformPoint(point), transform.TransformPoint(point))
    print("The field is ITK's grid transform, also after writing it as one")


def meshes(folder):
    """meshio (and pyvista, VTK's own reader) open mesh.vtu of a field and of a stiffness run."""
    mesh = meshio.read(folder("results/mesh.vtu"))
    counts = json.load(open(folder("results/summary.json")))["counts"]
    assert len(mesh.points) == counts["nodes"] and len(mesh.cells_dict["tetra"]) == counts["tetrahedra"]
    length = np.linalg.norm(mesh.point_data["displacement"], axis=1)
    assert np.allclose(length, mesh.point_data["magnitude"].ravel(), atol=1e-4) and length.max() > 0.5
    a, b, c, d = (mesh.points[mesh.cells_dict["tetra"][:, i]] for i in range(4))
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) > 0).all(), "an element is inside out"
    solid = meshio.read(folder("stiffness/mesh.vtu"))
    assert "tetra10" in solid.cells_dict and "youngs_modulus" in solid.cell_data
    try:
        import pyvista
    except ImportError:
        return print("meshio opens both meshes; skipped: pyvista is not installed")
    grid = pyvista.read(folder("stiffness/mesh.vtu"))
    assert grid.n_cells == len(solid.cells_dict["tetra10"]) and grid.volume > 0
    print("meshio and pyvista open both meshes")


def febio(folder):
    """model.feb is FEBio 4: its sections, and no name or number that is not there."""
    root = xml.parse(folder("stiffness/model.feb")).getroot()
    assert root.tag == "febio_spec" and root.get("version") == "4.0", root.attrib
    names = [part.tag for part in root]
    for needed in ("Module", "Control", "Material", "Mesh", "MeshDomains", "Boundary", "Output"):
        assert needed in names, (needed, names)
    mesh = root.find("Mesh")
    nodes = {int(n.get("id")) for n in mesh.iter("node")}
    assert len(nodes) > 100 and all(len(n.text.split(",")) == 3 for n in mesh.iter("node"))
    materials = {m.get("name") for m in root.find("Material")}
    parts = {e.get("name"): e for e in mesh.findall("Elements")}
    for part in parts.values():
        assert part.get("type") == "tet10"
        for element in part:
            corners = [int(v) for v in element.text.split(",")]
            assert len(corners) == 10 and set(corners) <= nodes
    for domain in root.find("MeshDomains"):
        assert domain.get("name") in parts and domain.get("mat") in materials, domain.attrib
    assert len(root.find("MeshDomains")) == len(parts)
    sets = {s.get("name") for kind in ("NodeSet", "Surface") for s in mesh.findall(kind)}
    for condition in root.find("Boundary"):
        assert condition.get("node_set").split(":")[-1] in sets, condition.attrib
    print(f"model.feb: {len(parts)} parts, {len(nodes)} nodes, nothing is named that is not there")


def main():
    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    with tempfile.TemporaryDirectory() as root:
        folder = lambda name: os.path.join(root, name)
        palpate("phantom", "block", "--size", 40, "--amplitude", 3, "-o", folder("pair"))
        for f in ("initial", "mask", "deformed"):
            nib.save(moved(nib.load(folder(f"pair/{f}.nii.gz")), turned), folder(f + ".nii.gz"))
        palpate("field", folder("initial.nii.gz"), folder("deformed.nii.gz"), "--mask", folder("mask.nii.gz"), "-o", folder("results"))
        palpate("phantom", "inclusion", "--size", 24, "-o", folder("block"))
        palpate("stiffness", "--field", folder("block/truth.nii.gz"), "--labels", folder("block/labels.nii.gz"),
                "--total-force", 3, "--nodes", 1500, "-o", folder("stiffness"))
        for check in (formats, nifti2, greedy, transformix, markups, grid_transform, meshes, febio):
            check(folder)


if __name__ == "__main__":
    sys.exit(main())
