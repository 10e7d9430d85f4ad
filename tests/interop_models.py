#!/usr/bin/env python3
"""Simulators run our exported models, and our measured displacements on a mesh of the user.

    PALPATE=target/debug/palpate python tests/interop_models.py

needs numpy, scipy, meshio and nibabel; mujoco and CalculiX (ccx) are used where they are installed. SOFA cannot be had from pip:
its scene is read back here and solved by linear tetrahedra as SOFA defines them.
"""
import csv, json, os, shutil, subprocess, sys, tempfile
import xml.etree.ElementTree as xml
import meshio, nibabel as nib, numpy as np, scipy.sparse as sparse, scipy.sparse.linalg as solver
from interop import LPS, palpate

CLOSE = 0.01        # of the largest displacement, root mean square over all nodes
FURTHEST = 0.03     # the same at the node that differs most: at the rim of a plate that sticks strain has no bound


def apart(theirs, ours):
    """Root mean square and largest difference, as parts of the largest displacement."""
    size, away = np.linalg.norm(ours, axis=1).max(), np.linalg.norm(theirs - ours, axis=1)
    return np.sqrt(np.mean(away ** 2)) / size, away.max() / size


def check(name, theirs, ours, close=CLOSE, furthest=FURTHEST):
    mean, most = apart(theirs, ours)
    print(f"{name}: {100 * mean:.2f} % apart (root mean square), {100 * most:.2f} % at most")
    assert mean < close and most < furthest, (name, mean, most)


def model(folder):
    """Places (mm) and our displacement (mm) at the nodes."""
    mesh = meshio.read(folder("mesh.vtu"))
    return mesh.points.astype(float), mesh.point_data["displacement"].astype(float)


def run_ccx(folder, name):
    out = subprocess.run(["ccx", name], cwd=folder(""), capture_output=True, text=True).stdout
    assert "Job finished" in out, out[-2000:]


def calculix(folder):
    if not shutil.which("ccx"):
        return print("skipped: ccx is not installed")
    run_ccx(folder, "model")
    _, ours = model(folder)
    with open(folder("model.dat")) as file:
        rows = [line.split() for line in file]
    rows = np.array([[float(v) for v in row] for row in rows if len(row) == 4 and row[0].isdigit()])
    check("CalculiX", rows[-len(ours):, 1:], ours)


def mujoco(folder):
    try:
        import mujoco
    except ImportError:
        return print("skipped: mujoco is not installed")
    if tuple(map(int, mujoco.__version__.split(".")[:2])) < (3, 13):
        return print(f"skipped: mujoco {mujoco.__version__} is older than 3.13")
    places, ours = model(folder)
    body = mujoco.MjModel.from_xml_path(folder("model.xml"))
    state = mujoco.MjData(body)
    nodes = [body.body(f"n{i + 1}").id for i in range(len(ours))]
    mujoco.mj_forward(body, state)
    rest = state.xpos[nodes].copy()
    assert np.allclose(rest, places * 1e-3, atol=1e-6)
    pressed, steps = body.key("pressed").ctrl.copy(), 50
    for step in range(20 * steps):
        state.ctrl[:] = pressed * min(1, (step + 1) / steps)
        mujoco.mj_step(body, state)
        # A tenth of a second on, no node would be further by a micrometre.
        if step > steps and step % 20 == 0 and np.abs(state.qvel).max() < 1e-5:
            break
    check(f"MuJoCo {mujoco.__version__} after {step + 1} steps", (state.xpos[nodes] - rest) * 1e3, ours)
    mujoco.mj_resetDataKeyframe(body, state, 0)
    mujoco.mj_forward(body, state)
    assert np.allclose((state.xpos[nodes] - rest) * 1e3, ours, atol=1e-3), "the key is not our state"
    text = """<mujoco><option integrator="discrete"/><worldbody><flexcomp name="f" type="gmsh" dim="3" file="model.msh"
      radius="1e-4"><elasticity young="1e4" poisson="0.3"/><contact selfcollide="none"/></flexcomp></worldbody></mujoco>"""
    with open(folder("flexcomp.xml"), "w") as file:
        file.write(text)
    whole = mujoco.MjModel.from_xml_path(folder("flexcomp.xml"))
    assert (whole.nflexvert, whole.nflexelem) == (len(ours), body.nflexelem), whole.nflexvert


