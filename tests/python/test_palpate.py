"""The Python package gives the bits of the command line, and its words."""

import csv
import json
import subprocess
import sys
import threading
import time
from pathlib import Path

import nibabel
import numpy as np
import pytest

import palpate
from conftest import ROOT

# Only the command line has these.
RUN = ("command_line", "working_folder", "date", "files")
TIMES = ("seconds", *RUN)


def same(found, expected):
    """Equal in every bit, but for the sign of zero."""
    assert found.dtype == expected.dtype and found.shape == expected.shape
    assert np.array_equal(found, expected, equal_nan=True)


def volume(path):
    return np.asarray(nibabel.load(path).dataobj)


def lps(array):
    return array * np.array([-1, -1, 1], np.float32)


def check_field(found, folder, summary):
    same(lps(found.displacement), volume(folder / "displacement.nii.gz")[:, :, :, 0, :])
    same(found.warped, volume(folder / "warped.nii.gz"))
    same(found.jacobian, volume(folder / "jacobian.nii.gz"))
    same(found.uncertainty, volume(folder / "uncertainty.nii.gz"))
    same(found.bodies, volume(folder / "bodies.nii.gz"))
    same(found.affine, nibabel.load(folder / "displacement.nii.gz").affine)
    table = list(csv.reader(open(folder / "matches.csv")))
    assert table[0] == "x y z dx dy dz ncc sigma kept raw_dx raw_dy raw_dz raw_sigma".split()
    expected = np.array(table[1:], float)[:, :9]
    expected[:, 6] = expected[:, 6].astype(np.float32)
    assert np.allclose(found.matches, expected, rtol=0, atol=1e-12)
    for key in summary.keys() - set(TIMES):
        assert found.summary[key] == summary[key], key


def images(folder, *names):
    return [nibabel.load(folder / f"{n}.nii.gz") for n in names]


def test_field_equals_the_command_line_for_images_arrays_and_paths(shell, pair):
    summary = shell.summary("field")
    given = images(pair, "initial", "deformed", "mask")
    check_field(palpate.field(*given), shell.folder / "field", summary)
    check_field(palpate.field(*[pair / f"{n}.nii.gz" for n in ("initial", "deformed", "mask")]), shell.folder / "field", summary)
    arrays = palpate.field(*[(np.asarray(i.dataobj), i.affine) for i in given], threads=1)
    same(lps(arrays.displacement), volume(shell.folder / "field/displacement.nii.gz")[:, :, :, 0, :])
    assert arrays.inputs == {"initial": "initial", "deformed": "deformed", "mask": "mask"}


def test_images_in_another_unit_of_length_are_the_same_to_it(pair):
    """A header in micrometres made a motion a thousand times as large, without a word."""
    micro = []
    for image in images(pair, "initial", "deformed", "mask"):
        affine = np.diag([1e3, 1e3, 1e3, 1]) @ image.affine
        scaled = nibabel.Nifti1Image(np.asarray(image.dataobj), affine)
        scaled.header.set_xyzt_units("micron", "sec")
        micro.append(scaled)
    plain = palpate.field(*images(pair, "initial", "deformed", "mask"))
    found = palpate.field(*micro)
    assert np.allclose(found.affine, plain.affine, atol=1e-4)
    assert np.allclose(found.displacement, plain.displacement, atol=1e-3)


@pytest.mark.parametrize("threads", [-1, 0, 100000])
def test_threads_past_reason_are_refused(pair, threads):
    with pytest.raises(palpate.PalpateError, match="must be 1 to 1024"):
        palpate.field(*images(pair, "initial", "deformed"), threads=threads)


def test_summary_is_had_by_name(shell, pair):
    found = palpate.field(*images(pair, "initial", "deformed", "mask"), preset="fast", seed=3)
    assert found.params["preset"] == "fast" and found.params["seed"] == 3
    assert found.counts["kept"] == int(found.matches[:, 8].sum())
    with pytest.raises(AttributeError, match="displacement_mean_mm"):
        found.no_such_key


