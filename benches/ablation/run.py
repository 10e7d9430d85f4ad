#!/usr/bin/env python3
"""What each mechanism of the registration gives: a spread of cases with exact truth, each mechanism switched off in turn.

    run.py CASES_DIR OUT_DIR [--palpate BIN] [--against BIN] [--without NAME ...] [--only PATTERN] [--mask]

CASES_DIR holds one folder a case with fixed.nii.gz, moving.nii.gz, truth.nii.gz (5-D, intent 1007, LPS mm) and
mask.nii.gz; corrupt.py makes more of them from one. Two runs at a time, one thread each; CPU seconds are user + system of
that process. OUT_DIR gets results.csv, a line as soon as a run ends (a second call goes on where the first stopped), and
table.md: error over the whole pipeline's (geometric mean and worst case), folds, share of the tissue inside the stated
95 % region, CPU. `--against` adds another build, `--mask` gives the case's mask. Needs numpy and nibabel.
"""
import argparse
import csv
import fnmatch
import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
FIELDS = ["case", "variant", "mean_mm", "p95_mm", "still_mm", "gradient", "folds", "inside", "motion_mm", "cpu_s", "memory_mb", "model", "trust", "expected_mm"]
# What PALPATE_WITHOUT knows in a build with the feature `ablation`.
MECHANISMS = (
    "local-smoothness gradient-floor robust-range enclosed cut brightness consistency turned rotations taken-out look-ahead next-level unfold "
    "bodies rest model noise-gradient"
).split()


def field(path):
    """Displacement (mm, LPS, one vector a voxel) and affine of a 5-D NIfTI."""
    import nibabel as nib

    image = nib.load(path)
    return np.asarray(image.dataobj, np.float32)[:, :, :, 0], image.affine


def score(case, out):
    """Errors in the mask (mm), median gradient error, folds, and the share of errors in the 95 % region (a ball of 2.8 deviations)."""
    import nibabel as nib

    (u, affine), (t, _) = field(out / "displacement.nii.gz"), field(case / "truth.nii.gz")
    mask = np.asarray(nib.load(case / "mask.nii.gz").dataobj) > 0
    sigma = np.asarray(nib.load(out / "uncertainty.nii.gz").dataobj, np.float32)[mask]
    off, motion = (u - t)[mask], np.linalg.norm(t[mask], axis=-1)
    error = np.linalg.norm(off, axis=-1)
    inverse = np.linalg.inv(affine[:3, :3])
    gradient = lambda f: np.stack([np.stack(np.gradient(f[..., c]), -1) for c in range(3)], -2)[mask] @ inverse
    g, h = gradient(u), gradient(t)
    flip = np.diag([-1.0, -1.0, 1.0])
    still = error[motion < 0.1]
    return {
        "mean_mm": error.mean(),
        "p95_mm": np.percentile(error, 95),
        "still_mm": still.mean() if len(still) > 1000 else np.nan,
        "gradient": np.median(np.linalg.norm(g - h, axis=(-2, -1))),
        "folds": (np.linalg.det(flip @ g + np.eye(3)) <= 0).mean(),
        "inside": (error <= 2.796 * sigma).mean(),
        "motion_mm": motion.mean(),
    }


def measure(job):
    case, name, binary, more, without = job
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        command = [binary, "field", case / "fixed.nii.gz", case / "moving.nii.gz", "-o", out, "--threads", "1", "--quiet", *more]
        done = subprocess.run([sys.executable, HERE.parent / "frontier/usage.py", *map(str, command)], capture_output=True, text=True, env=os.environ | {"PALPATE_WITHOUT": without})
        code, cpu, _, memory = done.stdout.split()
        row = {"case": case.name, "variant": name, "cpu_s": float(cpu), "memory_mb": float(memory)}
        if int(code) != 0:
            return row | {"mean_mm": np.nan, "trust": done.stderr.strip()[-120:]}
        summary = json.loads((out / "summary.json").read_text())
        return row | score(case, out) | {"model": summary.get("model"), "trust": summary.get("trust"), "expected_mm": summary.get("expected_error_mm")}


