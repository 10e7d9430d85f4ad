#!/usr/bin/env python3
"""Run one registration tool on one pair and write its field: peers.py METHOD FIXED MOVING FIELD

`peers.py list` prints a line a method: name, settings in words, what is missing here to run it, with tabs between.
`palpate chart --peers` carries this file and runs it.

The field is NIfTI 5-D, intent 1007, LPS mm on the fixed grid. Two threads. Settings are the tools' own defaults or
those their authors recommend; none was changed after its score was seen. Needs numpy, nibabel and the tool itself
(pip: picsl_greedy, SimpleITK, antspyx, convexAdam; Debian: elastix, plastimatch; from source: NiftyReg, deedsBCV).
"""
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile

THREADS = "2"
for name in ("OMP_NUM_THREADS", "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS"):
    os.environ[name] = THREADS


def save(vectors, reference, path):
    """Writes LPS vectors (nx, ny, nz, 3) on the reference's grid."""
    import nibabel as nib
    import numpy as np

    image = nib.Nifti1Image(np.asarray(vectors, np.float32)[:, :, :, None, :], nib.load(reference).affine)
    image.header.set_intent(1007)
    nib.save(image, path)


def load(path):
    """Vectors of a file that some tool wrote, as (nx, ny, nz, 3)."""
    import nibabel as nib
    import numpy as np

    data = np.asarray(nib.load(path).dataobj, np.float32)
    return data.reshape(*data.shape[:3], 3)


def greedy(iterations, fixed, moving, out):
    from picsl_greedy import Greedy3D

    with tempfile.TemporaryDirectory() as folder:
        warp = os.path.join(folder, "warp.nii.gz")
        Greedy3D().execute(f"-i {fixed} {moving} -m NCC 2x2x2 -n {iterations} -threads {THREADS} -o {warp}")
        save(load(warp), fixed, out)


def elastix(settings, fixed, moving, out):
    """elastix and transformix on the path; the parameters are itk-elastix's default B-spline map, written out."""
    chosen = {
        "Registration": "MultiMetricMultiResolutionRegistration",
        "FixedImagePyramid": "FixedSmoothingImagePyramid",
        "MovingImagePyramid": "MovingSmoothingImagePyramid",
        "Interpolator": "LinearInterpolator",
        "ResampleInterpolator": "FinalBSplineInterpolator",
        "Resampler": "DefaultResampler",
        "Transform": "BSplineTransform",
        "Metric": ["AdvancedMattesMutualInformation", "TransformBendingEnergyPenalty"],
        "Metric0Weight": 1.0,
        "Metric1Weight": 1.0,
        "Optimizer": "AdaptiveStochasticGradientDescent",
        "AutomaticParameterEstimation": "true",
        "ImageSampler": "RandomCoordinate",
        "NumberOfSpatialSamples": 2048,
        "NewSamplesEveryIteration": "true",
        "MaximumNumberOfSamplingAttempts": 8,
        "CheckNumberOfSamples": "true",
        "NumberOfResolutions": 4,
        "MaximumNumberOfIterations": 256,
        "FinalGridSpacingInPhysicalUnits": 10.0,
        "GridSpacingSchedule": [2.8284271247461903, 2.0, 1.4142135623730951, 1.0],
        "NumberOfSamplesForExactGradient": 4096,
        "FinalBSplineInterpolationOrder": 3,
        "DefaultPixelValue": 0.0,
        "ResultImageFormat": "nii.gz",
        "WriteResultImage": "false",
    } | settings
    text = lambda v: f'"{v}"' if isinstance(v, str) else str(v)
    with tempfile.TemporaryDirectory() as folder:
        recipe = os.path.join(folder, "p.txt")
        with open(recipe, "w") as f:
            for key, value in chosen.items():
                values = value if isinstance(value, list) else [value]
                f.write(f"({key} {' '.join(map(text, values))})\n")
        quiet = {"check": True, "stdout": subprocess.DEVNULL}
        common = ["-threads", THREADS, "-out", folder]
        subprocess.run(["elastix", "-f", fixed, "-m", moving, "-p", recipe, *common], **quiet)
        transform = os.path.join(folder, "TransformParameters.0.txt")
        subprocess.run(["transformix", "-tp", transform, "-def", "all", *common], **quiet)
        save(load(os.path.join(folder, "deformationField.nii.gz")), fixed, out)


