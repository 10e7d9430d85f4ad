#!/usr/bin/env python3
"""Runs `palpate stiffness` on a set of bodies (make.py) and holds what it finds against the truth.

    score.py BIN SET [KIND-PATTERN] [--nodes 8000] [--out results.json] [--bodies DIR] [--extra "..."] [--poisson-flag FLAG]

SET is a folder in DIR (choose, report); KIND-PATTERN is a shell pattern on kinds or cases (slab*, ball_large_2), several with commas.
Per region: truth, found, sd, z = ln(found / truth) / (sd / found), state and whether a bound is false. Per kind: see `table`.

States: ok (given with a deviation), lower, upper and unknown (bounds), missed (no region found there), absent (no result).
A false bound is an upper bound below the truth or a lower bound above it. A silent failure is a modulus that is given with
a deviation, off by over 30 % and over 2.5 deviations, or a missed region, in a run without any warning and with exit code 0.
Without a force, ratios to the reference region are held against the true ratios.
"""
import argparse
import fnmatch
import json
import math
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import nibabel as nib
import numpy as np

FAR, SURE = 0.30, 2.5


def run(binary, folder, case, given, out):
    """Runs the command on a case; returns its exit code, CPU seconds and last lines."""
    body = ["--labels", "labels.nii.gz"] if case["labelled"] else ["--mask", "mask.nii.gz"]
    command = [binary, "stiffness", "--field", "displacement.nii.gz", *body, *case["args"], "--nodes", str(given.nodes),
               "--threads", "1", "--quiet", "-o", str(out), *given.extra.split()]
    if given.poisson_flag and "poisson" in case:
        command += [given.poisson_flag, ",".join(f"{k}={v}" for k, v in case["poisson"].items())]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return done.returncode, cpu, done.stderr.strip().splitlines()[-2:]


def matched(folder, out, truth):
    """Which found label lies at each true label of a case without labels: {true: found or None}, by Dice of 0.4 and more."""
    true = np.asarray(nib.load(folder / "truth_labels.nii.gz").dataobj)
    found = np.asarray(nib.load(out / "regions.nii.gz").dataobj)
    pairs = {}
    for label in truth:
        a = true == label
        dice = {int(k): 2 * (a & (found == k)).sum() / (a.sum() + (found == k).sum()) for k in np.unique(found) if k}
        best = max(dice, key=dice.get, default=None)
        pairs[label] = best if best is not None and dice[best] >= 0.4 else None
    return pairs


def score(folder, binary, given):
    """Rows of one case, one a region."""
    case = json.loads((folder / "case.json").read_text())
    truth = {int(k): v for k, v in case["truth"].items()}
    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary) / "out"
        code, cpu, last = run(str(Path(binary).resolve()), folder, case, given, out)
        summary = json.loads((out / "summary.json").read_text()) if (out / "summary.json").exists() else None
        pairs = {k: k for k in truth}
        if summary and not case["labelled"]:
            pairs = matched(folder, out, truth)
    common = {"kind": case["kind"], "case": folder.name, "exit": code, "cpu_s": round(cpu, 2), "expect": case.get("expect"),
              "wrong_labels": case.get("wrong_labels", False), "smooth": case.get("smooth", False),
              "warnings": len(summary["warnings"]) if summary else None, "texts": summary["warnings"] if summary else last}
    regions = {r["label"]: r for r in summary["regions"]} if summary else {}
    one = next((k for k, r in regions.items() if r["ratio"] == 1 and r["ratio_sd"] == 0), None)
    rows = []
    for label, true in truth.items():
        region = regions.get(pairs[label])
        row = dict(common, label=label, truth=true, found=None, sd=None, z=None, error=None, false_bound=False, silent=False)
        if region is None:
            row["state"] = "missed" if summary and not case["labelled"] else "absent"
            row["silent"] = row["state"] == "missed" and code == 0 and row["warnings"] == 0
        else:
            read(row, region, summary["absolute"], truth, one, pairs)
        rows.append(row)
    if one is not None and not summary["absolute"]:
        rows = [row for row in rows if pairs[row["label"]] != one]
    return rows


def read(row, region, absolute, truth, one, pairs):
    """Fills a row from a region of summary.json."""
    row["found"], row["sd"] = (region["youngs_modulus"], region["sd"]) if absolute else (region["ratio"], region["ratio_sd"])
    if not absolute:
        reference = next((k for k, v in pairs.items() if v == one), None)
        row["truth"] = row["truth"] / truth[reference] if reference is not None else float("nan")
    row["state"] = "ok" if region["identifiable"] else region["bound"] or "unknown"
    if row["state"] in ("lower", "upper"):
        row["false_bound"] = row["found"] > row["truth"] if row["state"] == "lower" else row["found"] < row["truth"]
        row["sd"] = None
    elif row["state"] == "ok" and row["found"] > 0:
        row["error"] = math.log(row["found"] / row["truth"])
        row["z"] = row["error"] / (row["sd"] / row["found"]) if row["sd"] else math.inf
        far = abs(row["found"] / row["truth"] - 1) > FAR and abs(row["z"]) > SURE
        row["silent"] = far and row["exit"] == 0 and row["warnings"] == 0


