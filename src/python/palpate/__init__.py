"""Inner deformation and stiffness of soft tissue from MR volumes, and a soft-finger grasp simulator.

A volume is given as ``(array, affine)``, as an image of nibabel (anything with ``affine`` and ``dataobj`` or
``get_fdata()``), or as the path of a file. Arrays have shape (nx, ny, nz); affines are 4 x 4, voxels to world mm (RAS).

Results are rounded as the files of the command line are, so that both give the same bits. Work is done without holding
the interpreter. A volume or displacement in float32 and Fortran order is not copied on the way in: leave it, and the file it may
be mapped from, as it is until the work is done. Anything else is converted first. Results are handed over without a copy.
"""

from __future__ import annotations

import json as _json
import os as _os
from typing import Any, Callable, Dict, List, Mapping, Optional, Sequence, Tuple, Union

import numpy as np

from . import _palpate
from ._palpate import DEFAULTS as _DEFAULTS
from ._palpate import PalpateError, __version__

__all__ = [
    "Field",
    "Fingertip",
    "Grasp",
    "PalpateError",
    "Stiffness",
    "Track",
    "__version__",
    "field",
    "fingertip",
    "grasp",
    "stiffness",
    "track",
]

#: A path, ``(array, affine)``, or an image of nibabel.
Image = Any
#: Called with the name of a stage and the part that is done (0 to 1), from any thread.
Progress = Optional[Callable[[str, float], object]]


def _rows(affine: Any) -> List[List[float]]:
    matrix = np.asarray(affine, dtype=np.float64)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise PalpateError(f"an affine has 4 x 4 entries, not {matrix.shape}; give voxels to world mm (RAS)")
    return matrix[:3].tolist()


def _fortran(array: Any, axes: int, what: str) -> np.ndarray:
    array = np.asarray(array)
    while array.ndim > axes and array.shape[-1] == 1:
        array = array[..., 0]
    if array.ndim != axes:
        raise PalpateError(f"{what}: has shape {array.shape}, but {axes} axes are needed")
    if array.dtype.kind not in "biuf":
        raise PalpateError(f"{what}: has values of type {array.dtype}, but numbers are needed")
    with np.errstate(over="ignore"):
        return np.require(array, np.float32, ["F", "A"])


def _data(image: Any) -> Any:
    """What an image of nibabel holds, on the disk as long as it can be."""
    return image.dataobj if hasattr(image, "dataobj") else image.get_fdata()


def _affine(image: Any) -> np.ndarray:
    """The affine of an image of nibabel in mm, whatever unit of length its header names."""
    affine = np.array(image.affine, dtype=np.float64)
    units = getattr(getattr(image, "header", None), "get_xyzt_units", None)
    unit = units()[0] if units is not None else "mm"
    affine[:3] *= {"meter": 1e3, "micron": 1e-3}.get(unit, 1.0)
    return affine


def _image(given: Image, what: str) -> Tuple[np.ndarray, List[List[float]]]:
    """``given`` as an array in Fortran order and three rows of its affine."""
    if isinstance(given, (str, _os.PathLike)):
        return _palpate.read_volume(given)
    if hasattr(given, "affine"):
        return _fortran(_data(given), 3, what), _rows(_affine(given))
    if isinstance(given, (tuple, list)) and len(given) == 2:
        return _fortran(given[0], 3, what), _rows(given[1])
    raise PalpateError(f"{what}: is no volume; give a path, (array, affine), or an image of nibabel")


def _optional(given: Optional[Image], what: str) -> Optional[Tuple[np.ndarray, List[List[float]]]]:
    return None if given is None else _image(given, what)


def _called(given: Image, what: str) -> str:
    """The file's name where there is one."""
    path = given if isinstance(given, (str, _os.PathLike)) else None
    if path is None and hasattr(given, "get_filename"):
        path = given.get_filename()
    return _os.path.basename(_os.fspath(path)) if path else what


def _params(preset: str, points: Optional[int], search: Optional[float], seed: Optional[int], more: Mapping[str, Any]) -> str:
    keys: Dict[str, Any] = {"preset": preset, "points": points, "search_mm": search, "seed": seed}
    return _json.dumps({**{k: v for k, v in keys.items() if v is not None}, **more})


