#!/usr/bin/env python3
"""Speed against accuracy: this program and other registration tools on cases with exact truth, side by side in one run.

    run.py CASES_DIR OUT_DIR [--palpate BIN] [--methods NAME ...] [--score SCRIPT]

CASES_DIR holds one folder a case with fixed.nii.gz, moving.nii.gz, truth.nii.gz (5-D, intent 1007, LPS mm) and
mask.nii.gz. Each method runs in a process of its own with two threads, one at a time; CPU seconds are user + system of that
process and its children, start-up and files included. OUT_DIR gets results.csv, a line as soon as a run ends (a second
call goes on where the first stopped), table.md and frontier.svg. Needs numpy, scipy, nibabel, matplotlib; what other
tools are missing is left out.
"""
import argparse
import csv
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
OURS = ["palpate fast", "palpate balanced"]
PEERS = ["greedy half", "greedy full", "elastix", "plastimatch", "demons"]
FIELDS = ["case", "method", "mean_mm", "median_mm", "p95_mm", "still_mm", "grad_err", "folds", "identity_mm", "cpu_s", "wall_s", "memory_mb"]


def field(path):
    """Displacement (mm, RAS, one vector a voxel) and affine of a 5-D NIfTI in LPS."""
    import nibabel as nib

    image = nib.load(path)
    return np.asarray(image.dataobj, np.float32)[:, :, :, 0] * np.float32([-1, -1, 1]), image.affine


def score(case, path):
    """Error of a field in the mask: mean, median, 95 % (mm), error in still tissue, median gradient error, folds."""
    import nibabel as nib

    (u, affine), (t, _) = field(path), field(case / "truth.nii.gz")
    mask = np.asarray(nib.load(case / "mask.nii.gz").dataobj) > 0
    error, length = np.linalg.norm((u - t)[mask], axis=-1), np.linalg.norm(t[mask], axis=-1)
    inverse = np.linalg.inv(affine[:3, :3])
    gradient = lambda f: np.stack([np.stack(np.gradient(f[..., c]), -1) for c in range(3)], -2) @ inverse
    g, h = gradient(u)[mask], gradient(t)[mask]
    still = error[length < 0.1]
    return {
        "mean_mm": error.mean(),
        "median_mm": np.median(error),
        "p95_mm": np.percentile(error, 95),
        "still_mm": still.mean() if len(still) > 1000 else np.nan,
        "grad_err": np.median(np.linalg.norm(g - h, axis=(-2, -1))),
        "folds": (np.linalg.det(g + np.eye(3)) <= 0).mean(),
        "identity_mm": length.mean(),
    }


def run(binary, case, method, out, more=()):
    """CPU seconds, wall seconds, memory (MB) and the field's path. `more` goes to our own command."""
    fixed, moving = case / "fixed.nii.gz", case / "moving.nii.gz"
    if method.startswith("palpate"):
        command = [binary, "field", fixed, moving, "-o", out, "--preset", method.split()[1], "--threads", "2", "--quiet", *more]
        field = out / "displacement.nii.gz"
    else:
        field = out.with_suffix(".nii.gz")
        command = [sys.executable, HERE / "peers.py", method, fixed, moving, field]
    # A process between this one and the tool: its children's usage is this run's alone.
    done = subprocess.run([sys.executable, HERE / "usage.py", *map(str, command)], capture_output=True, text=True)
    code, cpu, wall, memory = done.stdout.split()
    if int(code) != 0:
        raise RuntimeError(f"{method} on {case.name}: {done.stderr.strip()}")
    return float(cpu), float(wall), float(memory), field


def means(rows, key):
    """Mean of `key` over cases, by method; only cases that every method has."""
    by = defaultdict(dict)
    for r in rows:
        by[r["method"]][r["case"]] = float(r[key])
    common = set.intersection(*(set(v) for v in by.values()))
    return {m: float(np.mean([v[c] for c in sorted(common)])) for m, v in by.items()}, len(common)


