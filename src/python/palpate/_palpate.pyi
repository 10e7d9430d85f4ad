"""The compiled part; use the functions of ``palpate`` instead. Arrays are in Fortran order, affines are three rows."""

from os import PathLike
from typing import Any, Callable, Dict, List, Optional, Sequence, Tuple, Union

import numpy as np
from numpy.typing import NDArray

_Rows = List[List[float]]
_Image = Tuple[NDArray[np.float32], _Rows]
_Progress = Optional[Callable[[str, float], object]]

__version__: str
#: Of the command line's flags, by command.
DEFAULTS: Dict[str, Dict[str, Any]]

class PalpateError(ValueError):
    """What the command line would say after ``error:``."""

def read_volume(path: Union[str, PathLike[str]]) -> _Image: ...
def read_series(path: Union[str, PathLike[str]]) -> Tuple[List[NDArray[np.float32]], _Rows, Optional[float]]: ...
def field(
    initial: _Image,
    deformed: _Image,
    mask: Optional[_Image],
    params: str,
    names: Sequence[str],
    progress: _Progress = None,
    threads: Optional[int] = None,
) -> Dict[str, Any]: ...
def stiffness(
    displacement: NDArray[np.float32],
    affine: _Rows,
    matches: Optional[NDArray[np.float64]],
    unasked: bool,
    body: _Image,
    labelled: bool,
    names: Dict[int, str],
    held: Union[str, _Image],
    load: Union[str, _Image],
    force: Optional[float],
    poisson: float,
    poisson_of: Dict[int, float],
    fixed: Dict[int, float],
    label_sd: float,
    model: str,
    nodes: int,
    regions: int,
    field_summary: str,
    samples: Optional[Tuple[NDArray[np.float32], _Rows]],
    called: Sequence[str],
    progress: _Progress = None,
    threads: Optional[int] = None,
) -> Dict[str, Any]: ...
def command_line(words: List[str], own: List[str]) -> int: ...

class Pad:
    def summary(self) -> Dict[str, Any]: ...
    def write(self, path: Union[str, PathLike[str]], source: str) -> None: ...

def fingertip(map: _Image, summary: str, nodes: int) -> Pad: ...
def grasp(
    scene: Union[str, PathLike[str]],
    model: Optional[str] = None,
    formulation: Optional[str] = None,
    step: Optional[float] = None,
    progress: _Progress = None,
    threads: Optional[int] = None,
) -> Dict[str, Any]: ...
def track(
    volumes: Sequence[_Image],
    reference: int,
    mask: Optional[_Image],
    labels: Optional[_Image],
    params: str,
    names: Sequence[str],
    regions: Sequence[str],
    together: bool = True,
    step_s: Optional[float] = None,
    progress: _Progress = None,
    threads: Optional[int] = None,
) -> Dict[str, Any]: ...
