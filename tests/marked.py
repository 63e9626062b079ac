"""Frames of two drawn performers, to mark points in, and points that are marked in them."""

from functools import cache

import numpy as np
from worlds import POSTURES, hold

from mmmgpu.performer import landmarks, performer, render
from mmmgpu.points import PointPair, mark_of
from mmmgpu.reference_pairs import ShownFrame

SEEDS, SIZES = (5, 11), ((160, 144), (176, 192))  # (height, width) of A's and B's pictures
KIND_POSTURES = {"closed": POSTURES[0], "open": POSTURES[2]}


@cache
def true_landmarks(kind):
    """The landmarks (103, 2) [px] of A's and B's frame."""
    motion = hold(KIND_POSTURES[kind])
    return tuple(
        landmarks(performer(seed, size=size), motion, 0)
        for seed, size in zip(SEEDS, SIZES, strict=True)
    )


@cache
def shown_frames():
    """A's and B's `ShownFrame`, by kind; each frame of another size, clip and number."""
    frames = {}
    for number, (kind, posture) in enumerate(KIND_POSTURES.items()):
        shown = []
        for seed, size, points in zip(SEEDS, SIZES, true_landmarks(kind), strict=True):
            (picture,) = render(performer(seed, size=size), hold(posture))
            corners = points[[0, 10]]
            mouth = (*corners.mean(axis=0).tolist(), float(np.hypot(*(corners[1] - corners[0]))))
            shown.append(ShownFrame(f"person {seed}.mkv", 7 + number, picture, mouth))
        frames[kind] = tuple(shown)
    return frames


def pair_of(kind, points_a, points_b, names=None):
    """A pair of `shown_frames` with these points."""
    marks = [mark_of(s.clip, s.frame, s.picture) for s in shown_frames()[kind]]
    names = names or tuple(f"p_{i}" for i in range(len(points_a)))
    at = [np.asarray(points, np.float64).reshape(-1, 2) for points in (points_a, points_b)]
    return PointPair(kind, *marks, tuple(names), *at)