def gmsh(folder):
    """model.msh: all nodes, positive volumes that fill the body, one group a region, a modulus each."""
    places, _ = model(folder)
    mesh = meshio.read(folder("model.msh"), file_format="gmsh")
    tetrahedra = mesh.cells_dict["tetra"]
    assert np.allclose(mesh.points, places * 1e-3, atol=1e-8)
    a, b, c, d = (mesh.points[tetrahedra[:, i]] for i in range(4))
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) > 0).all(), "an element is inside out"
    labels, modulus = mesh.cell_data["gmsh:physical"][0], mesh.cell_data["youngs_modulus"][0].ravel()
    with open(folder("regions.csv"), newline="") as file:
        rows = list(csv.DictReader(file))
    wanted = {int(r["label"]): 1e3 * float(r["youngs_modulus_kpa"]) for r in rows if r["state"] == "determined"}
    assert set(labels) == {int(r["label"]) for r in rows} and wanted
    assert all(np.allclose(modulus[labels == label], value, rtol=1e-3) for label, value in wanted.items())
    print(f"model.msh: {len(tetrahedra)} tetrahedra in {len(rows)} groups")


def solve(places, tetrahedra, young, poisson, fixed, moved):
    """Displacement of linear tetrahedra in balance; `moved` where `fixed`."""
    edges = places[tetrahedra[:, 1:]] - places[tetrahedra[:, :1]]
    inverse, volume = np.linalg.inv(edges), np.linalg.det(edges) / 6
    slopes = np.concatenate([-inverse.sum(2)[:, :, None], inverse], axis=2).transpose(0, 2, 1)
    shear, first = young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))
    pairs = np.einsum("eai,ebj->eaibj", slopes, slopes)
    stiffness = first[:, None, None, None, None] * pairs + shear[:, None, None, None, None] * pairs.transpose(0, 1, 4, 3, 2)
    along = shear[:, None, None] * np.einsum("eai,ebi->eab", slopes, slopes)
    for axis in range(3):
        stiffness[:, :, axis, :, axis] += along
    stiffness = (volume[:, None, None, None, None] * stiffness).reshape(-1, 12, 12)
    unknowns = (3 * tetrahedra[:, :, None] + np.arange(3)).reshape(-1, 12)
    rows, columns = np.repeat(unknowns, 12, axis=1).ravel(), np.tile(unknowns, (1, 12)).ravel()
    matrix = sparse.csr_matrix((stiffness.ravel(), (rows, columns)), shape=(places.size, places.size))
    out, fixed = np.where(fixed, moved, 0.0).ravel(), fixed.ravel()
    free = np.flatnonzero(~fixed)
    out[free] = solver.spsolve(matrix[free][:, free].tocsc(), -matrix[free][:, np.flatnonzero(fixed)] @ out[fixed])
    return out.reshape(-1, 3)


