"""The Snakemake workflow on a cohort of phantoms: a pair that is broken, a command that fails once, a kill, and the group report.

PALPATE_SUBJECTS says how many subjects: 20 without it.
"""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from conftest import ROOT

pytest.importorskip("snakemake")
sys.path.insert(0, str(ROOT / "examples/cohort"))
from make_cohort import make  # noqa: E402

SUBJECTS = int(os.environ.get("PALPATE_SUBJECTS", "20"))


def snakemake(folder, program, *arguments):
    command = [sys.executable, "-m", "snakemake", "-s", str(ROOT / "examples/cohort/Snakefile"), "--cores", "2", *arguments]
    command += ["--config", "table=data/pairs.csv", "output=out", f"palpate={program}", "preset=fast", "nodes=1000"]
    log = open(folder / "snakemake.txt", "w")
    return subprocess.Popen(command, cwd=folder, stdout=log, stderr=subprocess.STDOUT, start_new_session=True)


def finish(process, folder, code=0):
    found = process.wait()
    said = (folder / "snakemake.txt").read_text()
    assert found == code, said
    return said


def table(folder, name="batch.csv"):
    with open(folder / "out" / name, newline="") as file:
        return list(csv.DictReader(file))


def test_a_cohort_from_end_to_end(shell, tmp_path):
    make(tmp_path / "data", SUBJECTS, 36, 1, shell.program)
    names = [f"sub-{n:02}_ses-01" for n in range(1, SUBJECTS + 1)]

    # The first subject's volume is damaged; the last one's stiffness fails once, as a busy node might. Fingertips of all but the
    # first, which is compared below, are pressed with fewer elements.
    broken = tmp_path / "data/sub-01/ses-01/anat/sub-01_ses-01_desc-after_T2w.nii.gz"
    whole = broken.read_bytes()
    broken.write_bytes(whole[: len(whole) // 2])
    flaky = tmp_path / "flaky.sh"
    flaky.write_text(
        f'#!/bin/sh\ncase "$*" in stiffness*{names[-1]}*) if mkdir "{tmp_path}/once" 2>/dev/null; then exit 1; fi;;\n'
        f'fingertip*{names[0]}*) ;; fingertip*) set -- "$@" --nodes 500;; esac\n'
        f'exec "{shell.program}" "$@"\n'
    )
    flaky.chmod(0o755)

    # Killed once a pair's stiffness is on record, as what is made of it shows.
    process = snakemake(tmp_path, flaky, "--keep-going")
    started = time.monotonic()
    while not list(tmp_path.glob("out/*/fingertip.toml")) and process.poll() is None:
        assert time.monotonic() - started < 600
        time.sleep(0.05)
    assert process.poll() is None, (tmp_path / "snakemake.txt").read_text()
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    through = [p.parent / "stiffness/summary.json" for p in tmp_path.glob("out/*/fingertip.toml")]
    done = {p: p.stat().st_mtime_ns for p in through}

    # Taken up: all but the broken one come through, and the tables say so.
    finish(snakemake(tmp_path, flaky, "--unlock"), tmp_path)
    said = finish(snakemake(tmp_path, flaky, "--keep-going", "--rerun-incomplete"), tmp_path, code=1)
    assert (tmp_path / "once").exists() and "Trying to restart job" in said
    assert done and all(p.stat().st_mtime_ns == at for p, at in done.items()), "what was done is done again"
    rows = table(tmp_path)
    assert [r["name"] for r in rows] == names
    assert [r["status"] for r in rows] == ["failed"] + ["done"] * (SUBJECTS - 1)
    assert rows[0]["stage"] == "field" and broken.name in rows[0]["reason"]

    # Mended: only that pair is run, then the group report is made.
    broken.write_bytes(whole)
    before = {n: (tmp_path / f"out/{n}/grasp/summary.json").stat().st_mtime_ns for n in names[1:]}
    finish(snakemake(tmp_path, flaky, "--rerun-triggers", "mtime"), tmp_path)
    assert before == {n: (tmp_path / f"out/{n}/grasp/summary.json").stat().st_mtime_ns for n in names[1:]}
    rows = table(tmp_path)
    assert [r["status"] for r in rows] == ["done"] * SUBJECTS
    assert all(float(r["fingertip_kpa"]) > 0 for r in rows)
    regions = table(tmp_path, "regions.csv")
    truth = json.loads((tmp_path / "data/press-1/phantom.json").read_text())["elastic"]["regions"]
    assert len(regions) == SUBJECTS * len(truth)
    group = json.loads((tmp_path / "out/summary.json").read_text())
    assert group["failed"] == 0 and {r["region"] for r in group["regions"]} == {r["name"] for r in truth}
    page = (tmp_path / "out/report.html").read_text()
    assert page.count("<circle") == len(regions)

    # What one machine makes of the same table is the same.
    alone = tmp_path / "alone.csv"
    with open(tmp_path / "data/pairs.csv", newline="") as file:
        first = list(csv.DictReader(file))[:1]
    for column in ("initial", "deformed", "mask", "labels", "scene"):
        first[0][column] = f"data/{first[0][column]}"
    with open(alone, "w", newline="") as file:
        writer = csv.DictWriter(file, first[0].keys())
        writer.writeheader()
        writer.writerows(first)
    subprocess.run(
        [shell.program, "batch", alone, "-o", tmp_path / "alone", "--preset", "fast", "--nodes", "1000"], check=True
    )
    for part in ("field/displacement.nii.gz", "stiffness/stiffness.nii.gz", "grasp/trajectory.csv"):
        assert (tmp_path / "alone" / names[0] / part).read_bytes() == (tmp_path / "out" / names[0] / part).read_bytes()


def test_every_job_has_a_place_on_a_cluster(shell, tmp_path):
    """The dry run with the Slurm executor plans the same jobs."""
    pytest.importorskip("snakemake_executor_plugin_slurm")
    make(tmp_path / "data", 1, 36, 1, shell.program)
    process = snakemake(tmp_path, shell.program, "--dry-run", "--executor", "slurm", "--jobs", "4")
    said = finish(process, tmp_path)
    for rule in ("field", "stiffness", "fingertip", "grasp", "collect"):
        assert f"rule {rule}:" in said or f"localrule {rule}:" in said, said
