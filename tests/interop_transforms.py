#!/usr/bin/env python3
"""Transforms of SimpleITK, ANTs and greedy: `palpate warp --transform` gives the image that each program gives itself.

    PALPATE=target/debug/palpate python tests/interop_transforms.py

needs numpy, nibabel, SimpleITK and antspyx; picsl_greedy is used where it is installed. One synthetic pair lies on plain,
oblique and flipped grids. On each, affine maps, chains and real small registrations are warped by the program that made them
and by palpate, and what palpate writes is read back.
"""
import os, subprocess, sys, tempfile
import ants, nibabel as nib, numpy as np, SimpleITK as sitk
from interop import GRIDS, LPS, PALPATE, palpate

TOLERANCE = 1e-3        # mean absolute difference inside the mask, as a part of the intensity range
POINT_TOLERANCE = 1e-3  # mm
TABLE = []


def values(path):
    return np.squeeze(nib.load(path).get_fdata())


def agree(what, folder, ours, theirs):
    """Two images of one warp; warping must matter, so that something is tested."""
    inside = values(folder("mask.nii.gz")) > 0
    span = np.ptp(values(folder("initial.nii.gz"))[inside])
    mean = np.abs(ours - theirs)[inside].mean() / span
    most = np.abs(ours - theirs)[inside].max() / span
    still = np.abs(ours - values(folder("still.nii.gz")))[inside].mean() / span
    TABLE.append((folder.name, what, mean, most, still))
    assert still > 5e-3 and mean < 0.1 * still, f"{folder.name}, {what}: nothing moves ({still:.1e})"
    assert mean < TOLERANCE, f"{folder.name}, {what}: {mean:.1e} of the range apart, at most {most:.1e}"


def warped(folder, *transforms, flags=()):
    out = folder("ours.nii.gz")
    palpate("warp", folder("deformed.nii.gz"), "--transform", *transforms, "--reference", folder("initial.nii.gz"),
            "--interpolation", "linear", *flags, "-o", out)
    return values(out)


def by_sitk(folder, transform):
    moving = sitk.ReadImage(folder("deformed.nii.gz"), sitk.sitkFloat64)
    out = sitk.Resample(moving, sitk.ReadImage(folder("initial.nii.gz")), transform, sitk.sitkLinear, 0.0)
    return np.transpose(sitk.GetArrayFromImage(out))


def by_ants(folder, transforms, invert=None):
    read = lambda f: ants.image_read(folder(f))
    out = ants.apply_transforms(read("initial.nii.gz"), read("deformed.nii.gz"), transforms, interpolator="linear",
                                whichtoinvert=invert)
    return out.numpy()


def smooth_field(folder, size):
    """A smooth displacement on the fixed grid, up to `size` mm, LPS."""
    image = sitk.ReadImage(folder("initial.nii.gz"))
    nx, ny, nz = image.GetSize()
    x, y, z = np.meshgrid(*(np.linspace(0, 2, n) for n in (nx, ny, nz)), indexing="ij")
    u = size * np.stack([np.sin(3 * y + 1), np.cos(2 * z + x), np.sin(2 * x)], axis=-1)
    field = sitk.GetImageFromArray(u.transpose(2, 1, 0, 3), isVector=True)
    field.CopyInformation(image)
    return field


