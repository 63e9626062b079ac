"""Corresponding points from the landmarks of a face tracker, where both persons have such files."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mmmgpu.errors import InputError
from mmmgpu.landmarks import read_landmarks
from mmmgpu.marking import LANDMARK_ROWS, NAMES
from mmmgpu.points import PointPair, mark_of
from mmmgpu.reference_pairs import ShownFrame

Floats = NDArray[np.float64]

APART = 1.0  # [px] of two points in one frame, or the second is left out: closed lips meet


def points_from_landmarks(
    a: Mapping[str, ShownFrame], b: Mapping[str, ShownFrame], folder_a: Path, folder_b: Path
) -> tuple[PointPair, ...]:
    """The 38 points in the frames `a` and `b` of two persons, by kind of pair.

    Points that lie outside a frame, or nearly on another one, are left out.

    Args:
        a, b: The frames, as `reference_pairs` gives them.
        folder_a, folder_b: Where ``NAME.npz`` lies for their clips; see `mmmgpu.landmarks`.

    Raises:
        InputError: A file of landmarks is missing, too short, or has too few points.
    """
    pairs = []
    for kind in a:
        at_a, at_b = _rows(a[kind], folder_a), _rows(b[kind], folder_b)
        kept: list[int] = []
        for i in range(len(NAMES)):
            sides = ((at_a, a[kind]), (at_b, b[kind]))
            if all(_is_inside(p[i], shown) and _is_apart(p, i, kept) for p, shown in sides):
                kept.append(i)
        in_a, in_b = (mark_of(s.clip, s.frame, s.picture) for s in (a[kind], b[kind]))
        names = tuple(NAMES[i] for i in kept)
        pairs.append(PointPair(kind, in_a, in_b, names, at_a[kept], at_b[kept]))
    return tuple(pairs)


def _rows(shown: ShownFrame, folder: Path) -> Floats:
    """The 38 points in one frame, (38, 2) [px]."""
    points = read_landmarks(folder, Path(shown.clip))
    if len(points) <= shown.frame or points.shape[1] <= max(LANDMARK_ROWS):
        raise InputError(
            f"{folder}: the landmarks of {shown.clip} must reach frame {shown.frame} and row "
            f"{max(LANDMARK_ROWS)}, are {points.shape}; mark the points by hand"
        )
    return points[shown.frame, list(LANDMARK_ROWS)]


def _is_inside(point: Floats, shown: ShownFrame) -> bool:
    return bool((point >= 0).all() and (point <= np.array(shown.picture.shape[1::-1]) - 1).all())


def _is_apart(points: Floats, i: int, kept: list[int]) -> bool:
    return bool((np.linalg.norm(points[kept] - points[i], axis=1) > APART).all())
