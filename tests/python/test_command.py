"""The command line that the package brings."""

import subprocess
import sys

import palpate


def command(*words, cwd=None):
    return subprocess.run([sys.executable, "-m", "palpate", *map(str, words)], cwd=cwd, capture_output=True, text=True)


def test_the_package_brings_the_command(shell):
    assert command("--version").stdout == f"palpate {palpate.__version__}\n"
    assert command("field", "--help").stdout == shell("field", "--help").stdout
    wrong = command("field")
    assert wrong.returncode == 2 and "palpate field" in wrong.stderr
    lost = command("info", "nowhere.nii.gz")
    assert lost.returncode == 1 and "nowhere.nii.gz" in lost.stderr


def test_a_command_that_starts_itself_again_does_so_through_python(shell, pair, tmp_path):
    (tmp_path / "pairs.csv").write_text(f"initial,deformed,mask\n{pair}/initial.nii.gz,{pair}/deformed.nii.gz,{pair}/mask.nii.gz\n")
    done = command("batch", "pairs.csv", "-o", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (found,) = tmp_path.glob("out/*/field/displacement.nii.gz")
    assert found.read_bytes() == (shell.folder / "field/displacement.nii.gz").read_bytes()
