"""Results in napari. Without napari the layers are looked at alone."""

import nibabel
import numpy as np
import pytest

from palpate import napari as plugin


@pytest.fixture(scope="module")
def results(shell, pair):
    return shell.folder / "field"


def test_a_folder_gives_what_it_holds(results):
    layers = {options["name"]: (data, options, kind) for data, options, kind in plugin.reader(str(results))(None)}
    assert {name: layer[2] for name, layer in layers.items()} == {
        "warped": "image", "uncertainty": "image", "bodies": "labels", "displacement": "vectors", "matches": "points",
    }
    field = nibabel.load(results / "displacement.nii.gz")
    (start, moved), inverse = layers["displacement"][0].transpose(1, 0, 2), np.linalg.inv(field.affine)
    at = (start @ inverse[:3, :3].T + inverse[:3, 3]).round().astype(int)
    assert np.allclose(np.asarray(field.dataobj)[tuple(at.T)][:, 0] * [-1, -1, 1], moved)
    assert len(start) <= plugin.MOST_VECTORS and np.array_equal(layers["warped"][1]["affine"], field.affine)


def test_what_is_not_ours_is_left_to_others(results, tmp_path):
    assert plugin.reader(str(tmp_path)) is None and plugin.reader([str(results)]) is None
    (tmp_path / "warped.nii.gz").write_bytes((results / "warped.nii.gz").read_bytes())
    assert plugin.reader(str(tmp_path / "warped.nii.gz")) is None
    assert plugin.reader(str(results / "summary.json")) is None


def test_napari_takes_the_layers(results):
    napari = pytest.importorskip("napari")
    npe2 = pytest.importorskip("npe2")
    from importlib.resources import files

    manifest = npe2.PluginManifest.from_file(str(files("palpate") / "napari.yaml"))
    assert manifest.contributions.readers[0].accepts_directories
    viewer = napari.components.ViewerModel()
    for data, options, kind in plugin.reader(str(results))(None):
        getattr(viewer, f"add_{kind}")(data, **options)
    assert len(viewer.layers) == 5
    low, high = viewer.layers["warped"].extent.world
    assert (viewer.layers["matches"].data >= low - 1).all() and (viewer.layers["matches"].data <= high + 1).all()