def simple_itk(folder):
    centre = nib.affines.apply_affine(nib.load(folder("initial.nii.gz")).affine, np.array([20, 20, 20])) * LPS
    affine = sitk.AffineTransform([1.04, 0.05, -0.02, 0.03, 0.97, 0.04, -0.05, 0.02, 1.03], [1.5, -1.0, 0.7], centre.tolist())
    euler = sitk.Euler3DTransform(centre.tolist(), 0.05, -0.04, 0.06, [1.0, 0.5, -1.2])
    zyx = sitk.Euler3DTransform(euler)
    zyx.SetComputeZYX(True)
    similar = sitk.Similarity3DTransform(1.05, [0.1, 0.2, -0.3], 0.08, [0.5, 1.0, -0.5], centre.tolist())
    scaled = sitk.ScaleVersor3DTransform([1.04, 0.97, 1.02], [0.1, 0.2, -0.3], 0.08, [0.5, 1.0, -0.5], centre.tolist())
    field = smooth_field(folder, 1.5)
    sitk.WriteImage(sitk.Cast(field, sitk.sitkVectorFloat32), folder("field.nii.gz"))
    displaced = sitk.DisplacementFieldTransform(sitk.Image(field))
    single = {"affine": affine, "Euler": euler, "Euler ZYX": zyx, "similarity": similar, "scale versor": scaled,
              "translation": sitk.TranslationTransform(3, [1.5, -1.0, 0.7])}
    chains = {"composite of three": [affine, euler, similar], "composite with a field": [affine, displaced, euler]}
    for name, transform in single.items():
        sitk.WriteTransform(transform, folder("one.tfm"))
        agree(f"SimpleITK: {name} .tfm", folder, warped(folder, folder("one.tfm")), by_sitk(folder, transform))
        if name != "scale versor":  # ITK has no inverse of it
            turned = by_sitk(folder, transform.GetInverse())
            agree(f"SimpleITK: {name}, turned", folder, warped(folder, folder("one.tfm") + ",-1"), turned)
    sitk.WriteTransform(affine, folder("one.mat"))
    agree("SimpleITK: affine .mat", folder, warped(folder, folder("one.mat")), by_sitk(folder, affine))
    for name, parts in chains.items():
        composite = sitk.CompositeTransform(parts)
        sitk.WriteTransform(composite, folder("many.tfm"))
        agree(f"SimpleITK: {name} .tfm", folder, warped(folder, folder("many.tfm")), by_sitk(folder, composite))
    sitk.WriteTransform(affine, folder("affine.tfm"))
    sitk.WriteTransform(euler, folder("euler.txt"))
    # Of a composite the last one comes first; of a list of ours the first.
    composite = sitk.CompositeTransform([affine, displaced, euler])
    listed = [folder("euler.txt"), folder("field.nii.gz"), folder("affine.tfm")]
    agree("SimpleITK: three files in a row", folder, warped(folder, *listed), by_sitk(folder, composite))
    # What is composed is an ITK transform again.
    palpate("compose", *listed, "-o", folder("whole.nii.gz"))
    whole = sitk.DisplacementFieldTransform(sitk.ReadImage(folder("whole.nii.gz"), sitk.sitkVectorFloat64))
    agree("SimpleITK: with our composed field", folder, by_sitk(folder, whole), by_sitk(folder, composite))
    for ending in ("txt", "tfm", "mat"):
        palpate("compose", folder("euler.txt"), folder("affine.tfm"), "-o", folder(f"whole.{ending}"))
        whole = sitk.ReadTransform(folder(f"whole.{ending}"))
        both = sitk.CompositeTransform([affine, euler])
        points = np.random.default_rng(1).uniform(-50, 50, (40, 3)).tolist()
        apart = max(np.abs(np.subtract(whole.TransformPoint(p), both.TransformPoint(p))).max() for p in points)
        assert apart < 1e-9, (ending, apart)
    palpate("compose", folder("euler.txt"), "--inverse", "-o", folder("back.tfm"))
    back = sitk.ReadTransform(folder("back.tfm"))
    assert np.allclose(back.TransformPoint(euler.TransformPoint((1.0, 2.0, 3.0))), (1.0, 2.0, 3.0))


def antspy(folder):
    affine = ants.new_ants_transform(precision="double", dimension=3, transform_type="AffineTransform")
    affine.set_parameters(np.array([1.03, 0.04, 0.0, -0.05, 0.98, 0.02, 0.01, 0.0, 1.02, 1.0, -0.8, 1.2]))
    affine.set_fixed_parameters(np.array([5.0, -3.0, 8.0]))
    ants.write_transform(affine, folder("a.mat"))
    agree("ANTs: write_transform .mat", folder, warped(folder, folder("a.mat")), by_ants(folder, [folder("a.mat")]))
    read = lambda f: ants.image_read(folder(f))
    made = ants.registration(read("initial.nii.gz"), read("deformed.nii.gz"), "SyN", outprefix=folder("syn"), reg_iterations=(20, 10),
                             aff_iterations=(50, 20), aff_shrink_factors=(2, 1), aff_smoothing_sigmas=(1, 0), random_seed=1)
    forward, backward = made["fwdtransforms"], made["invtransforms"]
    assert forward[0].endswith("Warp.nii.gz") and forward[1].endswith(".mat"), forward
    agree("ANTs: warp and affine of a registration", folder, warped(folder, *forward), by_ants(folder, forward))
    mat, inverse_warp = backward
    agree("ANTs: the way back of a registration", folder, warped(folder, mat + ",-1", inverse_warp),
          by_ants(folder, backward, [True, False]))
    palpate("compose", *forward, "-o", folder("syn.nii.gz"))
    agree("ANTs: with our composed field", folder, by_ants(folder, [folder("syn.nii.gz")]), by_ants(folder, forward))
    palpate("compose", mat, folder("a.mat"), "-o", folder("ours.mat"))
    agree("ANTs: with our .mat", folder, by_ants(folder, [folder("ours.mat")]), by_ants(folder, [mat, folder("a.mat")]))
    h5 = folder("composite.h5")
    sitk.WriteTransform(sitk.ReadTransform(mat), h5)
    refused = subprocess.run([PALPATE, "warp", folder("deformed.nii.gz"), "--transform", h5, "-o", folder("x.nii.gz")],
                             capture_output=True, text=True)
    assert refused.returncode == 1 and "HDF5" in refused.stderr and not os.path.exists(folder("x.nii.gz")), refused