class _Result:
    """What the keys of ``summary`` name can be had as attributes too."""

    #: As summary.json of the command line.
    summary: Dict[str, Any]

    def __init__(self, parts: Mapping[str, Any]) -> None:
        self.__dict__.update(parts)

    def __getattr__(self, name: str) -> Any:
        summary = self.__dict__.get("summary", {})
        if name in summary:
            return summary[name]
        raise AttributeError(f"{type(self).__name__} has no {name}; its summary holds {', '.join(summary)}")

    def __repr__(self) -> str:
        return f"<palpate.{type(self).__name__}: {', '.join(k for k in self.__dict__ if k != 'summary')}>"


def _square(parts: Dict[str, Any]) -> Dict[str, Any]:
    for key in ("affine", "posterior_affine"):
        if key in parts:
            parts[key] = np.array([*parts[key], [0.0, 0.0, 0.0, 1.0]])
    return parts


class Field(_Result):
    """A displacement field on the initial grid, as ``palpate field`` writes it."""

    #: (nx, ny, nz, 3), mm, RAS components (the file's are LPS), initial to deformed.
    displacement: np.ndarray
    #: (nx, ny, nz), the deformed volume at x + u(x).
    warped: np.ndarray
    #: (nx, ny, nz), det(I + grad u).
    jacobian: np.ndarray
    #: (nx, ny, nz), mm, one standard deviation.
    uncertainty: np.ndarray
    #: (nx, ny, nz), the body of each voxel of the mask, from 1; 0 outside it.
    bodies: np.ndarray
    #: (nx, ny, nz, n, 3), mm, RAS, n samples of the field's error: coefficients of cubic B-splines at nodes.
    posterior: np.ndarray
    #: (4, 4), nodes of ``posterior`` to world mm (RAS).
    posterior_affine: np.ndarray
    #: (n, 9), the columns of matches.csv: x, y, z, dx, dy, dz (mm, RAS), ncc, sigma (mm), kept.
    matches: np.ndarray
    #: (n, 3), mm, RAS, initial places of the mesh's nodes.
    nodes: np.ndarray
    #: (m, 4) tetrahedra, (m, 3) triangles for one slice.
    elements: np.ndarray
    #: (n, 3), mm, RAS.
    node_displacement: np.ndarray
    #: (4, 4), voxels to world mm (RAS).
    affine: np.ndarray


class Stiffness(_Result):
    """Young's modulus on the grid of the labels, as ``palpate stiffness`` writes it."""

    #: (nx, ny, nz), kPa with a force, else over the reference region's; 0 outside.
    stiffness: np.ndarray
    #: (nx, ny, nz), its standard deviation; infinite where not identifiable.
    stiffness_sd: np.ndarray
    #: (nx, ny, nz), mm.
    residual: np.ndarray
    #: (n, 3), mm, RAS.
    nodes: np.ndarray
    #: (m, 10), quadratic tetrahedra.
    elements: np.ndarray
    #: (m,), as ``stiffness``.
    element_modulus: np.ndarray
    #: (n, 3), mm, RAS.
    node_displacement: np.ndarray
    #: (4, 4), voxels to world mm (RAS).
    affine: np.ndarray


class Fingertip(_Result):
    """A finger pad as a fingertip of the grasp simulator; ``radius`` (m), ``youngs_modulus`` (Pa), ``hemisphere_kpa`` ..."""

    def __init__(self, pad: _palpate.Pad) -> None:
        super().__init__({"summary": pad.summary(), "_pad": pad})

    def save(self, path: Union[str, "_os.PathLike[str]"], source: str = "stiffness") -> None:
        """Writes the file that ``palpate fingertip`` would write, for ``fingertip.file`` of a scene."""
        self.__dict__["_pad"].write(path, source)


class Grasp(_Result):
    """A simulated grasp."""

    #: (n, 14), SI and radians; the columns are ``trajectory_columns``.
    trajectory: np.ndarray
    #: Names of the trajectory's columns.
    trajectory_columns: List[str]
    #: (n, 11), at the end of each hold, from the rest on; the columns are ``motion_columns``.
    motions: np.ndarray
    #: Names of the motions' columns.
    motion_columns: List[str]


