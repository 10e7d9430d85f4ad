#!/usr/bin/env python3
"""Gain over wavelength, and noise: the presets of `palpate field` beside SPAM's local digital volume correlation.

    waves.py -o DIR [--palpate BIN] [--size N] [--seed S] [--methods NAME ...] [--spam-python PYTHON]

The scene is the star of the DIC Challenge 2.0 in a volume of N x 2N x N/2 voxels: u_z = A cos(2 pi x / lambda), A half a
voxel, lambda from 8 to 64 voxels along y. The texture is Gaussian speckle; both volumes have white noise of 15 % of it.
Each method measures two draws of the noise, in a process of its own with one thread.

gain          u_z (mean of the draws) projected on the true cosine, a row of y at a time, smoothed over 9 rows
cut-off       wavelength where the best rising fit of the gain reaches 90 % or 50 %; "<": it is above from the start;
              the fit evens out a dip, so look at the curve too
noise         standard deviation of u_z in one draw: half the difference of the two draws, times sqrt 2
strain noise  the same of du_z/dz: differences over one voxel each way, and slopes of lines through 5 and 9 voxels
CPU seconds   user + system of one draw's process, start-up and files included (mean of two)

SPAM's windows of 9, 13 and 21 voxels count as its -hws does (4, 6, 10); it leaves one voxel each side out of the sum. Nodes
lie 3, 4 and 5 voxels apart, with a cubic spline between. The rest are the defaults of spam-ldic, but for cubic
interpolation of the volumes, which SPAM recommends. Away from the middle the waves lie oblique, so cut-offs read a few
percent long, for all methods alike. palpate's cut-off depends on --size, so name the size beside it.
DIR gets waves.csv, curves.csv, table.md and waves.svg.
Needs numpy, scipy, nibabel, matplotlib, palpate; SPAM (pip: spam) is left out where it is not installed.
"""
import argparse
import csv
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy import ndimage, optimize

USAGE = Path(__file__).resolve().parents[1] / "frontier" / "usage.py"
AMPLITUDE, SHORTEST, LONGEST = 0.5, 8.0, 64.0
# The widest window and its margin reach 13 voxels: nothing nearer to the border is scored.
BORDER = 14
# Name: half window, node spacing.
SPAM = {"SPAM 9": (4, 3), "SPAM 13": (6, 4), "SPAM 21": (10, 5)}
OURS = ["palpate fast", "palpate balanced", "palpate accurate"]
GAINS, GAUGES = (12, 16, 24, 32, 48, 64), (5, 9)
COLOURS = ["#f1a9a0", "#c0392b", "#641e16", "#85c1e9", "#2e86c1", "#1b4f72"]


def wavelengths(rows):
    """Wavelength of each row of y; 8 and 64 voxels lie at the first and the last scored row."""
    return SHORTEST * (LONGEST / SHORTEST) ** ((np.arange(rows) - BORDER) / (rows - 1 - 2 * BORDER))


