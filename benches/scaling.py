#!/usr/bin/env python3
"""Cost against size: CPU time and memory of `palpate field` over voxels and over points.

    scaling.py OUT_DIR [--palpate BIN] [--sizes N ...] [--points N ...]

Head phantoms with a smooth motion, made by `palpate phantom`; two threads; CPU seconds are user + system of the whole
command. Writes scaling.csv and scaling.svg. Needs matplotlib.
"""
import argparse
import csv
import json
import math
import subprocess
import sys
import tempfile
from pathlib import Path

WATCH = (
    "import resource, subprocess, sys; "
    "p = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL); u = resource.getrusage(resource.RUSAGE_CHILDREN); "
    "print(p.returncode, u.ru_utime + u.ru_stime, u.ru_maxrss * 1024e-6)"
)


def measure(binary, pair, preset, points):
    """CPU seconds, memory (MB), features found and voxels."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        command = [binary, "field", pair / "initial.nii.gz", pair / "deformed.nii.gz", "-o", out, "--preset", preset, "--threads", "2", "--quiet"]
        command += ["--points", points] if points else []
        done = subprocess.run([sys.executable, "-c", WATCH, *map(str, command)], capture_output=True, text=True)
        code, cpu, memory = done.stdout.split()
        if int(code):
            raise SystemExit(done.stderr)
        summary = json.loads((out / "summary.json").read_text())
        return float(cpu), float(memory), summary["counts"]["features_initial"], math.prod(summary["grid"]["shape"])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--palpate", default="target/release/palpate")
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 96, 128, 192, 256, 384, 512])
    parser.add_argument("--points", type=int, nargs="+", default=[1000, 10_000, 100_000, 300_000])
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for size in options.sizes:
            pair = Path(folder) / str(size)
            subprocess.run([options.palpate, "phantom", "head", "--size", str(size), "-o", pair, "--quiet"], check=True, stdout=subprocess.DEVNULL)
            wanted = [0] + (options.points if size == max(options.sizes) else [])
            for preset in ["balanced", "fast"]:
                for points in wanted if preset == "balanced" else [0]:
                    cpu, memory, found, voxels = measure(options.palpate, pair, preset, points)
                    rows.append({"size": size, "voxels": voxels, "preset": preset, "asked": points, "found": found, "cpu_s": cpu, "memory_mb": memory})
                    print(rows[-1], flush=True)
            for path in sorted(pair.glob("*")):
                path.unlink()
    with open(options.out / "scaling.csv", "w", newline="") as f:
        writer = csv.DictWriter(f, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    chart(rows, options.out / "scaling.svg")


def chart(rows, path):
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "palpate", "font.size": 10})
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10.4, 4.2))
    for preset, colour in (("balanced", "#c0392b"), ("fast", "#e59866")):
        some = [(r["voxels"], r["cpu_s"]) for r in rows if r["preset"] == preset and not r["asked"]]
        left.plot(*zip(*some), "o-", color=colour, label=preset)
    x, y = some[-1][0], max(r["cpu_s"] for r in rows if not r["asked"])
    ends = [min(r["voxels"] for r in rows), x]
    left.plot(ends, [y * e / x for e in ends], ":", color="0.6", label="proportional")
    left.set(xscale="log", yscale="log", xlabel="voxels of the volume", ylabel="CPU time (s), files included", title="Cost over voxels")
    some = [(r["found"], r["cpu_s"]) for r in rows if r["asked"]]
    right.plot(*zip(*sorted(some)), "o-", color="#c0392b")
    right.set(xscale="log", xlabel="points found in the initial volume", ylabel="CPU time (s)", title="Cost over points (the largest volume)", ylim=(0, 1.08 * max(v for _, v in some)))
    left.legend(frameon=False)
    for axis in (left, right):
        axis.grid(which="both", color="0.92", lw=0.6)
        for side in ("top", "right"):
            axis.spines[side].set_visible(False)
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    main()