class Track(_Result):
    """A sequence: a displacement from the reference to each frame."""

    #: One (nx, ny, nz, 3) array a frame, mm, RAS; none for a frame that was lost.
    displacement: List[Optional[np.ndarray]]
    #: Points through the frames: ``point``, ``frame``, ``x``, ``y``, ``z``, ``sigma`` (mm), ``state``.
    trajectories: List[Dict[str, Any]]
    #: Strain of each region in each frame.
    strain: List[Dict[str, Any]]
    #: (4, 4), voxels to world mm (RAS).
    affine: np.ndarray


def field(
    initial: Image,
    deformed: Image,
    mask: Optional[Image] = None,
    *,
    preset: str = "balanced",
    points: Optional[int] = None,
    search: Optional[float] = None,
    seed: Optional[int] = None,
    params: Mapping[str, Any] = {},
    progress: Progress = None,
    threads: Optional[int] = None,
) -> Field:
    """The displacement of the tissue from ``initial`` to ``deformed``.

    ``mask`` lies on the initial grid, 0 outside. ``preset`` is fast, balanced or accurate; ``points``, ``search`` (mm) and
    ``seed`` are the flags of ``palpate field``, ``params`` any key of ``params`` in summary.json. Raises `PalpateError`
    with the message of the command line.
    """
    names = [_called(initial, "initial"), _called(deformed, "deformed"), "" if mask is None else _called(mask, "mask")]
    asked = _params(preset, points, search, seed, params)
    return Field(
        _square(
            _palpate.field(
                _image(initial, "initial"),
                _image(deformed, "deformed"),
                _optional(mask, "mask"),
                asked,
                names,
                progress,
                threads,
            )
        )
    )


def stiffness(
    displacement: Union[Field, Tuple[np.ndarray, np.ndarray]],
    *,
    labels: Optional[Image] = None,
    mask: Optional[Image] = None,
    names: Mapping[int, str] = {},
    held: Union[str, Image] = "z-",
    load: Union[str, Image] = "z+",
    force: Optional[float] = None,
    matches: Union[None, bool, np.ndarray] = None,
    poisson: Union[float, Mapping[int, float]] = _DEFAULTS["stiffness"]["poisson"],
    fixed: Mapping[int, float] = {},
    label_sd: float = _DEFAULTS["stiffness"]["label_sd"],
    model: str = "auto",
    nodes: int = _DEFAULTS["stiffness"]["nodes"],
    regions: int = _DEFAULTS["stiffness"]["regions"],
    progress: Progress = None,
    threads: Optional[int] = None,
) -> Stiffness:
    """Young's modulus of each region of ``labels``, or of the regions that are found inside ``mask``.

    ``displacement`` is a `Field`, or an (nx, ny, nz, 3) array (mm, RAS) with its affine. ``held`` and ``load`` are sides
    (``"z-"``) or masks that cover the patch; ``force`` is the total force on the loaded patch in N. ``matches`` are taken in
    place of the field inside the body: those of the `Field` where there are enough, ``False`` for none, or an (n, 9) array.
    ``poisson`` is one ratio, or a mapping from labels to theirs (the default for others). ``fixed`` maps labels to moduli
    that are known (kPa); without a force they set the scale. ``label_sd`` is one standard deviation of the border between
    two labels (voxels). A `Field` also brings its trust, its model and samples of its error.
    """
    if (labels is None) == (mask is None):
        raise PalpateError("give either labels or mask")
    body, what = (labels, "labels") if labels is not None else (mask, "mask")
    if isinstance(displacement, Field):
        array, affine = displacement.displacement, displacement.affine
        beside, told = displacement.matches, displacement.summary
        samples = (np.require(displacement.posterior, np.float32, ["F", "A"]), _rows(displacement.posterior_affine))
    else:
        array, affine = displacement
        beside, told, samples = None, {}, None
    array = np.asarray(array)
    if array.ndim == 5 and array.shape[3] == 1:
        array = array[:, :, :, 0, :]
    unasked = matches is None
    taken = beside if matches is None or matches is True else None if matches is False else np.asarray(matches, float)
    by_label = dict(poisson) if isinstance(poisson, Mapping) else {}
    place = lambda patch, name: patch if isinstance(patch, str) and len(patch) == 2 else _image(patch, name)
    return Stiffness(
        _square(
            _palpate.stiffness(
                _fortran(array, 4, "displacement"),
                _rows(affine),
                taken,
                unasked,
                _image(body, what),
                labels is not None,
                dict(names),
                place(held, "held"),
                place(load, "load"),
                force,
                _DEFAULTS["stiffness"]["poisson"] if by_label else poisson,
                by_label,
                dict(fixed),
                label_sd,
                model,
                nodes,
                regions,
                _json.dumps({key: told.get(key) for key in ("trust", "model")}),
                samples,
                ["displacement", _called(body, what)],
                progress,
                threads,
            )
        )
    )