def test_arrays_are_taken_as_they_come(pair):
    initial, deformed = images(pair, "initial", "deformed")
    kinds = [np.float64, np.int16, np.float32]
    order = [np.ascontiguousarray, np.asfortranarray, np.asfortranarray]
    found = [
        palpate.field(*[(o(np.asarray(i.dataobj, k)), i.affine) for i in (initial, deformed)], preset="fast").displacement
        for k, o in zip(kinds, order)
    ]
    same(found[0], found[1])
    same(found[0], found[2])
    given = np.asfortranarray(initial.dataobj, np.float32)
    before = given.copy()
    palpate.field((given, initial.affine), deformed, preset="fast")
    same(given, before)


def test_stiffness_fingertip_and_grasp_equal_the_command_line(shell, pad, tmp_path):
    folder, elastic = pad
    field = palpate.field(*images(folder, "initial", "deformed", "mask"))
    check_field(field, shell.folder / "pad-field", shell.summary("pad-field"))
    found = palpate.stiffness(
        field,
        labels=folder / "labels.nii.gz",
        names=elastic["names"],
        held=elastic["held"],
        load=elastic["load"],
        force=elastic["force_n"],
        nodes=1500,
    )
    results = shell.folder / "pad-stiffness"
    for name in ("stiffness", "stiffness_sd", "residual"):
        same(getattr(found, name), volume(results / f"{name}.nii.gz"))
    summary = shell.summary("pad-stiffness")
    for key in summary.keys() - {*TIMES, "inputs"}:
        assert found.summary[key] == summary[key], key

    tip = palpate.fingertip(found)
    tip.save(tmp_path / "fingertip.toml", source="pad-stiffness")
    assert (tmp_path / "fingertip.toml").read_bytes() == (shell.folder / "fingertip.toml").read_bytes()
    assert tip.youngs_modulus > 0 and tip.radius > 0

    scene = tmp_path / "scene.toml"
    scene.write_text((ROOT / "examples/finger_pad.toml").read_text())
    grasp = palpate.grasp(scene)
    shell("grasp", scene, "-o", "grasp")
    expected = shell.summary("grasp")
    for key in ("completed", "events", "energy_drift", "constraint_drift", "stable_steps", "steps"):
        assert grasp.summary[key] == expected[key], key
    with open(shell.folder / "grasp/trajectory.csv") as file:
        rows = list(csv.reader(file))
    assert rows[0] == grasp.trajectory_columns and len(rows) - 1 == len(grasp.trajectory)


def test_grasp_equals_the_command_line(shell):
    scene = ROOT / "examples/eight_motions.toml"
    shell("grasp", scene, "-o", "eight")
    found = palpate.grasp(scene)
    expected = shell.summary("eight")
    for key in expected.keys() - set(TIMES):
        assert found.summary[key] == expected[key], key
    for name, columns, values, skipped in (
        ("trajectory", found.trajectory_columns, found.trajectory, 0),
        ("motions", found.motion_columns, found.motions, 1),
    ):
        rows = list(csv.reader(open(shell.folder / f"eight/{name}.csv")))
        assert rows[0][skipped:] == columns
        same(values, np.array([row[skipped:] for row in rows[1:]], float))


