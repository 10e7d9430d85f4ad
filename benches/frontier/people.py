#!/usr/bin/env python3
"""Two people: how well the tissues of two brains lie on each other after each method, in one run.

    people.py OUT_DIR FIXED:MASK MOVING[:MASK] [--palpate BIN] [--methods NAME ...] [--spacing MM] [--strip] [--rigid]

Volumes are NIfTI (T1). MOVING is first laid on FIXED by an affine map (--rigid: a rigid one; mutual information, SimpleITK), on cubes of
--spacing mm; every method starts from that pair. Each volume is cut into three classes (fluid, gray, white) by k-means
after N4, inside the mask; the moving one's classes are carried along each field, and Dice is taken in the fixed mask where the
moving volume was seen. --strip takes away what is outside the masks before (a missing mask of MOVING is FIXED's along
greedy's field). "palpate ... mask" is given FIXED's mask. Prints Dice, folds, the spread of log J and CPU seconds.
Needs numpy, scipy, nibabel, SimpleITK and the tools themselves (peers.py).
"""
import argparse
import sys
from pathlib import Path

import nibabel as nib
import numpy as np
import SimpleITK as sitk
from scipy import ndimage

from run import field, run

METHODS = [f"palpate {p}{m}" for p in ("fast", "balanced", "accurate") for m in ("", " mask")]
METHODS += ["greedy half", "greedy full", "greedy long", "elastix", "ANTs SyNQuick", "plastimatch", "deeds", "ConvexAdam"]


def laid(fixed, moving, rigid):
    method = sitk.ImageRegistrationMethod()
    method.SetMetricAsMattesMutualInformation(50)
    method.SetMetricSamplingStrategy(method.RANDOM)
    method.SetMetricSamplingPercentage(0.1, 7)
    method.SetInterpolator(sitk.sitkLinear)
    method.SetOptimizerAsRegularStepGradientDescent(1.0, 1e-4, 300, relaxationFactor=0.6)
    method.SetOptimizerScalesFromPhysicalShift()
    method.SetShrinkFactorsPerLevel([4, 2])
    method.SetSmoothingSigmasPerLevel([2, 1])
    method.SmoothingSigmasAreSpecifiedInPhysicalUnitsOn()
    moments = sitk.CenteredTransformInitializerFilter.MOMENTS
    start = sitk.Euler3DTransform() if rigid else sitk.AffineTransform(3)
    start = sitk.CenteredTransformInitializer(fixed, moving, start, moments)
    method.SetInitialTransform(start, inPlace=True)
    method.Execute(fixed, moving)
    return start