def table(rows, base):
    """One line a variant over the cases that both it and `base` have measured."""
    by = {(r["case"], r["variant"]): r for r in rows}
    cases = sorted({r["case"] for r in rows})
    number = lambda r, key: float(r[key]) if r[key] not in ("", None) else np.nan
    geometric = lambda v: float(np.exp(np.mean(np.log(v)))) if len(v) else np.nan
    lines = [
        "| variant | cases | error, mean ratio | worst ratio | in | gradient, mean ratio | folds, most (%) | inside 95 %, median | CPU, mean ratio | worst | failed |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for variant in dict.fromkeys(r["variant"] for r in rows):
        both = [(by[c, variant], by[c, base]) for c in cases if (c, variant) in by and (c, base) in by]
        good = [(v, b) for v, b in both if np.isfinite(number(v, "mean_mm")) and np.isfinite(number(b, "mean_mm"))]
        # Where nothing moves a perfect answer has no ratio: a micrometre is no error.
        ratio = lambda key, least: [max(number(v, key), least) / max(number(b, key), least) for v, b in good]
        error = ratio("mean_mm", 1e-3)
        worst = int(np.argmax(error)) if error else 0
        cpu = ratio("cpu_s", 1e-2)
        lines.append(
            f"| {variant} | {len(good)} | {geometric(error):.3f} | {max(error, default=np.nan):.2f} | {good[worst][0]['case'] if good else '-'} | "
            f"{geometric(ratio('gradient', 1e-5)):.3f} | {100 * max((number(v, 'folds') for v, _ in good), default=0):.2f} | "
            f"{np.median([number(v, 'inside') for v, _ in good]):.3f} | {geometric(cpu):.2f} | {max(cpu, default=np.nan):.2f} | {len(both) - len(good)} |"
        )
    return "\n".join(lines) + "\n"


def by_case(rows, variants):
    """One line a case with the error of each variant."""
    by = {(r["case"], r["variant"]): r for r in rows}
    lines = ["| case | motion (mm) | " + " | ".join(variants) + " |", "|" + "---|" * (len(variants) + 2)]
    for case in sorted({r["case"] for r in rows}):
        motion = next((float(r["motion_mm"]) for r in rows if r["case"] == case and r["motion_mm"] not in ("", None)), np.nan)
        cells = []
        for v in variants:
            r = by.get((case, v))
            cells.append("-" if r is None else f"{float(r['mean_mm']):.3f} ({float(r['cpu_s']):.1f} s)")
        lines.append(f"| {case} | {motion:.2f} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--palpate", default=str(HERE.parents[1] / "target/release/palpate"))
    parser.add_argument("--name", default="all", help="name of the whole pipeline in the tables")
    parser.add_argument("--against", help="another build, measured beside it as `before`")
    parser.add_argument("--without", nargs="*", default=[], help=f"mechanisms to switch off in turn, or `each`: {', '.join(MECHANISMS)}")
    parser.add_argument("--preset", nargs="*", default=[], help="presets to measure beside the default")
    parser.add_argument("--only", default="*", help="cases by pattern")
    parser.add_argument("--mask", action="store_true")
    a = parser.parse_args()
    mask = lambda case: ["--mask", case / "mask.nii.gz"] if a.mask else []
    variants = [(a.name, a.palpate, [], "")]
    variants += [("before", a.against, [], "")] if a.against else []
    variants += [(f"--preset {p}", a.palpate, ["--preset", p], "") for p in a.preset]
    variants += [(f"without {w}", a.palpate, [], w) for w in (MECHANISMS if a.without == ["each"] else a.without)]
    cases = sorted(p.parent for p in a.cases.glob("*/truth.nii.gz") if fnmatch.fnmatch(p.parent.name, a.only))
    a.out.mkdir(parents=True, exist_ok=True)
    results = a.out / "results.csv"
    rows = list(csv.DictReader(results.open())) if results.exists() else []
    done = {(r["case"], r["variant"]) for r in rows}
    jobs = [(c, name, binary, more + mask(c), without) for c in cases for name, binary, more, without in variants if (c.name, name) not in done]
    with results.open("a", newline="") as file, ThreadPoolExecutor(2) as pool:
        out = csv.DictWriter(file, FIELDS)
        if not rows:
            out.writeheader()
        for row in pool.map(measure, jobs):
            out.writerow(row)
            file.flush()
    rows = list(csv.DictReader(results.open()))
    text = table(rows, variants[0][0]) + "\n" + by_case(rows, list(dict.fromkeys(r["variant"] for r in rows)))
    (a.out / "table.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