def test_track_equals_the_command_line(shell):
    shell("phantom", "pinch", "--frames", 3, "--size", 24, "-o", "pinch")
    frames = [shell.folder / f"pinch/frame_{t:03}.nii.gz" for t in range(3)]
    mask, labels = (shell.folder / f"pinch/{n}.nii.gz" for n in ("mask", "labels"))
    shell("track", *frames, "--mask", mask, "--labels", labels, "-o", "tracked")
    found = palpate.track([nibabel.load(f) for f in frames], mask=mask, labels=labels)
    for t in range(3):
        same(lps(found.displacement[t]), volume(shell.folder / f"tracked/displacement_{t:03}.nii.gz")[:, :, :, 0, :])
    # The same as one series, and in images with an axis too many.
    loaded = [nibabel.load(f) for f in frames]
    series = nibabel.Nifti1Image(np.stack([np.asarray(f.dataobj) for f in loaded], axis=-1), loaded[0].affine)
    series.header.set_xyzt_units("mm", "msec")
    series.header.set_zooms((*series.header.get_zooms()[:3], 40))
    nibabel.save(series, shell.folder / "series.nii.gz")
    shell("track", "series.nii.gz", "--mask", mask, "--labels", labels, "-o", "series")
    one = [nibabel.Nifti1Image(np.asarray(f.dataobj)[..., None], f.affine) for f in loaded]
    path = shell.folder / "series.nii.gz"
    for given in (path, nibabel.load(path), (series.dataobj, series.affine), one):
        again = palpate.track(given, mask=mask, labels=labels)
        assert len(again.displacement) == 3
        for t in range(3):
            same(again.displacement[t], found.displacement[t])
        if given is path:
            told = shell.summary("series")
            assert told["step_s"] == 0.04
            for key in ("inputs", "step_s", "params"):
                assert again.summary[key] == told[key], key
    two = palpate.track(one[:2])
    assert two.displacement[1].shape == loaded[0].shape + (3,)
    rows = list(csv.DictReader(open(shell.folder / "tracked/strain.csv")))
    assert [f"{r['volume_change']:.6f}" for r in found.strain] == [r["volume_change"] for r in rows]
    told = shell.summary("tracked")
    assert found.points == told["points"] and set(found.summary) == set(told) - set(RUN)
    for key in ("inputs", "grid", "reference", "step_s", "params", "warnings"):
        assert found.summary[key] == told[key], key


def test_errors_are_those_of_the_command_line(shell, pair):
    initial, deformed = images(pair, "initial", "deformed")
    far = initial.affine.copy()
    far[0, 3] += 5000
    nibabel.save(nibabel.Nifti1Image(np.asarray(deformed.dataobj), far), shell.folder / "far.nii.gz")
    said = shell("field", pair / "initial.nii.gz", "far.nii.gz", "-o", "none", code=1).stderr
    with pytest.raises(palpate.PalpateError) as caught:
        palpate.field(initial, (np.asarray(deformed.dataobj), far))
    assert str(caught.value) in said and "overlap" in str(caught.value)
    said = shell("field", pair / "initial.nii.gz", "nowhere.nii.gz", "-o", "none", code=1).stderr
    with pytest.raises(palpate.PalpateError) as caught:
        palpate.field(initial, "nowhere.nii.gz")
    assert str(caught.value) in said
    cases = [
        (lambda: palpate.field(initial, deformed, points=5), "points is 5"),
        (lambda: palpate.field(initial, deformed, params={"pases": 3}), "pases"),
        (lambda: palpate.field(initial, deformed, preset="quick"), "balanced"),
        (lambda: palpate.field(initial, deformed, mask=(np.ones((4, 4, 4)), far)), "mask: does not overlap"),
        (lambda: palpate.field(initial, 3), "deformed: is no volume"),
        (lambda: palpate.field((np.ones((4, 4)), np.eye(4)), deformed), "3 axes"),
        (lambda: palpate.field((np.ones((4, 4, 4)), np.eye(2)), deformed), "4 x 4"),
        (lambda: palpate.stiffness((np.zeros((4, 4, 4, 3)), np.eye(4))), "either labels or mask"),
        (lambda: palpate.grasp("nowhere.toml"), "nowhere.toml"),
        (lambda: palpate.track([initial]), "one volume"),
        (lambda: palpate.track(initial), "one volume"),
    ]
    for call, message in cases:
        with pytest.raises(palpate.PalpateError, match=message):
            call()


