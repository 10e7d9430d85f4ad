#!/usr/bin/env python3
"""Other tools read our files: nibabel, ANTs (antspyx) and SimpleITK warp with displacement.nii.gz as `palpate warp` does.

    PALPATE=target/debug/palpate python tests/interop.py

needs numpy, nibabel, SimpleITK and antspyx. One synthetic pair is put on several grids without resampling (the affine
changes, or an axis is flipped in memory), measured, and the deformed volume and some points are warped by each tool.
"""
import csv, json, os, subprocess, sys, tempfile
import ants, nibabel as nib, numpy as np, pandas as pd, SimpleITK as sitk

PALPATE = os.path.abspath(os.environ.get("PALPATE", "target/debug/palpate"))
IMAGE_TOLERANCE = 1e-3      # mean absolute difference inside the mask, as a part of the intensity range
POINT_TOLERANCE = 2e-3      # mm
LPS = np.array([-1.0, -1.0, 1.0])


def palpate(*arguments):
    subprocess.run([PALPATE, *map(str, arguments), "--quiet"], check=True, stdout=subprocess.DEVNULL)


def turned(affine):
    """The affine seen from a patient who lies askew: 20 degrees about an oblique axis, and elsewhere."""
    axis, angle = np.array([0.3, -0.5, 0.81]), np.deg2rad(20)
    axis = axis / np.linalg.norm(axis)
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    out = np.eye(4)
    out[:3, :3] = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
    out[:3, 3] = [12.5, -31.0, 7.25]
    return out @ affine


def flipped(image, axis):
    """The same voxels in the same places, stored the other way round along one axis."""
    flip = np.eye(4)
    flip[axis, axis], flip[axis, 3] = -1, image.shape[axis] - 1
    return nib.Nifti1Image(np.flip(np.asanyarray(image.dataobj), axis), image.affine @ flip)


def moved(image, to_affine):
    return nib.Nifti1Image(np.asanyarray(image.dataobj), to_affine(image.affine))


GRIDS = {
    "plain": (lambda i: i, lambda i: i),
    "oblique": (lambda i: moved(i, turned), lambda i: moved(i, turned)),
    "flipped": (lambda i: flipped(flipped(i, 0), 2), lambda i: flipped(flipped(i, 0), 2)),
    "oblique, the deformed one flipped": (lambda i: moved(i, turned), lambda i: flipped(moved(i, turned), 1)),
}


def warp_with_ants(fixed, moving, field):
    out = ants.apply_transforms(ants.image_read(fixed), ants.image_read(moving), [field], interpolator="linear")
    return out.numpy()


def warp_with_sitk(fixed, moving, transform):
    out = sitk.Resample(sitk.ReadImage(moving, sitk.sitkFloat64), sitk.ReadImage(fixed), transform, sitk.sitkLinear, 0.0)
    return np.transpose(sitk.GetArrayFromImage(out))


def check(name, folder, pair, to_initial, to_deformed):
    path = lambda f: os.path.join(folder, f)
    for f, change in (("initial", to_initial), ("mask", to_initial), ("deformed", to_deformed)):
        nib.save(change(nib.load(os.path.join(pair, f + ".nii.gz"))), path(f + ".nii.gz"))
    fixed, moving, field = path("initial.nii.gz"), path("deformed.nii.gz"), path("results/displacement.nii.gz")
    palpate("field", fixed, moving, "--mask", path("mask.nii.gz"), "-o", path("results"))
    palpate("warp", moving, "--field", field, "--interpolation", "linear", "-o", path("ours.nii.gz"))

    header = nib.load(field)
    initial = nib.load(fixed)
    assert header.shape == (*initial.shape, 1, 3) and header.header["intent_code"] == 1007, header.shape
    assert np.allclose(header.affine, initial.affine, atol=1e-4)

    inside = np.asarray(nib.load(path("mask.nii.gz")).dataobj) > 0
    ours = nib.load(path("ours.nii.gz")).get_fdata()
    span = ours[inside].max() - ours[inside].min()
    nothing = np.abs(initial.get_fdata() - nib.load(path("deformed.nii.gz")).get_fdata())[inside].mean() / span
    transform = sitk.DisplacementFieldTransform(sitk.ReadImage(field, sitk.sitkVectorFloat64))
    theirs = {"ANTs": warp_with_ants(fixed, moving, field), "SimpleITK": warp_with_sitk(fixed, moving, transform)}
    image = {tool: np.abs(ours - other)[inside].mean() / span for tool, other in theirs.items()}

    rng = np.random.default_rng(1)
    voxels = np.argwhere(inside)
    voxels = voxels[rng.choice(len(voxels), 50, replace=False)] + rng.uniform(-0.4, 0.4, (50, 3))
    points = nib.affines.apply_affine(initial.affine, voxels)
    np.savetxt(path("points.csv"), points, delimiter=",", fmt="%.6f", header="x,y,z", comments="")
    palpate("warp", "--points", path("points.csv"), "--field", field, "-o", path("moved.csv"))
    with open(path("moved.csv"), newline="") as file:
        mine = np.array([[float(row[c]) for c in "xyz"] for row in csv.DictReader(file)])
    by_sitk = np.array([transform.TransformPoint(p) for p in points * LPS]) * LPS
    frame = pd.DataFrame(points * LPS, columns=["x", "y", "z"])
    by_ants = ants.apply_transforms_to_points(3, frame, [field])[["x", "y", "z"]].to_numpy() * LPS
    point = {"ANTs": np.abs(mine - by_ants).max(), "SimpleITK": np.abs(mine - by_sitk).max()}

    motion = np.linalg.norm(mine - points, axis=1).max()
    print(f"{name}: images {image}, points (mm) {point}, motion up to {motion:.2f} mm")
    assert motion > 0.5, "nothing moves, so nothing is tested"
    assert all(v < IMAGE_TOLERANCE for v in image.values()), image
    assert all(v < POINT_TOLERANCE for v in point.values()), point
    return name, nothing


def main():
    with tempfile.TemporaryDirectory() as root:
        pair = os.path.join(root, "pair")
        palpate("phantom", "block", "--size", 40, "--amplitude", 3, "-o", pair)
        for number, (name, changes) in enumerate(GRIDS.items()):
            folder = os.path.join(root, str(number))
            os.mkdir(folder)
            check(name, folder, pair, *changes)
    print("ANTs and SimpleITK warp as we do on all grids.")


if __name__ == "__main__":
    sys.exit(main())
