"""A small pair and a small finger pad, made and measured once by the command line."""

import json
import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


class Shell:
    """The program, run in a folder of its own."""

    def __init__(self, folder):
        self.folder = folder
        self.program = os.environ.get("PALPATE", str(ROOT / "target/debug/palpate"))

    def __call__(self, *arguments, code=0):
        """Ends with ``code``, or with any error where that is none."""
        done = subprocess.run([self.program, *map(str, arguments)], cwd=self.folder, capture_output=True, text=True)
        assert done.returncode == code if code is not None else done.returncode > 0, done.stderr
        return done

    def summary(self, part):
        return json.loads((self.folder / part / "summary.json").read_text())


@pytest.fixture(scope="session")
def shell(tmp_path_factory):
    return Shell(tmp_path_factory.mktemp("palpate"))


@pytest.fixture(scope="session")
def pair(shell):
    shell("phantom", "block", "--size", 32, "--amplitude", 2, "-o", "pair")
    folder = shell.folder / "pair"
    shell("field", folder / "initial.nii.gz", folder / "deformed.nii.gz", "--mask", folder / "mask.nii.gz", "-o", "field")
    return folder


@pytest.fixture(scope="session")
def pad(shell):
    """The pad's folder and what its phantom.json says of its elastic motion."""
    shell("phantom", "fingertip", "--size", 28, "--seed", 2, "--amplitude", 1.5, "-o", "pad")
    folder = shell.folder / "pad"
    elastic = json.loads((folder / "phantom.json").read_text())["elastic"]
    names = {r["label"]: r["name"] for r in elastic["regions"]}
    shell("field", folder / "initial.nii.gz", folder / "deformed.nii.gz", "--mask", folder / "mask.nii.gz", "-o", "pad-field")
    shell(
        "stiffness", "--field", "pad-field", "--labels", folder / "labels.nii.gz", "--nodes", 1500,
        "--names", ",".join(f"{k}={v}" for k, v in names.items()), "--held", elastic["held"], "--load", elastic["load"],
        "--total-force", elastic["force_n"], "-o", "pad-stiffness",
    )
    shell("fingertip", "pad-stiffness", "-o", "fingertip.toml")
    return folder, {**elastic, "names": names}