def test_errors_of_the_other_parts_are_those_of_the_command_line_too(shell, pair, pad, tmp_path):
    folder, elastic = pad
    displacement, labels = shell.folder / "pad-field/displacement.nii.gz", folder / "labels.nii.gz"
    field = nibabel.load(displacement)
    field = (lps(np.asarray(field.dataobj)[:, :, :, 0, :]), field.affine)
    far = tmp_path / "far.nii.gz"
    image = nibabel.load(labels)
    moved = image.affine.copy()
    moved[:3, 3] += 5000
    nibabel.save(nibabel.Nifti1Image(np.asarray(image.dataobj), moved), far)

    def refused(*arguments):
        return shell(*arguments, "-o", tmp_path / "none.toml", code=None).stderr

    def stiffness(labels=labels, **more):
        flags = [f"--{key}={value}" for key, value in more.items()]
        said = refused("stiffness", "--field", displacement, "--labels", labels, *flags)
        return said, lambda: palpate.stiffness(field, labels=labels, matches=False, **more)

    ratios = shell.folder / "pad-ratios"
    held = {"held": elastic["held"], "load": elastic["load"]}
    shell(
        "stiffness", "--field", displacement, "--labels", labels, "--nodes=500", *[f"--{k}={v}" for k, v in held.items()],
        "-o", ratios,
    )
    ratio = palpate.stiffness(field, labels=labels, nodes=500, matches=False, **held)
    scene = tmp_path / "scene.toml"
    scene.write_text((ROOT / "examples/finger_pad.toml").read_text() + "\n[stray]\nkey = 1\n")
    frame = pair / "initial.nii.gz"
    cases = [
        stiffness(poisson=0.5),
        stiffness(force=-1.0),
        stiffness(held="z+", load="z+"),
        stiffness(labels=far),
        (refused("fingertip", ratios), lambda: palpate.fingertip(ratio)),
        (refused("grasp", scene), lambda: palpate.grasp(scene)),
        (refused("track", frame), lambda: palpate.track([frame])),
        (refused("track", frame), lambda: palpate.track(frame)),
        (refused("track", frame, frame, "--reference", 2), lambda: palpate.track([frame, frame], reference=2)),
    ]
    for said, call in cases:
        with pytest.raises(palpate.PalpateError) as caught:
            call()
        # An array has no file of its own to be called by.
        assert str(caught.value) in said.replace(str(displacement), "displacement"), said


def test_what_is_known_by_label_equals_the_command_line(shell, pad, tmp_path):
    folder, elastic = pad
    source = shell.folder / "pad-field/displacement.nii.gz"
    data = nibabel.load(source)
    alone = tmp_path / "alone.nii.gz"
    alone.write_bytes(source.read_bytes())
    labels = folder / "labels.nii.gz"
    first, second = (int(v) for v in np.unique(np.asarray(nibabel.load(labels).dataobj))[1:3])
    shell(
        "stiffness", "--field", alone, "--labels", labels, "--nodes=500", f"--poisson={first}=0.45", f"--fixed={second}=30",
        "--label-sd=1", *[f"--{key}={elastic[key]}" for key in ("held", "load")], "-o", tmp_path / "known",
    )
    found = palpate.stiffness(
        (lps(np.asarray(data.dataobj)[:, :, :, 0, :]), data.affine), labels=labels, nodes=500, poisson={first: 0.45},
        fixed={second: 30.0}, label_sd=1.0, held=elastic["held"], load=elastic["load"],
    )
    summary = json.loads((tmp_path / "known/summary.json").read_text())
    for key in summary.keys() - {*TIMES, "inputs"}:
        assert found.summary[key] == summary[key], key
    with pytest.raises(palpate.PalpateError, match="no label 99"):
        palpate.stiffness((lps(np.asarray(data.dataobj)[:, :, :, 0, :]), data.affine), labels=labels, fixed={99: 1.0})