def sofa(folder):
    """The scene by the definition of its parts, the linear law whatever its method: it was not run by SOFA."""
    places, ours = model(folder)
    body = xml.parse(folder("model.scn")).getroot().find("Node")
    values = lambda part, key: np.array(body.find(part).get(key).split(), float)
    rest = values("MechanicalObject", "rest_position").reshape(-1, 3)
    start = values("MechanicalObject", "position").reshape(-1, 3)
    assert np.allclose(rest, places * 1e-3, atol=1e-8)
    tetrahedra = values("TetrahedronSetTopologyContainer", "tetrahedra").astype(int).reshape(-1, 4)
    listed, young, poisson = [], [], []
    for part in body.findall("Node"):
        force = part.find("TetrahedronFEMForceField")
        assert force.get("method") in ("small", "large")
        listed.append(np.array(part.find("TetrahedronSetTopologyContainer").get("tetrahedra").split(), int).reshape(-1, 4))
        young.append(np.array(force.get("youngModulus").split(), float))
        assert len(young[-1]) == len(listed[-1])
        poisson.append(np.full(len(young[-1]), float(force.get("poissonRatio"))))
    assert {tuple(t) for t in np.concatenate(listed)} == {tuple(t) for t in tetrahedra}, "tetrahedra without a material"
    tetrahedra, young, poisson = (np.concatenate(part) for part in (listed, young, poisson))
    fixed = np.zeros((len(rest), 3), bool)
    for constraint in body.findall("FixedProjectiveConstraint"):
        fixed[np.array(constraint.get("indices").split(), int)] = True
    for constraint in body.findall("PartialFixedProjectiveConstraint"):
        axes = [bool(int(v)) for v in constraint.get("fixedDirections").split()]
        fixed[np.array(constraint.get("indices").split(), int)] |= axes
    assert np.array_equal(start[~fixed], rest[~fixed]) and fixed.any()
    check("SOFA's scene by definition", 1e3 * solve(rest, tetrahedra, young, poisson, fixed, start - rest), ours)


def sliding(folder, poisson):
    """A block of two halves between plates without friction, pressed by 3 %: its field and labels."""
    affine = np.diag([1.0, 1, 1, 1])
    affine[:3, 3] = [-3, 5, 1]
    labels = np.zeros((16, 16, 16), np.uint8)
    labels[2:14, 2:14, 2:8], labels[2:14, 2:14, 8:14] = 1, 2
    nib.save(nib.Nifti1Image(labels, affine), folder("halves.nii.gz"))
    away = np.moveaxis(np.indices(labels.shape) - 7.5, 0, -1)
    motion = away * [0.03 * poisson, 0.03 * poisson, -0.03] * LPS
    image = nib.Nifti1Image(motion[:, :, :, None].astype(np.float32), affine)
    image.header.set_intent(1007)
    nib.save(image, folder("pressed.nii.gz"))
    return folder("pressed.nii.gz"), folder("halves.nii.gz")


def box(body, count):
    """A mesh of hexahedra over the voxels of a body: places (mm, RAS) and elements."""
    inside = np.argwhere(np.asarray(body.dataobj) > 0)
    low, high = inside.min(0) - 0.5, inside.max(0) + 0.5
    axes = [np.linspace(low[a], high[a], count + 1) for a in range(3)]
    points = nib.affines.apply_affine(body.affine, np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3))
    number = lambda i, j, k: (i * (count + 1) + j) * (count + 1) + k
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
    cells = [[number(i + a, j + b, k + c) for a, b, c in corners] for i in range(count) for j in range(count) for k in range(count)]
    return points, np.array(cells)