def label(axis, points, colour):
    """Names each point beside it where nothing is written yet; further away a line leads to the name."""
    scale = 72 / axis.figure.dpi
    places = axis.transData.transform([p[:2] for p in points]) * scale
    taken = [(x - 5, y - 5, x + 5, y + 5) for x, y in places]
    left, right, low, high = (v * scale for v in (axis.bbox.x0, axis.bbox.x1, axis.bbox.y0, axis.bbox.y1))
    beside = [("left", 8, -3), ("right", -8, -3), ("center", 0, 8), ("center", 0, -16)]
    away = [(side, sign * far, dy) for far in (14, 26, 40) for dy in (far - 3, -far - 3) for side, sign in (("left", 1), ("right", -1))]
    for (c, e, m), (x, y) in zip(points, places):
        width, tried = 6.2 * len(m), []
        for side, dx, dy in beside + away:
            start = x + dx - {"left": 0, "right": width, "center": width / 2}[side]
            box = (start - 2, y + dy - 2, start + width + 2, y + dy + 9)
            outside = box[0] < left or box[2] > right or box[1] < low or box[3] > high
            shared = sum(max(0, min(box[2], t[2]) - max(box[0], t[0])) * max(0, min(box[3], t[3]) - max(box[1], t[1])) for t in taken)
            tried.append((1e4 * outside + shared, len(tried), side, (dx, dy), box))
        _, number, side, offset, box = min(tried)
        taken.append(box)
        lead = {"arrowprops": {"arrowstyle": "-", "color": "0.6", "lw": 0.8, "shrinkA": 0, "shrinkB": 3, "relpos": (side == "right", 0.5)}} if number >= len(beside) else {}
        axis.annotate(m, (c, e), xytext=offset, textcoords="offset points", ha=side, color=colour(m), **lead)