def classes(path, mask):
    """1, 2, 3 from dark to bright; 0 where there is nothing."""
    image = sitk.ReadImage(str(path), sitk.sitkFloat32)
    inside = sitk.GetImageFromArray(mask.T.astype(np.uint8))
    inside.CopyInformation(image)
    n4 = sitk.N4BiasFieldCorrectionImageFilter()
    n4.SetMaximumNumberOfIterations([30, 30, 20])
    n4.Execute(sitk.Shrink(image, [2] * 3), sitk.Shrink(inside, [2] * 3))
    values = sitk.GetArrayFromImage(image).T / np.exp(sitk.GetArrayFromImage(n4.GetLogBiasFieldAsImage(image)).T)
    some = values[ndimage.binary_erosion(mask, iterations=3) & (values > 1)]
    low, high = np.percentile(some, [1, 99])
    some = some[(some > low) & (some < high)]
    means = np.percentile(some, [5, 40, 85])
    for _ in range(60):
        nearest = np.abs(some[:, None] - means).argmin(1)
        means = np.array([some[nearest == i].mean() for i in range(3)])
    found = np.digitize(values, (means[:-1] + means[1:]) / 2) + 1
    return np.where(values < 1, 0, found).astype(np.uint8)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("fixed")
    parser.add_argument("moving")
    parser.add_argument("--palpate", default="palpate")
    parser.add_argument("--methods", nargs="*", default=METHODS)
    parser.add_argument("--spacing", type=float, default=1.5)
    parser.add_argument("--strip", action="store_true")
    parser.add_argument("--rigid", action="store_true")
    options = parser.parse_args()
    out = options.out
    out.mkdir(parents=True, exist_ok=True)
    (fixed, fixed_mask), (moving, moving_mask) = ((v.split(":") + [None])[:2] for v in (options.fixed, options.moving))

    images = [sitk.ReadImage(v, sitk.sitkFloat32) for v in (fixed, moving)]
    size = [int(n * s / options.spacing) for n, s in zip(images[0].GetSize(), images[0].GetSpacing())]
    grid = sitk.Image(size, sitk.sitkFloat32)
    grid.SetSpacing([options.spacing] * 3)
    grid.SetOrigin(images[0].GetOrigin())
    grid.SetDirection(images[0].GetDirection())
    maps = [sitk.Transform(), laid(*images, options.rigid)]
    paths = [out / "fixed.nii.gz", out / "moving.nii.gz"]
    for image, to, path in zip(images, maps, paths):
        sitk.WriteImage(sitk.Resample(image, grid, to, sitk.sitkBSpline, 0.0), str(path))

    def on_grid(path, to):
        image = sitk.ReadImage(path) > 0
        return sitk.GetArrayFromImage(sitk.Resample(image, grid, to, sitk.sitkNearestNeighbor, 0)).T > 0

    reference = nib.load(paths[0])
    shape, world = reference.shape, reference.affine
    voxels = np.indices(shape).astype(np.float32)
    carried = lambda volume, u: ndimage.map_coordinates(volume.astype(np.float32), voxels + u, order=1)
    in_voxels = lambda u: np.moveaxis(u @ np.linalg.inv(world[:3, :3]).T, -1, 0)
    mask = on_grid(fixed_mask, maps[0])
    if moving_mask:
        seen = on_grid(moving_mask, maps[1])
    else:
        *_, path = run(None, out, "greedy full", out / "greedy")
        u = in_voxels(field(path)[0])
        back = np.zeros_like(u)
        for _ in range(15):
            back = -np.stack([ndimage.map_coordinates(c, voxels + back, order=1, mode="nearest") for c in u])
        seen = carried(mask, back) > 0.5
    masks = [mask, seen]
    if options.strip:
        for path, inside in zip(paths, masks):
            image = nib.load(path)
            nib.save(nib.Nifti1Image(image.get_fdata(dtype=np.float32) * inside, world), path)
    mask_path = out / "mask.nii.gz"
    nib.save(nib.Nifti1Image(mask.astype(np.uint8), world), mask_path)

    here, there = (classes(p, m) for p, m in zip(paths, masks))
    filled = ndimage.binary_closing(nib.load(paths[1]).get_fdata() > 1, iterations=4)
    scored = mask & ndimage.binary_erosion(filled, iterations=5)
    print("| method | fluid | gray | white | mean | folds | spread of log J | CPU (s) |\n|---|---|---|---|---|---|---|---|")
    for method in ["nothing", *options.methods]:
        more = ["--overwrite", *(["--mask", mask_path] if method.endswith("mask") else [])]
        cpu, u = 0.0, np.zeros((3, *shape), np.float32)
        if method != "nothing":
            try:
                cpu, *_, path = run(options.palpate, out, method, out / method.replace(" ", "_"), more)
            except RuntimeError as refused:
                print(refused, file=sys.stderr)
                continue
            u = in_voxels(field(path)[0])
        dice = []
        for k in (1, 2, 3):
            a, b = (carried(there == k, u) > 0.5) & scored, (here == k) & scored
            dice.append(2 * (a & b).sum() / max(1, a.sum() + b.sum()))
        jacobian = np.array([[np.gradient(u[a], axis=b) + (a == b) for b in range(3)] for a in range(3)])
        jacobian = np.linalg.det(np.moveaxis(jacobian, (0, 1), (-2, -1)))[scored]
        spread = np.log(np.clip(jacobian, 1e-2, 1e2)).std()
        scores = " | ".join(f"{d:.3f}" for d in [*dice, np.mean(dice)])
        print(f"| {method} | {scores} | {(jacobian <= 0).mean():.0e} | {spread:.2f} | {cpu:.1f} |", flush=True)


if __name__ == "__main__":
    main()