def greedy(folder):
    try:
        from picsl_greedy import Greedy3D
    except ImportError:
        return print("skipped: picsl_greedy is not installed")
    run = lambda command: Greedy3D().execute(command)
    fixed, moving, out = folder("initial.nii.gz"), folder("deformed.nii.gz"), folder("greedy.nii.gz")
    mat, warp = folder("greedy.mat"), folder("greedy_warp.nii.gz")
    run(f"-a -dof 12 -i {fixed} {moving} -o {mat} -ia-identity -m SSD -n 20x10")
    run(f"-i {fixed} {moving} -it {mat} -o {warp} -m SSD -n 20x10 -s 2vox 1vox")
    turned = np.loadtxt(mat)
    turned[:3] += [[0.02, 0.03, 0.0, 1.0], [-0.03, 0.0, 0.01, -0.8], [0.0, -0.01, 0.02, 1.2]]
    np.savetxt(folder("greedy2.mat"), turned)
    cases = {"affine .mat": [folder("greedy2.mat")], "affine .mat, turned": [folder("greedy2.mat") + ",-1"],
             "warp and affine": [warp, mat], "affine, warp, affine": [folder("greedy2.mat"), warp, folder("greedy2.mat") + ",-1"]}
    for name, transforms in cases.items():
        run(f"-rf {fixed} -rm {moving} {out} -ri LINEAR -r {' '.join(transforms)}")
        agree(f"greedy: {name}", folder, warped(folder, *transforms), values(out))
    palpate("compose", folder("greedy2.mat"), mat, "-o", folder("both.tfm"))
    palpate("convert", folder("both.tfm"), "--to", "greedy", "-o", folder("both.mat"))
    assert np.allclose(np.loadtxt(folder("both.mat")), np.loadtxt(mat) @ turned, atol=1e-9)


def written(folder):
    """Images, labels and fields in every format are the same to SimpleITK and to palpate."""
    palpate("warp", folder("deformed.nii.gz"), "--transform", folder("field.nii.gz"), "-o", folder("image.nii.gz"))
    palpate("warp", folder("mask.nii.gz"), "--transform", folder("field.nii.gz"), "-o", folder("labels.nii.gz"))
    palpate("convert", folder("field.nii.gz"), "--to", "itk", "-o", folder("vectors.nii.gz"))
    for ending in ("nrrd", "mha"):
        palpate("warp", folder("deformed.nii.gz"), "--transform", folder("field.nii.gz"), "-o", folder(f"image.{ending}"))
        palpate("warp", folder("mask.nii.gz"), "--transform", folder("field.nii.gz"), "-o", folder(f"labels.{ending}"))
        palpate("convert", folder("field.nii.gz"), "--to", "itk", "-o", folder(f"vectors.{ending}"))
        for name in ("image", "labels", "vectors"):
            one, two = (sitk.ReadImage(folder(f"{name}.{e}")) for e in ("nii.gz", ending))
            assert one.GetSize() == two.GetSize() and one.GetPixelID() == two.GetPixelID(), (name, ending, two)
            for part in ("GetOrigin", "GetSpacing", "GetDirection"):
                assert np.allclose(getattr(one, part)(), getattr(two, part)(), atol=1e-5), (name, ending, part)
            assert (sitk.GetArrayFromImage(one) == sitk.GetArrayFromImage(two)).all(), (name, ending)
        again = folder("again.nii.gz")
        palpate("warp", folder(f"image.{ending}"), "--reference", folder("image.nii.gz"), "-o", again)
        assert np.abs(values(again) - values(folder("image.nii.gz"))).max() < 0.01, ending
        palpate("convert", folder(f"vectors.{ending}"), "--to", "itk", "-o", again)
        assert np.abs(values(again) - values(folder("vectors.nii.gz"))).max() < 1e-3, ending
        palpate("warp", folder(f"labels.{ending}"), "--reference", folder("labels.nii.gz"), "-o", again)
        assert (values(again) == values(folder("labels.nii.gz"))).all(), ending


class Folder:
    def __init__(self, path, name):
        self.path, self.name = path, name

    def __call__(self, file):
        return os.path.join(self.path, file)


def main():
    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    with tempfile.TemporaryDirectory() as root:
        pair = os.path.join(root, "pair")
        palpate("phantom", "block", "--size", 40, "--amplitude", 3, "-o", pair)
        for number, (name, changes) in enumerate(GRIDS.items()):
            folder = Folder(os.path.join(root, str(number)), name)
            os.mkdir(folder.path)
            for file, change in (("initial", changes[0]), ("mask", changes[0]), ("deformed", changes[1])):
                nib.save(change(nib.load(os.path.join(pair, file + ".nii.gz"))), folder(file + ".nii.gz"))
            palpate("warp", folder("deformed.nii.gz"), "--reference", folder("initial.nii.gz"), "-o", folder("still.nii.gz"))
            for check in (simple_itk, antspy, greedy, written):
                check(folder)
    print(f"{'grid':34} {'transform':42} mean, most: parts of the intensity range; without")
    for grid, what, mean, most, still in TABLE:
        print(f"{grid:34} {what:42} {mean:.1e} {most:.1e} {still:.1e}")
    print("SimpleITK, ANTs and greedy warp as we do with their transforms.")


if __name__ == "__main__":
    sys.exit(main())