def table(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def own_mesh(folder, field, labels, poisson):
    """A mesh that meshio wrote comes back with the measured displacement; CalculiX takes the boundary conditions."""
    points, cells = box(nib.load(labels), 6)
    mesh = meshio.Mesh(points, [("hexahedron", cells)])
    for name, options in (("body.vtu", {}), ("plain.vtu", {"compression": None}), ("text.vtu", {"binary": False}), ("body.inp", {"float_fmt": ".9e"})):
        mesh.write(folder(name), **options)
        out = folder("with-" + name)
        palpate("stiffness", "--field", field, "--labels", labels, "--total-force", 3, "--nodes", 1000, "--poisson", poisson, "--mesh", folder(name),
                "-o", out)
        rows = table(os.path.join(out, "boundary.csv"))
        found = np.array([[float(row["u" + c]) for c in "xyz"] for row in rows])
        assert len(rows) == 7 ** 3 - 5 ** 3 and {row["patch"] for row in rows} == {"surface"}
        if name.endswith(".vtu"):
            again = meshio.read(os.path.join(out, "boundary.vtu"))
            given = again.point_data["prescribed"].ravel() == 1
            assert np.allclose(again.points, points, atol=1e-5) and np.allclose(again.point_data["measured_displacement"][given], found, atol=1e-5)
            assert (again.cell_data["identified_modulus"][0] > 0).all()
    print(f"meshio's .vtu (packed, plain, text) and .inp come back with {len(rows)} displacements, up to {np.linalg.norm(found, axis=1).max():.3f} mm")
    if not shutil.which("ccx"):
        return print("skipped: ccx is not installed")
    inside = lambda name: os.path.join(out, name)
    text = open(inside("boundary.inp")).read()
    with open(inside("run.inp"), "w") as file:
        # meshio names Abaqus's hybrid element, which CalculiX does not have.
        file.write(text.replace("C3D8RH", "C3D8").replace("*NODE FILE", "*NODE PRINT, NSET=ALLNODES\nU\n*NODE FILE").replace(
            "*STEP", "*NSET, NSET=ALLNODES, GENERATE\n1, 343, 1\n*STEP", 1))
    run_ccx(inside, "run")
    lines = [line.split() for line in open(inside("run.dat"))]
    moved = {int(l[0]): np.array(l[1:], float) for l in lines if len(l) == 4 and l[0].isdigit()}
    assert len(moved) == 343
    for row, u in zip(rows, found):
        assert np.allclose(moved[int(row["node"])], u, atol=1e-4), row
    print("CalculiX takes them as boundary conditions")


def covariance(folder):
    """Beside a field of palpate the covariance is that of its uncertainty."""
    palpate("phantom", "inclusion", "--size", 40, "-o", folder("pair"))
    pair = lambda name: folder("pair/" + name)
    palpate("field", pair("initial.nii.gz"), pair("deformed.nii.gz"), "--mask", pair("mask.nii.gz"), "--preset", "fast", "-o", folder("field"))
    points, cells = box(nib.load(pair("mask.nii.gz")), 3)
    meshio.Mesh(points, [("hexahedron", cells)]).write(folder("box.vtu"))
    palpate("stiffness", "--field", folder("field"), "--mask", pair("mask.nii.gz"), "--regions", 1, "--nodes", 500, "--matches", "none", "--mesh",
            folder("box.vtu"), "-o", folder("stiff"))
    rows = table(folder("stiff/boundary.csv"))
    sigma = nib.load(folder("field/uncertainty.nii.gz"))
    for row in rows:
        xx, xy, xz, yy, yz, zz = (float(row["cov_" + c]) for c in ("xx", "xy", "xz", "yy", "yz", "zz"))
        assert np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).min() > -1e-9
        voxel = nib.affines.apply_affine(np.linalg.inv(sigma.affine), [float(row[c]) for c in "xyz"]).round().astype(int)
        near = float(sigma.dataobj[tuple(np.clip(voxel, 0, np.array(sigma.shape) - 1))])
        assert 0.5 < np.sqrt((xx + yy + zz) / 3) / near < 2, (row, near)
    print(f"covariances of {len(rows)} nodes agree with uncertainty.nii.gz")


def main():
    with tempfile.TemporaryDirectory() as root:
        # MuJoCo writes its log where it runs.
        os.chdir(root)
        at = lambda name: os.path.join(root, name)
        poisson = 0.3
        palpate("phantom", "inclusion", "--size", 24, "--poisson", poisson, "--amplitude", 0.5, "--contrast", 3, "-o", at("block"))
        field, labels = at("block/truth.nii.gz"), at("block/labels.nii.gz")
        two = ["--poisson", "2=0.25"]
        for name, given, more in (
            ("stuck plates", (field, labels), []),
            ("sliding plates", sliding(at, poisson), []),
            ("two Poisson's ratios", (field, labels), two),
        ):
            print(f"{name}:")
            palpate("stiffness", "--field", given[0], "--labels", given[1], "--total-force", 3, "--nodes", 1500, "--poisson", poisson, *more, "-o", at(name))
            inside = lambda file: os.path.join(at(name), file)
            for part in (gmsh, calculix, sofa, mujoco):
                part(inside)
        own_mesh(at, field, labels, poisson)
        covariance(at)


if __name__ == "__main__":
    sys.exit(main())