def chart(rows, groups, path):
    """Error against CPU time, log-log, one point a method, the Pareto front drawn."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "palpate", "font.size": 10})
    import matplotlib.pyplot as plt
    import matplotlib.ticker

    colour = lambda m: "#c0392b" if m.startswith("palpate") else "#34495e"
    panels = []
    figure, axes = plt.subplots(1, len(groups), figsize=(5.6 * len(groups), 4.6), squeeze=False)
    for axis, (title, inside) in zip(axes[0], groups):
        some = [r for r in rows if inside(r["case"])]
        (error, count), (cpu, _) = means(some, "mean_mm"), means(some, "cpu_s")
        still = np.mean(list({r["case"]: float(r["identity_mm"]) for r in some}.values()))
        points = sorted((cpu[m], error[m], m) for m in error)
        front, best = [], np.inf
        for c, e, m in points:
            if e < best:
                front.append((c, e))
                best = e
        axis.plot(*zip(*front), color="0.6", lw=1.2, zorder=1)
        for c, e, m in points:
            axis.scatter(c, e, s=46, color=colour(m), zorder=2)
        axis.axhline(still, color="0.75", ls=":", lw=1)
        axis.annotate("before registration", (1, still), xycoords=("axes fraction", "data"), xytext=(-4, 3), textcoords="offset points", ha="right", color="0.5")
        axis.set(xscale="log", yscale="log", xlabel="CPU time (s), files included", ylabel="mean error (mm)")
        axis.set_title(f"{title} ({count} cases)", fontsize=11)
        low, high = axis.get_xlim()
        axis.set_xlim(low / 3, high * 2.5)
        axis.set_ylim(axis.get_ylim()[0] / 1.3, None)
        for which in (axis.xaxis, axis.yaxis):
            which.set_major_locator(matplotlib.ticker.LogLocator(subs=(1, 2, 5)))
            which.set_major_formatter(matplotlib.ticker.FuncFormatter(lambda v, _: f"{v:g}"))
            which.set_minor_formatter(matplotlib.ticker.NullFormatter())
        axis.grid(which="both", color="0.92", lw=0.6)
        for side in ("top", "right"):
            axis.spines[side].set_visible(False)
        panels.append((axis, points))
    figure.tight_layout()
    for axis, points in panels:
        label(axis, points, colour)
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def table(rows, groups):
    """Markdown: one table a group."""
    out = []
    for title, inside in groups:
        some = [r for r in rows if inside(r["case"])]
        columns = {k: means(some, k)[0] for k in ("mean_mm", "p95_mm", "grad_err", "folds", "cpu_s", "wall_s", "memory_mb")}
        count = means(some, "mean_mm")[1]
        still = defaultdict(list)
        for r in some:
            if r["still_mm"] not in ("", "nan"):
                still[r["method"]].append(float(r["still_mm"]))
        identity = np.mean(list({r["case"]: float(r["identity_mm"]) for r in some}.values()))
        out += [f"### {title}", "", f"{count} cases, {identity:.2f} mm before registration.", ""]
        out += ["| method | mean error (mm) | 95 % (mm) | gradient error | still tissue (mm) | folds | CPU (s) | wall (s) | memory (MB) |"]
        out += ["|---|---|---|---|---|---|---|---|---|"]
        for m in sorted(columns["cpu_s"], key=columns["cpu_s"].get):
            c = {k: v[m] for k, v in columns.items()}
            s = f"{np.mean(still[m]):.3f}" if still[m] else ""
            out += [f"| {m} | {c['mean_mm']:.3f} | {c['p95_mm']:.2f} | {c['grad_err']:.4f} | {s} | {c['folds']:.0e} | {c['cpu_s']:.2f} | {c['wall_s']:.2f} | {c['memory_mb']:.0f} |"]
        out += [""]
    return "\n".join(out)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--palpate", default="target/release/palpate")
    parser.add_argument("--methods", nargs="+", default=OURS + PEERS)
    parser.add_argument("--groups", nargs="+", default=["=all cases"], help="PREFIX=title: cases whose name starts so")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    log = options.out / "results.csv"
    rows = list(csv.DictReader(open(log))) if log.exists() else []
    done = {(r["case"], r["method"]) for r in rows}
    missing = set()
    cases = sorted(p.parent for p in options.cases.glob("*/truth.nii.gz"))
    for case in cases:
        for method in options.methods:
            if (case.name, method) in done or method in missing:
                continue
            with tempfile.TemporaryDirectory() as folder:
                try:
                    cpu, wall, memory, field = run(options.palpate, case, method, Path(folder) / "out")
                    row = {k: f"{v:.6g}" for k, v in score(case, field).items()}
                except RuntimeError as problem:
                    print(problem, file=sys.stderr)
                    if "ModuleNotFoundError" in str(problem) or "No such file or directory: 'plastimatch'" in str(problem):
                        missing.add(method)
                    continue
            row |= {"case": case.name, "method": method, "cpu_s": f"{cpu:.3f}", "wall_s": f"{wall:.3f}", "memory_mb": f"{memory:.0f}"}
            rows.append(row)
            fresh = not log.exists()
            with open(log, "a", newline="") as f:
                writer = csv.DictWriter(f, FIELDS)
                if fresh:
                    writer.writeheader()
                writer.writerow(row)
            print(f"{case.name:12} {method:18} {float(row['mean_mm']):.3f} mm  grad {float(row['grad_err']):.4f}  {cpu:7.2f} s", flush=True)
    groups = []
    for g in options.groups:
        prefix, title = g.split("=", 1)
        groups.append((title, lambda name, prefix=prefix: name.startswith(prefix)))
    groups = [(t, f) for t, f in groups if any(f(r["case"]) for r in rows)]
    (options.out / "table.md").write_text(table(rows, groups))
    chart(rows, groups, options.out / "frontier.svg")


if __name__ == "__main__":
    main()
