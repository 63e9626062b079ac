"""Compute backends: one module each, imported on first use.

A backend is named ``name`` or ``name:device``: ``"numpy"``, ``"warp"`` (all CPU cores),
``"warp:cuda:0"``, ``"opencl"``, ``"opencl:0:0"`` (platform and device number). To add one, write a
module with ``open_backend(device, threads)`` and ``list_devices()``, and add its line to
`BACKENDS`.
"""

import functools
import gc
import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from mmmgpu.arrays import F32
from mmmgpu.errors import InputError

BACKENDS = {
    "numpy": "mmmgpu.backends.reference",
    "warp": "mmmgpu.backends.nvwarp",
    "opencl": "mmmgpu.backends.opencl",
}


class Backend(Protocol):
    """The operations on device arrays: float32, C order, finite, never changed in place.

    Every operation takes and returns device arrays, so that a chain of them stays on the device;
    `to_device` and `to_host` copy nothing where the device is the CPU and that can be avoided. Two
    device arrays of one batch may have different lengths on their first axis if one of them is 1.
    The shapes are those of `mmmgpu.operations` with exactly one batch axis.
    """

    @property
    def on_host(self) -> bool:
        """Whether the device is the processor that this runs on."""

    def wait(self) -> None:
        """Return when all that was asked for is done: a device may still be at it."""

    def to_device(self, array: NDArray[Any], /) -> Any:
        """A device array of the same shape. It may share memory with `array`."""

    def to_host(self, array: Any, /) -> F32:
        """A NumPy array of the same shape. It may share memory with `array`: read only."""

    def forward_warp(self, field: Any, flow: Any, /) -> tuple[Any, Any]:
        """(B, H, W, C), (B, H, W, 2) -> (B, H, W, C), (B, H, W)."""

    def fill_holes(self, field: Any, weight: Any, threshold: float, /) -> Any:
        """(B, H, W, C), (B, H, W) -> (B, H, W, C); `field` itself where nothing is to be filled."""

    def blend(self, images: Any, weights: Any, /) -> Any:
        """(M, H, W, C), (B, M) -> (B, H, W, C)."""

    def normal_equations(self, images: Any, wanted: Any, /) -> Any:
        """(M, ...), (...) of as many values -> (M + 1, M): Gram matrix, then right-hand side."""

    def sample(self, field: Any, points: Any, /) -> Any:
        """(B, H, W, C), (B, N, 2) -> (B, N, C)."""

    def distance_scan(self, queries: Any, corpus: Any, weights: Any, /) -> Any:
        """(K, P, C), (N, P, C), (P,) -> (K, N)."""

    def evaluate_rbf(
        self, points: Any, centres: Any, weights: Any, affine: Any, sharpness: float, /
    ) -> Any:
        """(P, 2), (N, 2), (N, 2), (2, 3) -> (P, 2)."""

    def hold_prototypes(self, images: F32, flows: F32, hole: float, /) -> Any:
        """NumPy (M, H, W, 3) in [0, 1], (M, H, W, 2): all that stays the same, on the device.

        A pixel that receives less weight than `hole`, which is below 1, in one of the two warps of
        CE05, Eq. 2, is filled.
        """

    def move_prototypes(self, held: Any, flow: Any, used: NDArray[np.int64], scale: Any, /) -> Any:
        """Some of what `hold_prototypes` gave, each moved along C_syn as in CE05, Eq. 2, scaled.

        (1, 2, H, P), NumPy (n,), (H, P) -> (n, 3, H, P): planes, see `mmmgpu.backends.planes`.
        Where the scale is 0, as in what pads a row, nothing is filled.
        """

    def prototype_equations(
        self, held: Any, flow: F32, used: NDArray[np.int64], wanted: Any, scale: Any, /
    ) -> Any:
        """`normal_equations` of what `move_prototypes` gives, of which no picture is kept.

        NumPy (2, H, P), NumPy (n,), (3, H, P), (H, P) -> (n + 1, n).
        """

    def mix_prototypes(self, held: Any, flows: Any, weights: F32, scale: Any, /) -> Any:
        """CE05, Eq. 2, scaled: (B, 2, H, P), NumPy (B, M), (H, P) -> (B, 3, H, P).

        A prototype without weight costs nothing; where some of up to four mixtures that go together
        have none, it is re-oriented for these too. Else as `move_prototypes`.
        """

    def piecewise_warp(
        self, field: Any, vertices: Any, triangles: Any, index: Any, barycentric: Any, /
    ) -> Any:
        """(B, H, W, C), (B, N, 2), (K, 3), (P,), (P, 3) -> (B, P, C); whole numbers are int32."""


def list_devices(family: str) -> dict[str, str]:
    """Names for `get_backend` with what they stand for, of one of `BACKENDS`.

    Raises:
        InputError: Its library is not installed.
    """
    found: dict[str, str] = _module(family).list_devices()
    return found


@functools.cache
def get_backend(name: str, threads: int | None = None) -> Backend:
    """The backend called `name`, imported and opened on first use.

    Args:
        name: ``name`` or ``name:device``.
        threads: CPU threads; None is `default_threads()`. The results are the same bits for any
            number. OpenCL decides on its threads when its driver is loaded: there only the
            environment variable counts.

    Raises:
        InputError: No such backend or device, or its library is not installed.
    """
    family, _, device = name.partition(":")
    if family not in BACKENDS:
        raise InputError(f"unknown backend {name!r}; choose one of {sorted(BACKENDS)}")
    if threads is not None and threads < 1:
        raise InputError(f"threads must be at least 1, got {threads}")
    opened = _module(family).open_backend(device, threads or default_threads())
    return cast(Backend, opened)


def _module(family: str) -> Any:
    try:
        with _nothing_collected():
            return importlib.import_module(BACKENDS[family])
    except ModuleNotFoundError as e:
        raise InputError(
            f"backend {family!r} needs {e.name!r}, which is not installed; pip install 'mmmgpu'"
        ) from e


@contextmanager
def _nothing_collected() -> Iterator[None]:
    """No search for garbage: what an import makes stays, and looking through it takes a tenth.

    It counts as old afterwards, where the next searches do not look.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if not gc.get_freeze_count():  # else what others froze would be freed
            gc.freeze()
            gc.unfreeze()
        if was_on:
            gc.enable()


def default_threads() -> int:
    """`MMMGPU_THREADS` if it is set, else the number of cores this process may use."""
    given = os.environ.get("MMMGPU_THREADS", "")
    if given:
        if not given.isdecimal() or int(given) < 1:
            raise InputError(f"MMMGPU_THREADS must be a whole number above 0, got {given!r}")
        return int(given)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
