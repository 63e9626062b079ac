"""A synthetic mouth back on a video frame: under its head pose, in its colours, without a seam."""

import cv2
import numpy as np
from numpy.typing import NDArray

from mmmgpu.regions import Region
from mmmgpu.registration import project
from mmmgpu.tracks import Track

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]

MOST_GRAIN = 2.5 / 255  # standard deviation of added grain, at most
RING = (0.02, 0.6)  # cover in which model and background are compared
REACH = 3  # [px] beyond the cover, from which cubic interpolation still takes colours


def looked_at(cover: F32) -> NDArray[np.bool_]:
    """The pixels of a region image that a composite with `cover` (h, w) depends on, (h, w)."""
    around = np.ones((2 * REACH + 1, 2 * REACH + 1), np.uint8)
    return cv2.dilate((cover > 0).astype(np.uint8), around).astype(bool)


def composite(
    frame: Picture, image: F32, cover: F32, pose: Floats, track: Track, region: Region
) -> Picture:
    """`frame`, (H, W, 3) uint8, with the region `image` (h, w, 3) over it as `cover` (h, w) says.

    The image is in the colours of the reference and is returned to those of the clip. Pixels that
    the cover does not reach keep their bits.
    """
    own = _as_filmed(image, track)
    box, placed, opacity = _place(own, cover, pose, region, frame.shape)
    return _over(frame, box, placed, opacity)


def composite_matched(
    frame: Picture,
    image: F32,
    cover: F32,
    pose: Floats,
    track: Track,
    region: Region,
    rng: np.random.Generator,
) -> Picture:
    """As `composite`, with the colours of the frame at the rim of the cover, and its grain.

    What differs at the rim is fitted by a plane a + b x + c y per channel and added everywhere.
    """
    own = _as_filmed(image, track)
    box, placed, opacity = _place(own, cover, pose, region, frame.shape)
    under = np.asarray(frame[box] / np.float32(255), np.float32)
    rim = (opacity > RING[0]) & (opacity < RING[1])
    if rim.sum() >= 16:
        placed += _plane(under - placed, rim)
        placed += _grain(under, placed, rim, rng)
    return _over(frame, box, placed, opacity)


def _as_filmed(image: F32, track: Track) -> F32:
    """`image` (h, w, 3) in the colours of the reference, in those of the clip."""
    gain = (1 / track.gain).astype(np.float32)
    return np.asarray(image * gain - (track.offset / track.gain).astype(np.float32))


def _place(
    image: F32, cover: F32, pose: Floats, region: Region, shape: tuple[int, ...]
) -> tuple[tuple[slice, slice], F32, F32]:
    """(rectangle of the frame, image there, opacity there)."""
    h, w = cover.shape
    matrix = pose @ region.to_frame
    corners = project(matrix, np.array([[0.0, 0], [w - 1, 0], [w - 1, h - 1], [0, h - 1]]))
    size = np.array(shape[1::-1])
    left, top = np.clip(np.floor(corners.min(axis=0)).astype(int), 0, size - 1)
    right, bottom = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 1, (left + 1, top + 1), size)
    box = (slice(top, bottom), slice(left, right))
    extent = (int(right - left), int(bottom - top))
    shifted = np.array([[1.0, 0, -left], [0, 1.0, -top], [0, 0, 1.0]]) @ matrix
    placed = cv2.warpPerspective(
        image, shifted, extent, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    opacity = cv2.warpPerspective(cover, shifted, extent, flags=cv2.INTER_LINEAR)
    return box, np.asarray(placed, np.float32), np.asarray(opacity, np.float32)


def _over(frame: Picture, box: tuple[slice, slice], placed: F32, opacity: F32) -> Picture:
    result = frame.copy()
    share = opacity[..., None]
    mixed = share * (placed * 255 - frame[box]) + frame[box]  # the frame itself, where share is 0
    result[box] = np.clip(np.rint(mixed), 0, 255)
    return result


def _plane(difference: F32, rim: NDArray[np.bool_]) -> F32:
    """The plane through `difference` (h, w, 3) on the rim, over the whole rectangle."""
    h, w = rim.shape
    y, x = np.nonzero(rim)
    design = np.stack([np.ones(len(x)), x / w - 0.5, y / h - 0.5], axis=1)
    value = difference[rim].astype(np.float64)
    weight = np.ones(len(x))
    for _ in range(4):
        normal = (design * weight[:, None]).T @ design + 1e-3 * len(x) * np.diag([0, 1, 1])
        plane = np.linalg.solve(normal, (design * weight[:, None]).T @ value)
        miss = ((design @ plane - value) ** 2).sum(axis=1)
        weight = 1 / (1 + miss / 0.03**2)
    across, down = np.arange(w) / w - 0.5, np.arange(h)[:, None] / h - 0.5
    terms = (plane[0], across[..., None] * plane[1], down[..., None] * plane[2])
    return np.asarray(terms[0] + terms[1] + terms[2], np.float32)


def _grain(under: F32, placed: F32, rim: NDArray[np.bool_], rng: np.random.Generator) -> F32:
    """Noise (h, w, 1) that gives `placed` the fine texture that the frame has at the rim."""
    grey = [cv2.transform(image, np.full((1, 3), 1 / 3)) for image in (under, placed)]
    fine = [g - cv2.GaussianBlur(g, (0, 0), 1.0) for g in grey]
    deviation = [1.4826 * float(np.median(np.abs(f[rim]))) for f in fine]  # edges do not count
    strength = min(np.sqrt(max(deviation[0] ** 2 - deviation[1] ** 2, 0.0)), MOST_GRAIN)
    noise = cv2.GaussianBlur(rng.standard_normal(rim.shape).astype(np.float32), (0, 0), 0.5)
    return np.asarray(strength * noise / max(float(noise.std()), 1e-6), np.float32)[..., None]
