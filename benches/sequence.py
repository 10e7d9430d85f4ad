#!/usr/bin/env python3
"""A sequence made from one real volume, measured three ways: followed, each frame alone, and frame to frame in a chain.

    sequence.py VOLUME OUT_DIR [--palpate BIN] [--frames 7] [--amplitude 8] [--seed 7]

The volume moves by the sum of two random smooth motions, one that grows over the frames and one that comes and goes; every
frame has its own Rician noise of 3 %. Prints the mean error over the tissue in each frame (mm). Needs numpy, scipy and
nibabel; the volume's axes must run right, front and up.
"""
import argparse
import shutil
import subprocess
from pathlib import Path

import nibabel
import numpy as np
from scipy import ndimage

NOISE = 0.03
LPS = np.float32([-1, -1, 1])


def smooth_motion(random, shape, spacing, apart):
    """A random field on control points `apart` mm apart, its longest vector 1."""
    field = np.zeros((*shape, 3), np.float32)
    for c in range(3):
        points = random.normal(size=[int(np.ceil(n * s / apart)) + 3 for n, s in zip(shape, spacing)])
        zoom = [n / m for n, m in zip(shape, points.shape)]
        field[..., c] = ndimage.zoom(points, zoom, order=3, mode="nearest", grid_mode=True)
    return field / np.linalg.norm(field, axis=-1).max()


def at(values, places):
    return np.stack([ndimage.map_coordinates(values[..., c], places, order=1, mode="nearest") for c in range(3)], -1)


def make(volume, out, frames, amplitude, seed):
    """Writes frames, their truths (mm along the axes) and a mask of the tissue."""
    image = nibabel.load(volume)
    data, spacing = np.asarray(image.dataobj, np.float32), np.array(image.header.get_zooms()[:3])
    if np.any(np.sign(np.round(image.affine[:3, :3], 3)) != np.eye(3)):
        raise SystemExit(f"{volume}: its axes do not run right, front and up; reorient it first")
    random = np.random.default_rng(seed)
    blurred = ndimage.gaussian_filter(data, 1)
    low, high = np.quantile(blurred, [0.02, 0.98])
    mask = blurred > low + 0.1 * (high - low)
    sigma = NOISE * np.quantile(data[mask], 0.98)
    grows = amplitude * smooth_motion(random, data.shape, spacing, 40)
    passes = 0.6 * amplitude * smooth_motion(random, data.shape, spacing, 60)
    places = np.stack(np.meshgrid(*[np.arange(n) for n in data.shape], indexing="ij")).astype(np.float32)
    coefficients = ndimage.spline_filter(data, 3)
    for t in range(frames):
        phase = np.pi / 2 * t / (frames - 1)
        motion = grows * np.sin(phase) + passes * np.sin(2 * phase)
        back = np.zeros_like(motion)  # y = x + u(x): what is seen at y lay at y - back(y)
        for _ in range(25):
            back = at(motion, places - np.moveaxis(back / spacing, -1, 0))
        there = places - np.moveaxis(back / spacing, -1, 0)
        clean = ndimage.map_coordinates(coefficients, there, order=3, prefilter=False, mode="nearest")
        real, imaginary = (random.normal(scale=sigma, size=data.shape) for _ in range(2))
        frame = np.hypot(clean + real, imaginary).astype(np.float32)
        nibabel.save(nibabel.Nifti1Image(frame, image.affine), out / f"frame_{t:03}.nii.gz")
        nibabel.save(nibabel.Nifti1Image(motion[:, :, :, None].astype(np.float32), image.affine), out / f"truth_{t:03}.nii.gz")
    nibabel.save(nibabel.Nifti1Image(mask.astype(np.uint8), image.affine), out / "mask.nii.gz")


def field(path):
    return np.asarray(nibabel.load(path).dataobj, np.float32)[:, :, :, 0]


def measure(palpate, out, frames):
    """Prints the errors of each frame."""
    names = [out / f"frame_{t:03}.nii.gz" for t in range(frames)]
    mask = out / "mask.nii.gz"

    def run(command, into, *arguments):
        shutil.rmtree(into, ignore_errors=True)
        subprocess.run([palpate, command, *map(str, arguments), "-o", str(into), "--quiet"], check=True, stdout=subprocess.DEVNULL)

    def pair(a, b, *arguments):
        run("field", out / "pair", a, b, *arguments)
        return field(out / "pair" / "displacement.nii.gz") * LPS

    image = nibabel.load(mask)
    inside, spacing = np.asarray(image.dataobj) > 0, np.array(image.header.get_zooms()[:3])
    places = np.stack(np.meshgrid(*[np.arange(n) for n in inside.shape], indexing="ij")).astype(np.float32)
    run("track", out / "tracked", *names, "--mask", mask)
    chain = np.zeros((*inside.shape, 3), np.float32)
    print("frame  motion  followed   alone  chained (mm)")
    for t in range(1, frames):
        truth = field(out / f"truth_{t:03}.nii.gz")
        followed = field(out / "tracked" / f"displacement_{t:03}.nii.gz") * LPS
        alone = pair(names[0], names[t], "--mask", mask)
        chain = chain + at(pair(names[t - 1], names[t]), places + np.moveaxis(chain / spacing, -1, 0))
        errors = [np.linalg.norm(u - truth, axis=-1)[inside].mean() for u in (0, followed, alone, chain)]
        print("{:5}  {:6.3f}  {:8.3f}  {:6.3f}  {:7.3f}".format(t, *errors), flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("volume", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--palpate", default="target/release/palpate")
    parser.add_argument("--frames", type=int, default=7)
    parser.add_argument("--amplitude", type=float, default=8.0)
    parser.add_argument("--seed", type=int, default=7)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    make(options.volume, options.out, options.frames, options.amplitude, options.seed)
    measure(options.palpate, options.out, options.frames)


if __name__ == "__main__":
    main()