def test_labels_on_another_grid_are_resampled_as_on_the_command_line(shell, pad, tmp_path):
    folder, elastic = pad
    alone, cropped = tmp_path / "alone.nii.gz", tmp_path / "cropped.nii.gz"
    alone.write_bytes((shell.folder / "pad-field/displacement.nii.gz").read_bytes())
    data, labels = nibabel.load(alone), nibabel.load(folder / "labels.nii.gz")
    # Behind the first slice, in the same place.
    affine = labels.affine.copy()
    affine[:, 3] += affine[:, 0]
    nibabel.save(nibabel.Nifti1Image(np.asarray(labels.dataobj)[1:], affine), cropped)
    held = {"held": elastic["held"], "load": elastic["load"]}
    said = shell(
        "stiffness", "--field", alone, "--labels", cropped, "--nodes=500", *[f"--{k}={v}" for k, v in held.items()],
        "-o", tmp_path / "known",
    ).stderr
    assert "cropped.nii.gz: lies on another grid than alone.nii.gz" in said
    field = (lps(np.asarray(data.dataobj)[:, :, :, 0, :]), data.affine)
    with pytest.warns(UserWarning, match="lies on another grid than"):
        found = palpate.stiffness(field, labels=cropped, nodes=500, **held)
    assert found.summary["regions"] == json.loads((tmp_path / "known/summary.json").read_text())["regions"]


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc to know the peak of memory")
def test_arrays_are_worked_on_where_they_lie():
    """Volumes and a displacement of hundreds of MB, of which no voxel is ever written, take no memory unless they are copied."""
    script = (
        "import numpy as np, palpate\n"
        "before, after = (np.zeros((512, 512, 400), np.float32, order='F') for _ in range(2))\n"
        "peak = lambda: int(open('/proc/self/status').read().split('VmHWM:')[1].split()[0])\n"
        "start = peak()\n"
        "try:\n"
        "    palpate.field((before, np.eye(4)), (after, np.eye(4)))\n"
        "except palpate.PalpateError as error:\n"
        "    assert 'constant' in str(error)\n"
        "else:\n"
        "    raise AssertionError('a constant volume is measured')\n"
        "try:\n"
        "    field = np.zeros((512, 512, 100, 3), np.float32, order='F')\n"
        "    far = np.array([[1, 0, 0, 5000], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])\n"
        "    palpate.stiffness((field, np.eye(4)), labels=(np.ones((2, 2, 2)), far))\n"
        "except palpate.PalpateError as error:\n"
        "    assert 'overlap' in str(error)\n"
        "else:\n"
        "    raise AssertionError('labels that lie elsewhere are taken')\n"
        "print(peak() - start)\n"
    )
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert int(said) < 100_000, f"{int(said) / 1000:.0f} MB"


def test_progress_is_told_and_what_it_raises_is_raised(pair):
    given = images(pair, "initial", "deformed")
    told = []
    palpate.field(*given, preset="fast", progress=lambda stage, part: told.append((stage, part)))
    assert len(told) > 3 and all(isinstance(s, str) and 0 <= p <= 1 for s, p in told)

    def stop(stage, part):
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        palpate.field(*given, preset="fast", progress=stop)


def test_the_interpreter_is_free_meanwhile(pair):
    given = images(pair, "initial", "deformed")
    ended, beats = threading.Event(), []

    def beat():
        while not ended.is_set():
            beats.append(time.monotonic())
            time.sleep(0.001)

    thread = threading.Thread(target=beat)
    thread.start()
    start = time.monotonic()
    palpate.field(*given, preset="accurate", threads=1)
    end = time.monotonic()
    ended.set()
    thread.join()
    inside = [b for b in beats if start <= b <= end]
    assert len(inside) > 0.1 * (end - start) / 0.001, f"{len(inside)} beats in {end - start:.2f} s"


def test_the_tutorial_runs(pad, tmp_path, monkeypatch, capsys):
    folder, elastic = pad
    for name, source in (("before", "initial"), ("after", "deformed"), ("mask", "mask"), ("labels", "labels")):
        (tmp_path / f"{name}.nii.gz").write_bytes((folder / f"{source}.nii.gz").read_bytes())
    monkeypatch.chdir(tmp_path)
    known = {"NAMES": elastic["names"], "HELD": elastic["held"], "LOAD": elastic["load"], "FORCE": elastic["force_n"]}
    known["EXAMPLES"] = str(ROOT / "examples")
    blocks = (ROOT / "docs/tutorials/python.md").read_text().split("```python\n")[1:]
    assert len(blocks) == 8
    for number, block in enumerate(blocks):
        exec(compile(block.split("```")[0], f"tutorial block {number}", "exec"), known)
    said = capsys.readouterr().out
    assert "kPa" in said and "degrees" in said and (tmp_path / "displacement.nii.gz").exists()
