"""A cohort of synthetic finger pads in folders named as BIDS has them, and its table of pairs.

    python make_cohort.py FOLDER [SUBJECTS [SIZE [PRESSES]]]

The exact solution of a press takes most of the time, so there are PRESSES of them (2), of growing depth; each subject is one of
these, scanned with noise of its own. Moduli and forces are known exactly (press-1/phantom.json ...). Needs nibabel.
"""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import nibabel
import numpy as np

SCENE = Path(__file__).resolve().parent.parent / "finger_pad.toml"
FILES = {"initial": "desc-before_T2w", "deformed": "desc-after_T2w", "mask": "desc-tissue_mask", "labels": "dseg"}


#: Standard deviation of a subject's own noise over the brightest voxel.
NOISE = 0.01


def scan(source, target, seed):
    """Writes ``source`` to ``target`` with noise of this seed."""
    image = nibabel.load(source)
    values = np.asarray(image.dataobj, np.float32)
    noise = np.random.default_rng(seed).normal(0.0, NOISE * values.max(), values.shape)
    nibabel.save(nibabel.Nifti1Image((values + noise).astype(np.float32), image.affine), target)


def make(folder, subjects=20, size=28, presses=2, palpate=os.environ.get("PALPATE", "palpate")):
    """Writes ``subjects`` pairs of ``size`` voxels along x below ``folder``; gives the table's path."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.toml").write_text(SCENE.read_text())
    for press in range(1, presses + 1):
        command = [palpate, "phantom", "fingertip", "--size", size, "--amplitude", 1.0 + 0.5 * press / presses]
        command += ["--seed", 1 + press, "--overwrite", "-o", folder / f"press-{press}"]
        subprocess.run([str(c) for c in command], check=True, stdout=subprocess.DEVNULL)
    rows = []
    for number in range(1, subjects + 1):
        subject = f"{number:02}"
        made = folder / f"press-{1 + (number - 1) % presses}"
        elastic = json.loads((made / "phantom.json").read_text())["elastic"]
        row = {"subject": subject, "session": "01"}
        for column, suffix in FILES.items():
            path = f"sub-{subject}/ses-01/anat/sub-{subject}_ses-01_{suffix}.nii.gz"
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            if column in ("initial", "deformed"):
                scan(made / f"{column}.nii.gz", folder / path, [number, column == "deformed"])
            else:
                (folder / path).write_bytes((made / f"{column}.nii.gz").read_bytes())
            row[column] = path
        row["names"] = ";".join(f"{r['label']}={r['name']}" for r in elastic["regions"])
        row |= {"held": elastic["held"], "load": elastic["load"], "force_n": elastic["force_n"], "scene": "scene.toml"}
        rows.append(row)
    table = folder / "pairs.csv"
    with open(table, "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    return table


if __name__ == "__main__":
    print(make(sys.argv[1], *map(int, sys.argv[2:])))