def plastimatch(_, fixed, moving, out):
    stages = "\n".join(
        "[STAGE]\nxform=bspline\noptim=lbfgsb\nimpl=plastimatch\nthreading=openmp\nmetric=mse\nconvergence_tol=3\n"
        f"grad_tol=0.1\nregularization_lambda=0.01\nmax_its={its}\ngrid_spac={g} {g} {g}\nres={r} {r} {r}\n"
        for its, g, r in ((50, 40, 4), (50, 20, 2), (30, 12, 1))
    )
    with tempfile.TemporaryDirectory() as folder:
        recipe, field = (os.path.join(folder, n) for n in ("p.txt", "field.nrrd"))
        field = os.path.join(folder, "field.nii.gz")
        with open(recipe, "w") as f:
            f.write(f"[GLOBAL]\nfixed={fixed}\nmoving={moving}\nvf_out={field}\n{stages}")
        subprocess.run(["plastimatch", "register", recipe], check=True, stdout=subprocess.DEVNULL)
        save(load(field), fixed, out)


def demons(_, fixed, moving, out):
    import numpy as np
    import SimpleITK as sitk

    sitk.ProcessObject.SetGlobalDefaultNumberOfThreads(int(THREADS))
    f, m = (sitk.ReadImage(p, sitk.sitkFloat32) for p in (fixed, moving))
    m = sitk.HistogramMatching(m, f, numberOfHistogramLevels=256, numberOfMatchPoints=7, thresholdAtMeanIntensity=True)
    field = None
    for shrink in (4, 2, 1):
        a, b = (sitk.Shrink(sitk.SmoothingRecursiveGaussian(v, 0.5 * shrink) if shrink > 1 else v, [shrink] * 3) for v in (f, m))
        start = sitk.Resample(field, a) if field is not None else None
        step = sitk.FastSymmetricForcesDemonsRegistrationFilter()
        step.SetNumberOfIterations(20)
        step.SetStandardDeviations(1.0)
        field = step.Execute(a, b, start) if start is not None else step.Execute(a, b)
        field = sitk.Cast(field, sitk.sitkVectorFloat64)
    field = sitk.Resample(field, f)
    save(np.transpose(sitk.GetArrayFromImage(field), (2, 1, 0, 3)), fixed, out)


def ants(kind, fixed, moving, out):
    import ants as antspy

    os.environ["ANTS_RANDOM_SEED"] = "1"
    pair = [antspy.image_read(p) for p in (fixed, moving)]
    result = antspy.registration(*pair, kind)
    warp = next(p for p in result["fwdtransforms"] if "Warp" in p)
    save(load(warp), fixed, out)


def niftyreg(options, fixed, moving, out):
    with tempfile.TemporaryDirectory() as folder:
        grid, field = (os.path.join(folder, n) for n in ("grid.nii.gz", "field.nii.gz"))
        quiet = {"check": True, "stdout": subprocess.DEVNULL}
        result = ["-res", os.path.join(folder, "result.nii.gz")]
        common = ["-ref", fixed, "-omp", THREADS]
        subprocess.run(["reg_f3d", *common, "-flo", moving, "-cpp", grid, *result, *options], **quiet)
        subprocess.run(["reg_transform", *common, "-disp", grid, field], **quiet)
        save(load(field) * [-1, -1, 1], fixed, out)


