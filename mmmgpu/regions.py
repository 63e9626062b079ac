"""Where the mouth is, found from the video and its sound; the region around it and its masks.

Nothing here looks at landmarks. Near the mouth the picture changes more while there is sound than
while there is none; blinks and head motion do not care about the sound.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mmmgpu.errors import InputError

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]

SEARCH_WIDTH = 256  # [px] longer side of the picture in which the mouth is looked for
_UNIT = 40.0  # [px] width of a mouth in the picture in which eyes are looked for
SPREAD_TO_WIDTH = 1.15  # the moving area holds 80 % of its motion in this many mouth widths

# The region in mouth widths from the centre of the mouth; the masks end in soft edges inside it.
HALF_WIDTH, ABOVE, BELOW, FEATHER = 1.08, 0.72, 1.15, 0.24


@dataclass(frozen=True)
class Region:
    """The part of the reference frame that is modelled.

    box: (x, y, width, height) [px] in the reference frame.
    mouth: (x, y, width) of the mouth [px] in the reference frame.
    """

    box: tuple[int, int, int, int]
    mouth: tuple[float, float, float]

    @property
    def shape(self) -> tuple[int, int]:
        """(h, w) of the region [px]."""
        return self.box[3], self.box[2]

    @property
    def to_frame(self) -> Floats:
        """Homography from region pixels to reference pixels, shape (3, 3)."""
        return np.array([[1.0, 0, self.box[0]], [0, 1.0, self.box[1]], [0, 0, 1.0]])


def region_around(mouth: Sequence[float], frame_size: tuple[int, int]) -> Region:
    """The region around `mouth` (x, y, width) [px], cut at the edges of a (width, height) frame."""
    x, y, width = (float(v) for v in mouth)
    edge = FEATHER + 0.06
    left = max(0, round(x - (HALF_WIDTH + edge) * width))
    top = max(0, round(y - (ABOVE + edge) * width))
    right = min(frame_size[0], round(x + (HALF_WIDTH + edge) * width))
    bottom = min(frame_size[1], round(y + (BELOW + edge) * width))
    return Region((left, top, right - left, bottom - top), (x, y, width))


def carried_mouth(mouth: Sequence[float], carry: Callable[[Floats], Floats]) -> list[float]:
    """(x, y, width) [px] of `mouth` after a map of points, (n, 2) -> (n, 2)."""
    x, y, width = mouth
    middle, left, right = carry(np.array([[x, y], [x - width / 2, y], [x + width / 2, y]]))
    return [float(middle[0]), float(middle[1]), float(np.hypot(*(right - left)))]


def region_from_box(box: tuple[int, int, int, int], frame_size: tuple[int, int]) -> Region:
    """The region a person gave as (x, y, width, height) [px].

    Raises:
        InputError: The box leaves the frame or is smaller than 16 x 16 pixels.
    """
    x, y, w, h = box
    if w < 16 or h < 16 or x < 0 or y < 0 or x + w > frame_size[0] or y + h > frame_size[1]:
        raise InputError(
            f"--region {x},{y},{w},{h}: must be at least 16 x 16 pixels and lie inside the "
            f"{frame_size[0]} x {frame_size[1]} picture"
        )
    edge = FEATHER + 0.06
    width = min(w / 2 / (HALF_WIDTH + edge), h / (ABOVE + BELOW + 2 * edge))
    share = (ABOVE + edge) / (ABOVE + BELOW + 2 * edge)
    return Region(box, (x + w / 2, y + share * h, width))


def cover_mask(region: Region) -> F32:
    """Shape (h, w): 1 on mouth, chin and all that moves with them, soft towards the edge.

    This much of the model is seen in a composite; the background's own mouth must not peep out.
    """
    return _soft(region, HALF_WIDTH, ABOVE, BELOW, FEATHER)


def lip_mask(region: Region) -> F32:
    """w_f, shape (h, w): 1 on the lips, soft over the skin that they pull."""
    return _soft(region, 0.65, 0.38, 0.60, 0.30)


def mouth_mask(region: Region) -> F32:
    """w_t, shape (h, w): 1 on lips, teeth and tongue, soft over the skin around them."""
    return _soft(region, 0.72, 0.42, 0.62, 0.30)


def _soft(region: Region, across: float, above: float, below: float, feather: float) -> F32:
    """A superellipse of the given half axes [mouth widths] with a smooth edge `feather` wide."""
    x, y, width = region.mouth
    h, w = region.shape
    u = np.abs(np.arange(w) + region.box[0] - x) / width
    v = (np.arange(h) + region.box[1] - y) / width
    v = np.where(v < 0, -v / above, v / below)
    radius = ((u[None, :] / across) ** 2.5 + v[:, None] ** 2.5) ** (1 / 2.5)
    # the radius grows by 1 over `across` widths; measure the feather along that axis
    ramp = np.clip((1 + feather / across - radius) / (feather / across), 0, 1)
    mask: F32 = (ramp * ramp * (3 - 2 * ramp)).astype(np.float32)
    border = np.ones((h, w), np.float32)  # never let the mask be cut by the edge of the region
    distance = np.minimum(np.arange(w), np.arange(w)[::-1])[None, :]
    down = np.minimum(np.arange(h), np.arange(h)[::-1])[:, None]
    border = np.clip(np.minimum(distance, down) / (0.1 * width), 0, 1).astype(np.float32)
    mask *= border
    return mask


def speech_motion(frames: Sequence[NDArray[np.uint8]], energy: Floats) -> F32:
    """Where the picture changes with the sound, shape (h, w), summing to 1 (0 if nowhere).

    frames: grey pictures of one clip, each (h, w). energy: RMS of the sound in each frame, (T,).
    Changes are cut at their 85th percentile in time, so that a blink counts little.
    """
    pictures = np.stack([cv2.GaussianBlur(f.astype(np.float32), (0, 0), 1.2) for f in frames])
    change = np.abs(pictures[2:] - pictures[:-2])
    change = np.minimum(change, np.quantile(change, 0.85, axis=0))
    loud = np.convolve(np.log(energy + 1e-4), np.ones(5) / 5, mode="same")[1:-1]
    loud = (loud - loud.mean()) / (loud.std() + 1e-9)
    together = np.tensordot(loud, change, axes=1) / len(loud)
    agreement = together / np.sqrt(change.var(axis=0) + 0.02)
    motion = np.maximum(together, 0) * np.maximum(agreement, 0)
    share: F32 = (motion / max(float(motion.sum()), 1e-12)).astype(np.float32)
    return share


def locate_mouth(motion: F32) -> tuple[float, float, float]:
    """(x, y, width) [px of `motion`] of the mouth in a map of `speech_motion`.

    Raises:
        InputError: Nothing moves with the sound.
    """
    if not motion.any():
        raise InputError("no part of the picture moves with the sound; give --region X,Y,W,H")
    h, w = motion.shape
    x, y = np.arange(w), np.arange(h)
    unit = 0.047 * max(h, w)  # half a mouth, if the head fills a common share of the picture
    broad = cv2.GaussianBlur(motion, (0, 0), 0.5 * unit)
    cy, cx = (float(v) for v in np.unravel_index(int(broad.argmax()), motion.shape))
    for _ in range(30):  # mean shift
        near = np.exp(-((x - cx) ** 2) / (8 * unit**2)) * np.exp(
            -((y[:, None] - cy) ** 2) / (8 * unit**2)
        )
        share = motion * near
        cx = float((share.sum(axis=0) * x).sum() / share.sum())
        cy = float((share.sum(axis=1) * y).sum() / share.sum())
    profile = motion[np.abs(y - cy) < 1.2 * unit][:, np.abs(x - cx) < 4 * unit].sum(axis=0)
    cumulated = np.cumsum(profile) / profile.sum()
    left, right = np.interp([0.1, 0.9], cumulated, np.arange(len(profile)))
    return cx, cy, float(right - left) / SPREAD_TO_WIDTH


def width_from_eyes(gray: NDArray[np.uint8], mouth: Sequence[float]) -> float:
    """The width of the mouth [px] that fits the eyes above it, in a grey picture.

    A mouth that opens in its middle seems narrower than it is; eyes do not care. They are two dark,
    edged places at (+-0.62, -1.55) mouth widths from the mouth, above cheeks that are neither. They
    are looked for around the width of `mouth` (x, y, width) [px].
    """
    scale = _UNIT / mouth[2]
    small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    picture = cv2.GaussianBlur(small.astype(np.float32), (0, 0), 0.03 * _UNIT)
    dark = np.maximum(cv2.GaussianBlur(picture, (0, 0), 0.5 * _UNIT) - picture, 0)
    eyelike = np.sqrt(np.abs(cv2.Scharr(picture, -1, 0, 1)) / 32 * dark)
    x, y = mouth[0] * scale, mouth[1] * scale
    widths = _UNIT * np.geomspace(0.65, 1.7, 40)
    scores = []
    for s in widths:
        eyes = [_around(eyelike, x + side * s, y - 1.55 * s, 0.17 * s) for side in (-0.62, 0.62)]
        cheeks = [_around(eyelike, x + side * s, y - 0.85 * s, 0.2 * s) for side in (-0.55, 0.55)]
        likely = -0.15 * (np.log(s / _UNIT) / 0.35) ** 2
        scores.append(np.log1p(min(eyes)) - np.log1p(np.mean(cheeks)) + likely)
    return float(widths[int(np.argmax(scores))]) / scale


def _around(field: NDArray[Any], x: float, y: float, reach: float) -> float:
    """Mean of `field` around (x, y) under a Gaussian; 0 outside the picture."""
    h, w = field.shape
    if not (0 <= x < w and 0 <= y < h):
        return 0.0
    across = np.exp(-((np.arange(w) - x) ** 2) / (2 * reach**2))
    down = np.exp(-((np.arange(h) - y) ** 2) / (2 * reach**2))
    return float(down @ field @ across / (down.sum() * across.sum()))


def refine_centre(motion: F32, width: float) -> tuple[float, float]:
    """(x, y) of the mouth in a map of a stabilised picture, starting from its centre [px]."""
    h, w = motion.shape
    x, y = np.arange(w) - (w - 1) / 2, np.arange(h)[:, None] - (h - 1) / 2
    cx = cy = 0.0
    for reach in (0.4,) * 6:  # collars and necks move with the sound as well
        across, down = 1.1 * reach * width, 0.8 * reach * width
        share = motion * np.exp(-((x - cx) ** 2) / (2 * across**2))
        share = share * np.exp(-((y - cy) ** 2) / (2 * down**2))
        cx = float((share * x).sum() / max(share.sum(), 1e-12))
        cy = float((share * y).sum() / max(share.sum(), 1e-12))
    return cx + (w - 1) / 2, cy + (h - 1) / 2


def shrink(frames: Iterable[NDArray[np.uint8]]) -> tuple[list[NDArray[np.uint8]], float]:
    """Grey copies of RGB `frames` with the longer side `SEARCH_WIDTH`, and their scale."""
    small, scale = [], 1.0
    for frame in frames:
        scale = SEARCH_WIDTH / max(frame.shape[:2])
        gray = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
        less = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        small.append(np.asarray(less, np.uint8))
    return small, scale
