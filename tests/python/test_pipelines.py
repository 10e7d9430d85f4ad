"""Interfaces of nipype and tasks of pydra, made from the commands' own descriptions."""

import json
import subprocess

import pytest

from palpate import pipelines


@pytest.mark.parametrize("command", pipelines.COMMANDS)
def test_every_described_command_has_its_options(command):
    options = {option.name: option for option in pipelines.options(command)}
    assert options["output"].is_output and options["output"].flag == "--output"
    assert not any(name.startswith("return_") for name in options)
    assert all(option.flag or option.position is not None for option in options.values())


def test_a_command_without_a_description_is_refused():
    with pytest.raises(ValueError, match="grasp"):
        pipelines.options("grasp")


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pair")
    made = [*pipelines.PROGRAM, "phantom", "block", "--size", "32", "-o", str(folder / "p"), "--quiet"]
    subprocess.run(made, check=True)
    return folder


def inputs(pair, name):
    files = {part: str(pair / "p" / f"{part}.nii.gz") for part in ("initial", "deformed", "mask")}
    return {**files, "output": str(pair / name), "preset": "fast", "strain": True}


def written(pair, name):
    with open(pair / name / "summary.json") as file:
        assert json.load(file)["params"]["preset"] == "fast"
    assert (pair / name / "strain.nii.gz").exists()


def test_nipype_runs_a_command_and_gives_its_output(pair):
    pytest.importorskip("nipype")
    field = pipelines.nipype_interface("field")(**inputs(pair, "nipype"))
    assert field.run().outputs.output == str(pair / "nipype")
    written(pair, "nipype")
    warp = pipelines.nipype_interface("warp")(
        image=str(pair / "p" / "deformed.nii.gz"),
        field=str(pair / "nipype" / "displacement.nii.gz"),
        output=str(pair / "warped.nii.gz"),
    )
    assert warp.run().outputs.output == str(pair / "warped.nii.gz")


def test_pydra_runs_a_command_and_gives_its_output(pair, tmp_path):
    pytest.importorskip("pydra.engine.task")
    task = pipelines.pydra_task("field", cache_dir=str(tmp_path), **inputs(pair, "pydra"))
    assert task().output.output_path == str(pair / "pydra")
    written(pair, "pydra")