def fingertip(source: Stiffness, nodes: int = _DEFAULTS["fingertip"]["nodes"]) -> Fingertip:
    """Reduces a stiffness map with bone under the pad to a fingertip; it must be in kPa, that is made with a force.

    ``nodes`` is about how many the finite elements of the map have that are pressed by a flat plate; 0 leaves them out.
    """
    image = (np.asfortranarray(source.stiffness), _rows(source.affine))
    return Fingertip(_palpate.fingertip(image, _json.dumps(source.summary), nodes))


def grasp(
    scene: Union[str, "_os.PathLike[str]"],
    *,
    model: Optional[str] = None,
    formulation: Optional[str] = None,
    step: Optional[float] = None,
    progress: Progress = None,
    threads: Optional[int] = None,
) -> Grasp:
    """Simulates the grasp of a scene file; ``model``, ``formulation`` and ``step`` (s) go before what it says."""
    return Grasp(_palpate.grasp(scene, model, formulation, step, progress, threads))


def _frames(volumes: Any) -> Tuple[List[Image], List[str], Optional[float]]:
    """The volumes, what they are called, and the time between them (s) where the file of a series says so."""
    pair = isinstance(volumes, (tuple, list)) and len(volumes) == 2 and hasattr(volumes[0], "dtype")
    path = isinstance(volumes, (str, _os.PathLike))
    if not pair and not path and not hasattr(volumes, "affine"):
        given = list(volumes)
        return given, [_called(v, f"volume {t}") for t, v in enumerate(given)], None
    called, step = _called(volumes, "volumes"), None
    if path:
        frames, affine, step = _palpate.read_series(volumes)
    else:
        data, affine = volumes if pair else (_data(volumes), _affine(volumes))
        array = np.asarray(data)
        frames = [array[..., t] for t in range(array.shape[3])] if array.ndim == 4 else [array]
    names = [f"{called}[{t}]" for t in range(len(frames))] if len(frames) > 1 else [called]
    return [(frame, affine) for frame in frames], names, step


def track(
    volumes: Union[Sequence[Image], Image],
    *,
    reference: int = 0,
    mask: Optional[Image] = None,
    labels: Optional[Image] = None,
    preset: str = "balanced",
    points: Optional[int] = None,
    search: Optional[float] = None,
    seed: Optional[int] = None,
    params: Mapping[str, Any] = {},
    together: bool = True,
    progress: Progress = None,
    threads: Optional[int] = None,
) -> Track:
    """The displacement from number ``reference`` of ``volumes``, counted from 0, to each other, in the order in which they were
    taken, in mm (RAS).

    ``volumes`` is a list, or one image, path or ``(array, affine)`` with the frames on its fourth axis; of these only a path gives
    the time between frames. Where ``together`` is true, each field is what all frames say of it. ``mask`` and ``labels`` lie on the reference's grid. Raises `PalpateError` with the message of the
    command line.
    """
    frames, names, step = _frames(volumes)
    images = [_image(v, name) for v, name in zip(frames, names)]
    del frames
    asked = _params(preset, points, search, seed, params)
    regions = ["" if given is None else _called(given, what) for given, what in ((mask, "mask"), (labels, "labels"))]
    parts = _palpate.track(
        images,
        reference,
        _optional(mask, "mask"),
        _optional(labels, "labels"),
        asked,
        names,
        regions,
        together,
        step,
        progress,
        threads,
    )
    return Track(_square(parts))
