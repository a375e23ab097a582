"""Types of the native part of the package sci; shapes, ranges and meanings are in the docstrings (help(sci.reconstruct))."""

import os
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

_Video = NDArray[np.float32]
_Cfa = Literal["rggb", "bggr", "grbg", "gbrg"]
_Demosaicer = Literal["malvar", "menon", "bilinear"]
# denoiser(noisy [T, C, H, W], sigma 0 to 1 or None) -> [T, C, H, W]
_Callable = Callable[[_Video, float | None], ArrayLike]

__version__: str

def reconstruct(
    measurement: ArrayLike,
    masks: ArrayLike,
    config: str | os.PathLike[str] = "gray/default",
    truth: ArrayLike | None = None,
    progress: bool | Callable[[int, int, int, float | None], object] | None = True,
    **settings: Any,
) -> tuple[_Video, dict[str, Any]]: ...
def calibrate(
    measurement: ArrayLike,
    masks: ArrayLike,
    *,
    cfa: _Cfa | None = None,
    reach: float = 2.0,
    clock: bool = False,
) -> tuple[_Video, dict[str, Any]]: ...
def simulate(
    video: ArrayLike,
    masks: ArrayLike,
    *,
    cfa: _Cfa | None = None,
    sigma: float = 0.0,
    photons: float | None = None,
    seed: int = 0,
    **camera: Any,
) -> _Video: ...
def random_masks(shape: tuple[int, int, int], density: float = 0.5, seed: int = 0) -> _Video: ...
def shifting_masks(shape: tuple[int, int, int], density: float = 0.5, seed: int = 0) -> _Video: ...
def psnr(reference: ArrayLike, video: ArrayLike) -> float: ...
def ssim(reference: ArrayLike, video: ArrayLike, window: Literal["uniform", "gaussian"] = "uniform") -> float: ...
def experiments() -> list[str]: ...
def run_command(arguments: Sequence[str]) -> None: ...

class MaskOperator:
    def __init__(self, masks: ArrayLike) -> None: ...
    @property
    def shape(self) -> tuple[int, int, int]: ...
    @property
    def masks(self) -> _Video: ...
    @property
    def gram(self) -> _Video: ...
    def forward(self, video: ArrayLike) -> _Video: ...
    def adjoint(self, measurement: ArrayLike) -> _Video: ...

class Denoiser:
    def __init__(self, kind: str, *, color: bool = False, **keys: Any) -> None: ...
    @property
    def kind(self) -> str: ...
    def __call__(self, noisy: ArrayLike, sigma: float | None = None, iteration: int = 0) -> _Video: ...

class Solver:
    def solve(
        self,
        measurement: ArrayLike,
        masks: MaskOperator | ArrayLike,
        stages: Sequence[tuple[float | None, int]],
        *,
        start: Literal["mean", "adjoint"] | ArrayLike | None = "mean",
        cfa: _Cfa | None = None,
        noise: float | None = None,
        clip: float | None = None,
        relative_change: float = 0.0,
        seconds: float | None = None,
        callback: Callable[[int, _Video], object] | None = None,
    ) -> tuple[_Video, dict[str, Any]]: ...

class Gap(Solver):
    def __init__(
        self,
        denoiser: Denoiser | _Callable,
        *,
        accelerate: bool = True,
        momentum: Literal["measurement", "zero"] = "measurement",
        restart: bool = False,
        demosaicer: _Demosaicer = "menon",
    ) -> None: ...

class Admm(Solver):
    def __init__(
        self, denoiser: Denoiser | _Callable, *, gamma: float = 0.01, demosaicer: _Demosaicer = "menon"
    ) -> None: ...

class TwoStage(Solver):
    def __init__(
        self,
        denoiser: Denoiser | _Callable,
        *,
        rho: float = 1.0,
        tau: float = 100.0,
        convention: Literal["paper-code", "scaled"] = "paper-code",
        demosaicer: _Demosaicer = "menon",
        closed_form: bool = False,
        clip_x: bool = True,
    ) -> None: ...
