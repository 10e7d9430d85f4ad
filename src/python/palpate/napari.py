"""Results in napari: ``pip install palpate[napari]``, then open a folder that palpate wrote.

A folder of ``palpate field`` gives the warped volume, the displacement as vectors, the bodies as labels and the kept
matches as points; maps of ``strain`` and ``stiffness`` are images. Layers lie in world mm (RAS).
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any, Callable, Dict, List, Optional, Tuple, Union

import numpy as np

#: Data, options and kind of a napari layer.
Layer = Tuple[Any, Dict[str, Any], str]
#: Vectors that are shown at most: as many as can be told apart in a view.
MOST_VECTORS = 20_000
#: What is shown of a folder, in order, and how.
SHOWN = {
    "warped.nii.gz": "image",
    "uncertainty.nii.gz": "image",
    "shear.nii.gz": "image",
    "volume_change.nii.gz": "image",
    "stiffness.nii.gz": "image",
    "residual.nii.gz": "image",
    "bodies.nii.gz": "labels",
    "regions.nii.gz": "labels",
    "displacement.nii.gz": "vectors",
    "matches.csv": "points",
}
#: Maps that lie over the volume.
OVERLAYS = {"uncertainty": "magma", "shear": "viridis", "volume_change": "PiYG", "stiffness": "viridis", "residual": "magma"}


def reader(path: Union[str, List[str]]) -> Optional[Callable[[Any], List[Layer]]]:
    """A function that reads ``path``; none where it is no result of palpate."""
    if isinstance(path, list):
        return None
    found = Path(path)
    files = [found / name for name in SHOWN] if found.is_dir() else [found]
    files = [file for file in files if file.name in SHOWN and file.is_file()]
    ours = (found if found.is_dir() else found.parent) / "summary.json"
    return (lambda _: [layer(file) for file in files]) if files and ours.is_file() else None


def layer(file: Path) -> Layer:
    """The layer of a result."""
    kind, name = SHOWN[file.name], file.name.split(".")[0]
    if kind == "points":
        return points(file)
    import nibabel

    image = nibabel.load(file)
    options: Dict[str, Any] = {"name": name, "affine": image.affine}
    if kind == "vectors":
        return vectors(np.asarray(image.dataobj)[:, :, :, 0, :], image.affine, name)
    data = np.asarray(image.dataobj)
    if kind == "labels":
        return data.astype(np.int32), options, "labels"
    if name in OVERLAYS:
        options.update(colormap=OVERLAYS[name], blending="additive", opacity=0.6, visible=name != "uncertainty")
    return data, options, "image"


def vectors(lps: np.ndarray, affine: np.ndarray, name: str) -> Layer:
    """Displacement (mm, LPS) at every n-th voxel, as vectors in world mm (RAS)."""
    every = max(1, int(np.ceil((lps[..., 0].size / MOST_VECTORS) ** (1 / 3))))
    at = np.stack(np.meshgrid(*[np.arange(0, n, every) for n in lps.shape[:3]], indexing="ij"), -1).reshape(-1, 3)
    moved = lps[tuple(at.T)] * [-1, -1, 1]
    seen = np.isfinite(moved).all(1) & (np.abs(moved).max(1) > 0)
    at, moved = at[seen], moved[seen]
    places = at @ affine[:3, :3].T + affine[:3, 3]
    length = np.linalg.norm(moved, axis=1)
    options = {
        "name": name,
        "features": {"magnitude_mm": length},
        "edge_color": "magnitude_mm",
        "edge_colormap": "viridis",
        "vector_style": "arrow",
    }
    return np.stack([places, moved], axis=1), options, "vectors"


def points(file: Path) -> Layer:
    """Places of the kept matches (world mm, RAS)."""
    with open(file, newline="") as table:
        rows = [row for row in csv.DictReader(table) if row["kept"] == "1"]
    places = np.array([[float(row[axis]) for axis in "xyz"] for row in rows]).reshape(-1, 3)
    sigma = np.array([float(row["sigma"]) for row in rows])
    return places, {"name": "matches", "size": 2, "features": {"sigma_mm": sigma}}, "points"