def scene(size, seed):
    """Both volumes without noise, and the true u_z in voxels."""
    shape = (size, 2 * size, size // 2)
    rng = np.random.default_rng(seed)
    # A lattice of half a voxel makes the spline as good as exact. No value is negative.
    texture = ndimage.gaussian_filter(rng.standard_normal([2 * n + 24 for n in shape]), 2 * 1.2, mode="wrap")
    spline = ndimage.spline_filter(500 + 90 * texture / texture.std(), order=3, mode="mirror")
    offset = 6 + rng.uniform(0, 0.5, 3)
    x, y, z = np.meshgrid(*map(np.arange, shape), indexing="ij", sparse=True)
    true = AMPLITUDE * np.cos(2 * np.pi * (x - (size - 1) / 2) / wavelengths(shape[1])[:, None]) + 0.0 * z
    at = lambda u: 2 * np.stack(np.broadcast_arrays(x + offset[0], y + offset[1], z + offset[2] + u))
    # The deformed volume is the texture; the initial one is the texture at the deformed places.
    return *(ndimage.map_coordinates(spline, at(u), order=3, prefilter=False, mode="mirror") for u in (true, 0.0 * true)), true


def draw(images, seed, number, folder):
    """Writes the two volumes with their own noise, for palpate and for SPAM."""
    import nibabel as nib

    rng = np.random.default_rng([seed, 1 + number])
    folder.mkdir()
    for name, image in zip(("initial", "deformed"), images):
        noisy = np.float32(image + 0.15 * images[1].std() * rng.standard_normal(image.shape))
        nib.save(nib.Nifti1Image(noisy, np.eye(4)), folder / f"{name}.nii.gz")
        np.save(folder / f"{name}.npy", noisy)


def measure(method, folder, options):
    """CPU seconds and u_z in voxels."""
    out = folder / method.replace(" ", "_")
    if method in SPAM:
        # SPAM has workers of its own: one of them, and one thread in it.
        command = [options.spam_python, __file__, "spam", folder, f"{out}.npy", *SPAM[method]]
    else:
        command = [options.palpate, "field", folder / "initial.nii.gz", folder / "deformed.nii.gz", "-o", out]
        command += ["--preset", method.split()[1], "--threads", 1, "--quiet"]
    surroundings = os.environ | {n: "1" for n in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")}
    done = subprocess.run([sys.executable, USAGE, *map(str, command)], capture_output=True, text=True, env=surroundings)
    code, cpu = (done.stdout.split() or [1, 0])[:2]
    if int(code):
        raise SystemExit(f"{method}: {(done.stderr.strip() or 'failed').splitlines()[-1]}")
    if method in SPAM:
        print(f"{method}: {done.stderr.strip()}", file=sys.stderr)
        return float(cpu), np.load(f"{out}.npy")
    import nibabel as nib

    return float(cpu), np.asarray(nib.load(out / "displacement.nii.gz").dataobj, float)[:, :, :, 0, 2]


def spam(folder, out, half, spacing):
    """SPAM's part, in its own process: u_z at the nodes by local correlation, then at the voxels."""
    import spam.DIC

    images = [np.load(Path(folder) / f"{n}.npy") for n in ("initial", "deformed")]
    nodes, dimensions = spam.DIC.makeGrid(images[0].shape, spacing)
    found, status, *_ = spam.DIC.ldic(*images, nodes, [half] * 3, processes=1, interpolationOrder=3)
    u, good = found[:, 2, 3].reshape(dimensions), status.reshape(dimensions) == 2
    # Windows that leave the volume, or do not converge, take the nearest good node.
    u = u[tuple(ndimage.distance_transform_edt(~good, return_distances=False, return_indices=True))]
    # The first node lies one spacing from the border.
    places = np.meshgrid(*(np.arange(n) / spacing - 1 for n in images[0].shape), indexing="ij")
    np.save(out, ndimage.map_coordinates(u, places, order=3, mode="nearest"))
    inner = np.all((nodes >= BORDER) & (nodes < np.array(images[0].shape) - BORDER), 1)
    print(f"{np.mean(status[inner] != 2):.2%} of the nodes did not converge", file=sys.stderr)


def cut(wavelength, gain, level):
    """Wavelength at which the rising fit reaches the level."""
    rising = optimize.isotonic_regression(gain).x
    if rising[-1] < level:
        return "none"
    k = int(np.argmax(rising >= level))
    if k == 0:
        return f"<{wavelength[0]:.1f}"
    part = (level - rising[k - 1]) / (rising[k] - rising[k - 1])
    return f"{wavelength[k - 1] + part * (wavelength[k] - wavelength[k - 1]):.1f}"


def score(fields, true):
    """Numbers of the table, wavelengths and gains."""
    inner = (slice(BORDER, -BORDER),) * 3
    cosine = true[inner] - true[inner].mean((0, 2), keepdims=True)
    smooth = lambda v: np.convolve(v.sum((0, 2)), np.ones(9), "same")
    wavelength = wavelengths(true.shape[1])[BORDER:-BORDER]
    gain = smooth(np.mean(fields, 0)[inner] * cosine) / smooth(cosine**2)
    half = (fields[0] - fields[1]) / 2
    spread = lambda v: np.sqrt(2) * v[inner].std()
    row = {"cutoff_90": cut(wavelength, gain, 0.9), "cutoff_50": cut(wavelength, gain, 0.5), "noise_1e-3_voxel": f"{1e3 * spread(half):.2f}"}
    row |= {f"gain_{w}": f"{np.interp(w, wavelength, gain):.3f}" for w in GAINS}
    row["strain_1_1e-6"] = f"{1e6 * spread(np.gradient(half, axis=2)):.0f}"
    for gauge in GAUGES:
        # The slope of the least-squares line through so many voxels.
        reach = np.arange(gauge) - gauge // 2
        row[f"strain_{gauge}_1e-6"] = f"{1e6 * spread(ndimage.correlate1d(half, reach / (reach**2).sum(), axis=2)):.0f}"
    return row, wavelength, gain


def table(rows):
    heads = ["method", "CPU s", "90 % cut-off", "50 % cut-off", "noise (1e-3 voxel)", *(f"gain {w}" for w in GAINS)]
    heads += ["strain noise, 1 voxel", *(f"gauge {g}" for g in GAUGES)]
    lines = [heads, ["---"] + ["---:"] * (len(heads) - 1), *([r[k] for k in rows[0]] for r in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n\nWavelengths in voxels, strain noise of du_z/dz in 1e-6.\n"


def chart(rows, curves, path):
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "palpate", "font.size": 10})
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(9.2, 4.6))
    for row, (wavelength, gain) in zip(rows, curves):
        colour = COLOURS[(OURS + list(SPAM)).index(row["method"])]
        label = f"{row['method']}: {float(row['noise_1e-3_voxel']):.1f}"
        # Accurate may lie on balanced: both stay visible.
        style = ":" if row["method"] == OURS[2] else "--" if row["method"] in SPAM else "-"
        axis.plot(wavelength, gain, style, color=colour, lw=2.4, label=label)
    for level in (0.5, 0.9, 1.0):
        axis.axhline(level, color="0.7", ls="-" if level == 1 else ":", lw=1, zorder=0)
    axis.set(xscale="log", xlabel="wavelength (voxels)", ylabel="gain", xlim=(SHORTEST, LONGEST), title="Share of the true amplitude found")
    axis.set_ylim(min(-0.02, *(g.min() - 0.02 for _, g in curves)), max(1.1, *(1.02 * g.max() for _, g in curves)))
    ticks = [8, 12, 16, 24, 32, 48, 64]
    axis.set_xticks(ticks, [str(t) for t in ticks])
    axis.minorticks_off()
    axis.grid(color="0.92", lw=0.6)
    axis.legend(frameon=False, loc="center left", bbox_to_anchor=(1.01, 0.5), title="noise (1e-3 voxel)", alignment="left")
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--palpate", default="target/release/palpate")
    parser.add_argument("--size", type=int, default=96, help="voxels along x, 64 or more (%(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--methods", nargs="+", default=OURS + list(SPAM), choices=OURS + list(SPAM), metavar="NAME")
    parser.add_argument("--spam-python", default=sys.executable, help="the Python that has SPAM (this one)")
    options = parser.parse_args()
    if options.size < 64:
        parser.error("--size: 64 or more")
    if any(m in SPAM for m in options.methods):
        there = subprocess.run([options.spam_python, "-c", "import spam.DIC"], capture_output=True, text=True)
        if there.returncode:
            print(f"SPAM is left out: {(there.stderr.strip() or 'it does not start').splitlines()[-1]}", file=sys.stderr)
            options.methods = [m for m in options.methods if m not in SPAM]
    if not options.methods:
        raise SystemExit("nothing to run")
    options.out.mkdir(parents=True, exist_ok=True)
    *images, true = scene(options.size, options.seed)
    rows, curves = [], []
    with tempfile.TemporaryDirectory() as folder:
        draws = [Path(folder) / str(n) for n in range(2)]
        for number, place in enumerate(draws):
            draw(images, options.seed, number, place)
        for method in options.methods:
            cpu, fields = zip(*(measure(method, place, options) for place in draws))
            row, *curve = score(fields, true)
            rows.append({"method": method, "cpu_s": f"{np.mean(cpu):.1f}"} | row)
            curves.append(curve)
            print(rows[-1], flush=True)
    with open(options.out / "waves.csv", "w", newline="") as f:
        writer = csv.DictWriter(f, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    with open(options.out / "curves.csv", "w", newline="") as f:
        writer = csv.writer(f)
        writer.writerow(["wavelength", *(r["method"] for r in rows)])
        writer.writerows([[f"{v:.4f}" for v in line] for line in zip(curves[0][0], *(g for _, g in curves))])
    (options.out / "table.md").write_text(table(rows))
    chart(rows, curves, options.out / "waves.svg")


if __name__ == "__main__":
    if sys.argv[1:2] == ["spam"]:
        spam(*sys.argv[2:4], *map(int, sys.argv[4:]))
    else:
        main()