def deeds(_, fixed, moving, out):
    """deedsBCV as it comes; its field lies on every fourth voxel, components along y, x, z, in voxels."""
    import nibabel as nib
    import numpy as np

    # Its threads wait in a loop else, which would be booked as work.
    os.environ["OMP_WAIT_POLICY"] = "passive"
    with tempfile.TemporaryDirectory() as folder:
        paths = [os.path.join(folder, n) for n in ("f.nii.gz", "m.nii.gz")]
        for given, path in zip((fixed, moving), paths):
            image = nib.load(given)
            nib.save(nib.Nifti1Image(np.asarray(image.dataobj, np.float32), image.affine), path)
        result = os.path.join(folder, "out")
        command = ["deedsBCV", "-F", paths[0], "-M", paths[1], "-O", result]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        image = nib.load(fixed)
        coarse = [n // 4 for n in image.shape]
        flow = np.fromfile(result + "_displacements.dat", "<f4").reshape((*coarse, 3), order="F")
    for axis, (n, m) in enumerate(zip(image.shape, coarse)):
        # Its own way of making a grid finer: linear, the first nodes at the first voxels.
        at = np.arange(n) * (m / n)
        low = np.minimum(at.astype(int), m - 1)
        t = (at - low).reshape([-1 if a == axis else 1 for a in range(4)])
        flow = flow.take(low, axis) * (1 - t) + flow.take(np.minimum(low + 1, m - 1), axis) * t
    save(flow[..., [1, 0, 2]] @ image.affine[:3, :3].T * [-1, -1, 1], fixed, out)


def convex_adam(_, fixed, moving, out):
    """ConvexAdam as it comes (MIND features); it counts in voxels alone, so thick slices are first brought to cubes of three quarters of a
    voxel's volume's edge."""
    import nibabel as nib
    import numpy as np
    import torch
    from convexAdam.convex_adam_MIND import convex_adam_pt
    from scipy import ndimage

    torch.set_num_threads(int(THREADS))
    images = [nib.load(p) for p in (fixed, moving)]
    spacing = np.array(images[0].header.get_zooms()[:3], float)
    thick = spacing.max() > 1.5 * spacing.min()
    edge = max(spacing.min(), 0.75 * np.cbrt(spacing.prod())) if thick else spacing.min()
    cubes = [ndimage.zoom(np.asarray(i.dataobj, np.float32), spacing / edge, order=1, grid_mode=True, mode="nearest") for i in images]
    flow = convex_adam_pt(*cubes, dtype=torch.float32)
    places = [(np.arange(n) + 0.5) * m / n - 0.5 for n, m in zip(images[0].shape, cubes[0].shape)]
    places = np.meshgrid(*places, indexing="ij")
    flow = [edge * ndimage.map_coordinates(flow[..., a].astype(np.float32), places, order=1, mode="nearest") for a in range(3)]
    save(np.stack(flow, -1) @ (images[0].affine[:3, :3] / spacing).T * [-1, -1, 1], fixed, out)


METHODS = {
    "greedy half": (greedy, "100x50x0", "-m NCC 2x2x2 -n 100x50x0"),
    "greedy full": (greedy, "100x50x10", "-m NCC 2x2x2 -n 100x50x10"),
    "greedy long": (greedy, "100x100x50", "-m NCC 2x2x2 -n 100x100x50"),
    "elastix": (
        elastix,
        {},
        "itk-elastix's default B-spline map: mutual information and bending energy, 4 resolutions of 256 iterations, nodes every 10 mm",
    ),
    "elastix finer": (
        elastix,
        {
            "Metric": ["AdvancedNormalizedCorrelation", "TransformBendingEnergyPenalty"],
            "MaximumNumberOfIterations": 2000,
            "NumberOfSpatialSamples": 4096,
            "FinalGridSpacingInPhysicalUnits": 8.0,
        },
        "normalized correlation and bending energy, 4 resolutions of 2000 iterations, nodes every 8 mm",
    ),
    "plastimatch": (
        plastimatch,
        None,
        "B-splines with nodes every 40, 20, 12 mm, mean squares, at most 50, 50, 30 iterations of L-BFGS-B, regularization 0.01",
    ),
    "demons": (demons, None, "SimpleITK, fast symmetric forces, histograms matched, 20 iterations at a quarter, half and full resolution"),
    "NiftyReg": (niftyreg, [], "reg_f3d with its defaults"),
    "NiftyReg half": (niftyreg, ["-lp", "2"], "reg_f3d -lp 2: its two coarser levels"),
    "deeds": (deeds, None, "deedsBCV with its defaults"),
    "ConvexAdam": (convex_adam, None, "ConvexAdam with MIND features and its defaults (nodes every 6 voxels, 24 voxels looked over, 80 steps of Adam)"),
    "ANTs SyNQuick": (ants, "antsRegistrationSyNQuick[so]", "antsRegistrationSyNQuick[so]: no affine step, as no other has one"),
}

# What each needs: modules of Python and programs on the path, beside numpy and nibabel.
NEEDS = {
    greedy: (["picsl_greedy"], []),
    elastix: ([], ["elastix", "transformix"]),
    plastimatch: ([], ["plastimatch"]),
    demons: (["SimpleITK"], []),
    niftyreg: ([], ["reg_f3d", "reg_transform"]),
    deeds: ([], ["deedsBCV"]),
    convex_adam: (["convexAdam", "torch", "scipy"], []),
    ants: (["ants"], []),
}


def absent(modules, programs):
    """What of these cannot be found here, in words."""
    find = importlib.util.find_spec
    return [f"Python's {m}" for m in modules if not find(m)] + [p for p in programs if not shutil.which(p)]


def listed():
    """A line a method: name, settings, what is missing."""
    rows = [(name, f"{words}, {THREADS} threads", absent(["numpy", "nibabel", *NEEDS[run][0]], NEEDS[run][1])) for name, (run, _, words) in METHODS.items()]
    rows.append(("MuJoCo", "", absent(["numpy", "mujoco"], [])))
    return [f"{name}\t{words}\t{', '.join(missing)}" for name, words, missing in rows]


if __name__ == "__main__":
    if sys.argv[1:] == ["list"]:
        print("\n".join(listed()))
        sys.exit()
    if len(sys.argv) != 5 or sys.argv[1] not in METHODS:
        sys.exit(f"usage: peers.py METHOD FIXED MOVING FIELD\nMETHOD is one of {', '.join(METHODS)}")
    run, settings, _ = METHODS[sys.argv[1]]
    try:
        run(settings, *sys.argv[2:])
    except subprocess.CalledProcessError as problem:
        sys.exit(f"{problem.cmd[0]} ended with code {problem.returncode}")
    except Exception as problem:
        sys.exit(f"{type(problem).__name__}: {' '.join(str(problem).split())}")
