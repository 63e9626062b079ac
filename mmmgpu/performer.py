"""The built-in performer: a talking face drawn by our own code, with its truth known.

    face = performer(seed=5)
    motion = articulate(face, phones, n_frames=75, fps=25.0, rng=np.random.default_rng(0))
    for frame in render(face, motion, rng=np.random.default_rng(1)):
        ...

It is a source of video for the demo and for tests; nothing in the models knows of it. Truth
(`flow`, `masks`, `landmarks`) comes from the same geometry as the pictures, not from the pictures.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from mmmgpu.errors import InputError
from mmmgpu.performer_articulation import (
    ARTICULATORS,
    PHONES,
    Articulation,
    Timed,
    make_articulation,
)
from mmmgpu.performer_traits import Performer, draw_performer

__all__ = [
    "ARTICULATORS",
    "PHONES",
    "Articulation",
    "Performer",
    "articulate",
    "flow",
    "landmarks",
    "masks",
    "performer",
    "render",
]
_SMALLEST = 64


def performer(seed: int, *, size: tuple[int, int] = (256, 256)) -> Performer:
    """Draw one person at random: geometry, skin, hair, light and speaking style.

    Args:
        seed: Which person, an integer >= 0; the same seed is the same person at every size
            (pores and single hairs apart).
        size: (height, width) of the pictures [px], each at least 64.

    Raises:
        InputError: The seed is negative or the size too small.
    """
    if seed < 0:
        raise InputError(f"seed must be >= 0, got {seed}; choose another")
    if len(size) != 2 or min(size) < _SMALLEST:
        raise InputError(f"size must be (height, width), each >= {_SMALLEST}, got {size}")
    return draw_performer(int(seed), (int(size[0]), int(size[1])))


def articulate(
    performer: Performer,
    phones: Sequence[Timed],
    n_frames: int,
    fps: float,
    rng: np.random.Generator,
) -> Articulation:
    """Move the mouth through `phones` in the performer's own style, with head and eyes.

    Args:
        performer: Who speaks: amplitude, timing, smoothness and phone targets are personal.
        phones: ARPAbet segments with `label`, `start`, `end` [s]; gaps and the time outside are
            silence's. The labels are those of `PHONES`.
        n_frames: Length; frame t covers [t, t + 1) / fps.
        fps: Frames a second.
        rng: Head motion, blinks and gaze; the mouth depends on the phones only.

    Raises:
        InputError: An unknown label, a span that is empty or not finite, no frames.
    """
    return make_articulation(performer, phones, n_frames, fps, rng)


def render(
    performer: Performer, articulation: Articulation, *, rng: np.random.Generator | None = None
) -> Iterator[NDArray[np.uint8]]:
    """Yield the pictures uint8 (H, W, 3), RGB, one frame at a time.

    With `rng`, the camera adds sensor noise (about 1.5 grey levels); without, the same articulation
    gives the same pixels.
    """
    from mmmgpu.performer_render import render_frames

    return render_frames(performer, articulation, rng)


def flow(
    performer: Performer, articulation: Articulation, from_frame: int, to_frame: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Exact flow between two frames.

    Returns:
        flow: [px], shape (H, W, 2), (dx, dy): what frame `from_frame` shows at pixel p is at
            p + flow(p) in `to_frame`.
        valid: Shape (H, W): visible in both frames and its motion known. The inside of the mouth is
            never valid, the eyes are not while they blink or look elsewhere.

    Raises:
        InputError: A frame that the articulation does not have.
    """
    from mmmgpu.performer_truth import true_flow

    a, b = (_frame(articulation, t) for t in (from_frame, to_frame))
    return true_flow(performer, articulation, a, b)


def masks(
    performer: Performer, articulation: Articulation, frame: int
) -> dict[str, NDArray[np.bool_]]:
    """Masks (H, W) of one frame: "face", "lips" (vermilion), "inside" (the opening between the
    lips) and "mouth" (lips and inside).

    Raises:
        InputError: A frame that the articulation does not have.
    """
    from mmmgpu.performer_truth import true_masks

    return true_masks(performer, articulation, _frame(articulation, frame))


def landmarks(performer: Performer, articulation: Articulation, frame: int) -> NDArray[np.float64]:
    """The 103 landmarks (x, y) [px] of one frame, shape (103, 2), pixel centres at whole numbers.

    Rows: outer_lip 0-19 and inner_lip 20-39 (from the right corner along the lower lip and back
    along the upper), jaw 40-60, nose 61-74, right_eye 75-80, left_eye 81-86, cheek 87-102; right
    and left are the person's.

    Raises:
        InputError: A frame that the articulation does not have.
    """
    from mmmgpu.performer_truth import true_landmarks

    return true_landmarks(performer, articulation, _frame(articulation, frame))


def _frame(articulation: Articulation, t: int) -> int:
    if not 0 <= t < len(articulation):
        raise InputError(f"frame {t} does not exist; the articulation has {len(articulation)}")
    return t