def text(value, form="{:.3g}"):
    """A number as text, or a dash."""
    return "-" if value is None else form.format(value)


def show(row):
    """Prints one region."""
    notes = [name for name, on in (("FALSE BOUND", row["false_bound"]), ("SILENT", row["silent"])) if on]
    print(f"{row['case']:28} {row['label']:>2} {text(row['truth']):>8} {text(row['found']):>8} {text(row['sd']):>8} "
          f"{text(row['error'] and 100 * math.expm1(row['error']), '{:+.1f}'):>8} {text(row['z'], '{:+.2f}'):>7} {row['state']:>8} "
          f"{row['exit']:>4} {text(row['warnings'], '{}'):>4} {row['cpu_s']:>7.1f}  {' '.join(notes)}", flush=True)


def summed(name, rows):
    """One line of the table."""
    z = np.abs([r["z"] for r in rows if r["z"] is not None])
    error = np.abs([r["error"] for r in rows if r["error"] is not None])
    count = {state: sum(r["state"] == state for r in rows) for state in ("lower", "upper", "unknown", "missed", "absent")}
    cpu = {r["case"]: r["cpu_s"] for r in rows}
    return {"kind": name, "regions": len(rows), "given": len(z), "bounds": count["lower"] + count["upper"] + count["unknown"],
            "missed": count["missed"], "absent": count["absent"], "mean_z": z.mean() if len(z) else None, "worst_z": z.max() if len(z) else None,
            "under_2": (z < 2).mean() if len(z) else None, "under_3": (z < 3).mean() if len(z) else None,
            "false_bounds": sum(r["false_bound"] for r in rows), "silent": sum(r["silent"] for r in rows),
            "warned": np.mean([(r["warnings"] or 0) > 0 for r in rows]), "mean_ln_error": error.mean() if len(error) else None, "cpu_s": np.mean(list(cpu.values()))}


def table(rows):
    """Prints and returns a line a kind and one for all whose answer is to be right (not wrong_labels, not expect)."""
    kinds = list(dict.fromkeys(r["kind"] for r in rows))
    lines = [summed(kind, [r for r in rows if r["kind"] == kind]) for kind in kinds]
    plain = [r for r in rows if not r["wrong_labels"] and not r["expect"]]
    if plain:
        lines.append(summed("all (right labels)", plain))
    print(f"\n{'kind':24} regions given bounds missed absent  mean|z| worst|z|  |z|<2  |z|<3 false silent warned mean|ln| CPU s")
    for t in lines:
        print(f"{t['kind']:24} {t['regions']:>7} {t['given']:>5} {t['bounds']:>6} {t['missed']:>6} {t['absent']:>6} {text(t['mean_z'], '{:.2f}'):>8} "
              f"{text(t['worst_z'], '{:.2f}'):>8} {text(t['under_2'], '{:.0%}'):>6} {text(t['under_3'], '{:.0%}'):>6} {t['false_bounds']:>5} "
              f"{t['silent']:>6} {t['warned']:>6.0%} {text(t['mean_ln_error'], '{:.3f}'):>8} {t['cpu_s']:>5.1f}")
    return lines


def plainly(value):
    """Numpy's numbers as Python's, for JSON."""
    return value.item() if hasattr(value, "item") else str(value)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("binary")
    parser.add_argument("set")
    parser.add_argument("pattern", nargs="?", default="*")
    parser.add_argument("--nodes", type=int, default=8000)
    parser.add_argument("--out", help="JSON of all results")
    parser.add_argument("--bodies", default="target/bodies", help="folder of sets (default: %(default)s)")
    parser.add_argument("--extra", default="", help="further arguments of the command, as one text")
    parser.add_argument("--poisson-flag", help="argument that takes LABEL=NU,..., given where a case has ratios by label")
    given = parser.parse_args()
    patterns = given.pattern.split(",")
    folders = [f.parent for f in sorted((Path(given.bodies) / given.set).glob("*/case.json"))
               if any(fnmatch.fnmatch(f.parent.name, p) or fnmatch.fnmatch(f.parent.name.rsplit("_", 1)[0], p) for p in patterns)]
    if not folders:
        sys.exit("no such cases")
    print(f"{'case':28} {'at':>2} {'truth':>8} {'found':>8} {'sd':>8} {'error %':>8} {'z':>7} {'state':>8} exit warn   CPU s")
    rows = []
    for folder in folders:
        new = score(folder, given.binary, given)
        for row in new:
            show(row)
        rows += new
    lines = table(rows)
    if given.out:
        Path(given.out).write_text(json.dumps({"binary": given.binary, "set": given.set, "nodes": given.nodes, "kinds": lines,
                                               "regions": rows}, indent=1, default=plainly) + "\n")


if __name__ == "__main__":
    main()
