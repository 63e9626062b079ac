"""Landmarks of a face tracker, to measure with and to make appearance models from.

The training of a morphable model never reads them.

``NAME.npz`` beside a clip holds ``points``, float32 (frames, 103, 2), (x, y) [px]: outer lip 0-19
from the right corner along the lower lip, inner lip 20-39, then jaw, nose, eyes and cheeks.
"""

import zipfile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mmmgpu.basis import Basis
from mmmgpu.errors import InputError
from mmmgpu.registration import project

Floats = NDArray[np.float64]

_UNREADABLE = (
    OSError,
    EOFError,
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    zipfile.BadZipFile,
)
OUTER_LIP, LIPS = slice(0, 20), slice(0, 40)
LOWER, UPPER = 5, 15  # middle of the outer lower and upper lip
HULL_SCALE = 1.5  # of the outer lip's hull, about its centre: where pictures are compared


def read_landmarks(
    folder: Path, clip: Path, frames: int | None = None, *, least: int = LIPS.stop
) -> Floats:
    """The landmarks of `clip`, (frames, n, 2) [px]; of any number of frames if None.

    least: how many landmarks a frame must have, n; by default those of the lips.

    Raises:
        InputError: There are none, or not for so many frames, or some are not finite; or the file
            holds a choice of a tracker's, as `mmmgpu track` writes them.
    """
    points, rows = read_points(folder, clip, frames, least=least)
    if rows is not None:
        raise InputError(
            f"{folder / clip.stem}.npz: holds {len(rows)} landmarks chosen for an appearance "
            "model; give a face tracker's"
        )
    return points


def read_points(
    folder: Path, clip: Path, frames: int | None, *, least: int
) -> tuple[Floats, tuple[int, ...] | None]:
    """As `read_landmarks`, and which of a tracker's landmarks the points are; None: all of them."""
    path = folder / f"{clip.stem}.npz"
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            points = np.asarray(arrays["points"])
            rows = tuple(np.asarray(arrays["rows"], np.int64)) if "rows" in arrays else None
    except _UNREADABLE as e:
        raise InputError(f"{path}: no landmarks of {clip} ({e}); give --landmarks DIR") from e
    least = least if rows is None else len(rows)
    wanted = (len(points) if frames is None and points.ndim else frames, 2)
    if points.ndim != 3 or (len(points), points.shape[2]) != wanted or points.shape[1] < least:
        raise InputError(
            f"{path}: must hold points of shape ({frames or 'frames'}, {least} or more, 2), "
            f"has {points.shape}"
        )
    if points.dtype.kind not in "fiu" or not np.isfinite(points).all():
        raise InputError(f"{path}: must hold finite numbers; leave the clip out")
    if rows is not None and points.shape[1] != len(set(rows)):
        raise InputError(f"{path}: must have one of the 'rows' for each point; track it again")
    return points.astype(np.float64), rows


def moved_landmarks(basis: Basis, alpha: Floats, points: Floats) -> Floats:
    """`points` (n, 2) of the reference frame moved by C_syn(alpha): (T, n, 2) [reference px]."""
    at = points - np.array(basis.region.box[:2])
    where = at.astype(np.float32)[None]
    moved = []
    for a in alpha:
        step = cv2.remap(basis.flow(a), where[..., 0], where[..., 1], cv2.INTER_LINEAR)
        moved.append(points + step[0])
    return np.array(moved)


def carried(poses: Floats, points: Floats) -> Floats:
    """Points (T, n, 2) carried by the poses (T, 3, 3) of their frames."""
    return np.array([project(pose, p) for pose, p in zip(poses, points, strict=True)])


def lip_opening(points: Floats) -> Floats:
    """Height between the middles of the outer lips [px], (T, n, 2) -> (T,)."""
    return np.asarray(points[:, LOWER, 1] - points[:, UPPER, 1])


def mouth_hull(points: Floats, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Pixels of a picture inside the hull of the outer lip (n, 2), scaled about its centre."""
    hull = cv2.convexHull(points[OUTER_LIP].astype(np.float32))[:, 0]
    moments = cv2.moments(hull)
    centre = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
    corners = np.rint((centre + HULL_SCALE * (hull - centre)) * 16).astype(np.int32)
    inside = np.zeros(shape[:2], np.uint8)
    cv2.fillConvexPoly(inside, corners, 1, shift=4)
    return inside > 0
