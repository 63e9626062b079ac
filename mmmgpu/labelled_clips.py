"""Clips in which landmarks are known, in all frames or some: what an appearance model is made of.

Landmarks lie beside each clip or in a folder of their own: ``NAME.npz`` of a face tracker (see
`mmmgpu.landmarks`), or ``NAME.json`` with points that a person has set in some frames
(docs/formats.md). Nothing is mended here: what cannot be right is an error.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmmgpu.corpora import check_names
from mmmgpu.errors import InputError
from mmmgpu.landmarks import read_points
from mmmgpu.marking import LANDMARK_ROWS
from mmmgpu.videos import VideoInfo, probe

Floats = NDArray[np.float64]
Rows = tuple[int, ...]

FORMAT, VERSION = "mmmgpu-landmarks", 1
ROWS: Rows = LANDMARK_ROWS  # lips, jaw, nose and cheeks: the 38 of a tracker's 103
STEADY: Rows = (42, 44, 56, 58, 68, 69, 70, 71, 72, 87, 88)  # of a tracker's: they do not speak
UNSTEADY = 0.01  # weight of all others where the pose of the head is found
FEWEST = 3  # points
LEAST_SPREAD = 0.05  # of the points across their main direction: less is a line


def steadiness(rows: Rows | None, number: int) -> Floats:
    """Weights of a frame's `number` points where the pose of the head is found, (N,).

    Of a tracker's landmarks the upper jaw, the nose and the cheeks, which an open mouth does not
    move; points of which nothing is known weigh the same.
    """
    steady = np.array([row in STEADY for row in rows or ()])
    if steady.sum() < FEWEST:
        return np.ones(number)
    return np.where(steady, 1.0, UNSTEADY)


@dataclass(frozen=True)
class LabelledClip:
    """frames: numbers of the labelled frames, rising, (T,). points: (T, N, 2), (x, y) [px]."""

    path: Path
    info: VideoInfo
    frames: NDArray[np.int64]
    points: Floats

    @property
    def is_complete(self) -> bool:
        """Whether every frame is labelled."""
        return len(self.frames) == self.info.frames


def read_labelled_clips(
    clips: Sequence[Path], folder: Path, rows: Rows | None
) -> list[LabelledClip]:
    """Every clip with its landmarks, from ``NAME.npz`` or ``NAME.json`` in `folder`.

    Args:
        clips: Video files with different names.
        folder: Where their landmarks lie.
        rows: Which landmarks of a frame are used; None: all of them.

    Raises:
        InputError: Of the first clip that cannot be used.
    """
    check_names(clips)
    labelled = [read_labelled_clip(clip, folder, rows) for clip in clips]
    number = labelled[0].points.shape[1]
    for other in labelled[1:]:
        if other.points.shape[1] != number:
            raise InputError(
                f"{other.path}: has {other.points.shape[1]} landmarks a frame, "
                f"{labelled[0].path} has {number}; give every frame the same ones"
            )
    return labelled


def read_labelled_clip(clip: Path, folder: Path, rows: Rows | None) -> LabelledClip:
    """One clip with its landmarks; see `read_labelled_clips`."""
    info = probe(clip)
    least = FEWEST if rows is None else max(rows) + 1
    by_hand = folder / f"{clip.stem}.json"
    if by_hand.is_file() and not by_hand.with_suffix(".npz").is_file():
        frames, points = _read_json(by_hand, info.frames)
        source, given = by_hand, None
    else:
        points, given = read_points(folder, clip, info.frames, least=least)
        frames, source = np.arange(len(points)), folder / f"{clip.stem}.npz"
    given = given or tuple(range(points.shape[1]))
    if points.shape[1] < FEWEST or not set(rows or ()) <= set(given):
        raise InputError(
            f"{source}: has {points.shape[1]} landmarks a frame, {least} are needed; "
            "to use all that there are give --all-points"
        )
    chosen = points if rows is None else points[:, [given.index(row) for row in rows]]
    _check(source, frames, chosen, info)
    return LabelledClip(clip, info, frames, chosen)


def _check(source: Path, frames: NDArray[np.int64], points: Floats, info: VideoInfo) -> None:
    """The points of each frame lie in the picture, and not on one line."""
    last = (info.width - 1, info.height - 1)
    outside = ((points < 0) | (points > last)).any(axis=2)
    if outside.any():
        t, i = np.argwhere(outside)[0]
        x, y = points[t, i]
        raise InputError(
            f"{source}: frame {frames[t]}: landmark at ({x:.1f}, {y:.1f}) is outside the picture "
            f"of {info.width} x {info.height} pixels; correct it or leave the clip out"
        )
    centred = points - points.mean(axis=1, keepdims=True)
    spread = np.linalg.svd(centred, compute_uv=False)
    flat = spread[:, 1] <= LEAST_SPREAD * spread[:, 0]
    if flat.any():
        raise InputError(
            f"{source}: frame {frames[np.argmax(flat)]}: the landmarks lie on one line; "
            "correct them or leave the clip out"
        )


def _read_json(path: Path, length: int) -> tuple[NDArray[np.int64], Floats]:
    """Labelled frames of a clip of `length` frames, and their points."""
    try:
        value = json.loads(path.read_text("utf-8-sig"))
    except (OSError, ValueError, RecursionError) as e:
        raise InputError(f"{path}: is not JSON ({' '.join(str(e).split())}); correct it") from e
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise InputError(f"{path}: is no file of landmarks ({FORMAT}); see docs/formats.md")
    if value.get("version") != VERSION:
        raise InputError(
            f"{path}: has version {value.get('version')}, this mmmgpu reads {VERSION}; "
            "update mmmgpu or correct it"
        )
    try:
        found = {_frame(entry, length): _points(entry) for entry in value["frames"]}
        frames = sorted(found)
        points = np.array([found[t] for t in frames])
        if points.ndim != 3 or len(points) != len(value["frames"]):
            raise ValueError("frames with differing numbers of points, none, or one frame twice")
    except (LookupError, TypeError, ValueError) as e:
        raise InputError(f"{path}: must list frames with their points, has {e}; correct it") from e
    return np.array(frames, np.int64), points


def _frame(entry: Any, length: int) -> int:
    frame = entry["frame"]
    if type(frame) is not int or not 0 <= frame < length:
        raise ValueError(f"frame {frame!r} where the clip has {length}")
    return frame


def _points(entry: Any) -> Floats:
    points = np.asarray(entry["points"], np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
        raise ValueError(f"points of frame {entry['frame']} that are not finite pairs (x, y)")
    return points
