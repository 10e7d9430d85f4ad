#!/usr/bin/env python3
"""A case with exact truth, its volumes made worse in one way: corrupt.py CASE OUT (--hot N K [--in-a-row W] | --background VALUE)

--hot: N places of each volume, W voxels in a row, at K times the volume's maximum. --background: air (outside the tissue,
closed and filled) at VALUE in both volumes. The truth and the mask stay. Needs numpy, scipy and nibabel.
"""
import argparse
import shutil
from pathlib import Path

import nibabel as nib
import numpy as np
from scipy import ndimage as ndi


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--hot", type=float, nargs=2, metavar=("N", "K"))
    parser.add_argument("--in-a-row", type=int, default=1)
    parser.add_argument("--volumes", nargs="*", default=["fixed", "moving"])
    parser.add_argument("--background", type=float)
    parser.add_argument("--seed", type=int, default=1)
    a = parser.parse_args()
    shutil.copytree(a.case, a.out, dirs_exist_ok=True)
    random = np.random.default_rng(a.seed)
    for name in a.volumes:
        image = nib.load(a.case / f"{name}.nii.gz")
        v = np.asarray(image.dataobj, np.float32)
        if a.hot:
            for _ in range(int(a.hot[0])):
                i, j, k = (int(random.integers(0, n - a.in_a_row + 1)) for n in v.shape)
                v[i : i + a.in_a_row, j, k] = a.hot[1] * np.asarray(image.dataobj).max()
        if a.background is not None:
            tissue = ndi.binary_closing(np.pad(ndi.gaussian_filter(v, 1) > 0.08 * np.percentile(v, 99), 5), iterations=4)
            inside = np.stack([ndi.binary_fill_holes(k) for k in np.moveaxis(tissue, 2, 0)], 2)[5:-5, 5:-5, 5:-5]
            v[~inside] = a.background
        nib.save(nib.Nifti1Image(v, image.affine), a.out / f"{name}.nii.gz")


if __name__ == "__main__":
    main()
