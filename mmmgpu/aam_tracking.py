"""Landmarks of clips that have none: an appearance model fitted from a rough start.

The start, a box or landmarks of one frame, may be some pixels off: in that frame fits are tried
from places about it, and the one that explains the picture best is taken. Then every frame starts
from the one beside it, forward to the end and backward to the beginning of the clip.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmmgpu.aam_fitting import Fitter, Match, match, prepare_fitting
from mmmgpu.appearances import Aam
from mmmgpu.backends import Backend, get_backend
from mmmgpu.errors import InputError
from mmmgpu.files import atomic_path
from mmmgpu.labelled_clips import read_labelled_clip
from mmmgpu.parallel import one_thread_each
from mmmgpu.videos import probe, read_frames

Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]
Box = tuple[int, int, int, int]

TRIED = (-2, -1, 0, 1, 2)  # places about a start, each way
STEP = 0.12  # between them, of the size of the face


@dataclass(frozen=True)
class Start:
    """points (N, 2) [px], some pixels off at most, of the frame number `frame`."""

    frame: int
    points: Floats


@dataclass(frozen=True)
class Tracked:
    """A clip of T frames, N points, n features.

    points: (T, N, 2), (x, y) [px]. features: (T, n).
    residual: root mean square of what the texture differs by, colours in [0, 1], (T,).
    settled: whether the points of a frame had come to rest, (T,).
    """

    points: Floats
    features: Floats
    residual: Floats
    settled: NDArray[np.bool_]


def start_in_box(aam: Aam, box: Box) -> Start:
    """The mean shape in the middle of a box (x, y, width, height) [px] of the first frame.

    It is as wide as the box.

    Raises:
        InputError: The box has no area.
    """
    x, y, width, height = box
    if width < 1 or height < 1:
        raise InputError(f"start: the box {box} has no area; give X,Y,W,H")
    mean = aam.mesh.vertices
    low, high = mean.min(axis=0), mean.max(axis=0)
    scale = width / (high[0] - low[0])
    return Start(0, (mean - (low + high) / 2) * scale + (x + width / 2, y + height / 2))


def start_of_clip(aam: Aam, clip: Path, folder: Path) -> Start:
    """The first frame of `clip` that has landmarks in `folder`, with them.

    Raises:
        InputError: There is none, or its landmarks cannot be those of the model.
    """
    labelled = read_labelled_clip(clip, folder, aam.rows)
    return Start(int(labelled.frames[0]), labelled.points[0])


def track_clip(aam: Aam, clip: Path, start: Start, *, backend: str = "warp") -> Tracked:
    """Points and features of every frame of `clip`.

    Raises:
        InputError: The clip cannot be read, or has no such frame or place as the start's.
    """
    info = probe(clip)
    inside = (start.points >= 0) & (start.points <= (info.width - 1, info.height - 1))
    if not inside.all() or start.frame >= info.frames:
        raise InputError(
            f"{clip}: the start lies outside the picture of {info.width} x {info.height} pixels; "
            "correct it"
        )
    fitter, kernels = prepare_fitting(aam), get_backend(backend, 1)
    with one_thread_each():
        frames = read_frames(clip)
        before = [next(frames) for _ in range(start.frame)]
        first_frame = next(frames)
        first = best_match(fitter, first_frame, start.points, kernels)
        back = list(_follow(fitter, reversed(before), first, kernels))
        found = [*reversed(back), first, *_follow(fitter, frames, first, kernels)]
    return Tracked(
        np.array([one.shape for one in found]),
        np.array([one.features for one in found]),
        np.array([one.residual for one in found]),
        np.array([one.settled for one in found]),
    )


def best_match(fitter: Fitter, frame: Picture, rough: Floats, kernels: Backend) -> Match:
    """The fit that explains `frame` best, of those from places about the points `rough` (N, 2)."""
    size = float(np.sqrt(((rough - rough.mean(axis=0)) ** 2).sum(axis=1).mean()))
    steps = [STEP * size * np.array(way) for way in product(TRIED, TRIED)]
    fits = [match(fitter, frame, rough + step, kernels) for step in steps]
    return min(fits, key=lambda fit: fit.residual)


def _follow(
    fitter: Fitter, frames: Iterator[Picture], last: Match, kernels: Backend
) -> Iterator[Match]:
    """Each frame from the one before it."""
    for frame in frames:
        last = match(fitter, frame, last.shape, kernels)
        yield last


def write_tracked(tracked: Tracked, aam: Aam, path: Path) -> None:
    """Write ``NAME.npz``: landmarks as `mmmgpu.labelled_clips` reads them, and features."""
    arrays: dict[str, Any] = {**vars(tracked), "points": tracked.points.astype(np.float32)}
    if aam.rows is not None:
        arrays["rows"] = np.array(aam.rows)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)
