"""Stabilisation of the head: the plane motion of the rigid upper face, frame by frame.

A pose is a homography, shape (3, 3): reference pixel (x, y, 1) is found at ``pose @ (x, y, 1)`` in
the frame. Every frame is first carried back by the pose of the frame before; dense DIS flow inside
the head mask then gives the remaining motion, to which a homography is fitted by iteratively
reweighted least squares. Not here: where the head is (`regions`), what is done with the poses.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

Gray = NDArray[np.uint8]
Floats = NDArray[np.float64]

PATCH_UNIT = 48.0  # the mouth is at most this wide, in pixels, in the patch that is registered
PERSPECTIVE_PRIOR = 4.0  # [px^2]: weak data leave the two perspective terms at zero
ROBUST_SCALE = 0.25  # [px]: a point that misses by more counts less
MINIMUM_CORRELATION = 0.6  # a frame that resembles the reference less is not registered
MOST_GAIN = 3.0  # a clip may have this much less or more contrast than the reference
TEMPORAL_SMOOTHNESS = 0.5  # lambda of the second differences of a pose's corners


@dataclass(frozen=True)
class Head:
    """The rigid upper face of the reference frame.

    patch: grey picture of the head, shape (h, w), `scale` patch pixels to a reference pixel.
    to_frame: homography from patch pixels to reference pixels, shape (3, 3).
    mask: weight of every patch pixel in the fit, in [0, 1], shape (h, w).
    """

    patch: Gray
    mask: NDArray[np.float32]
    to_frame: Floats


def head_from_frame(frame: NDArray[np.uint8], mouth: Floats) -> Head:
    """The head in the reference `frame`, shape (H, W, 3), above its `mouth` (x, y, width) [px]."""
    x, y, width = mouth
    scale = min(1.0, PATCH_UNIT / width)
    left, top = x - 1.7 * width, y - 2.9 * width
    size = (round(3.4 * width * scale), round(2.7 * width * scale))
    to_frame = np.array([[1 / scale, 0, left], [0, 1 / scale, top], [0, 0, 1]])
    patch = _carry_back(to_gray(frame), to_frame, size)
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    across = (u / scale + left - x) / (1.0 * width)
    down = (v / scale + top - (y - 1.3 * width)) / (0.9 * width)
    inside = 1 - np.maximum(across**2, np.abs(down) ** 3)
    return Head(patch, np.clip(4 * inside, 0, 1).astype(np.float32), to_frame)


def to_gray(frame: NDArray[np.uint8]) -> Gray:
    """The luma of an RGB frame, (H, W, 3) -> (H, W) uint8."""
    return np.asarray(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), np.uint8)


def _carry_back(gray: Gray, pose: Floats, size: tuple[int, int]) -> Gray:
    """`gray` seen from the patch: output pixel p shows ``gray[pose p]``; size is (w, h)."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    back = cv2.warpPerspective(gray, pose, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(back, np.uint8)


def register(frames: Iterable[NDArray[np.uint8]], head: Head) -> Iterator[tuple[Floats, float]]:
    """Yield (pose, correlation) for every RGB frame of one clip, in order.

    pose: homography reference pixel -> frame pixel, shape (3, 3).
    correlation: normalised correlation of the head with the reference after registration, [-1, 1].
    """
    flow_of = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    pose = None
    for frame in frames:
        gray = to_gray(frame)
        if pose is None:
            pose = _locate(gray, head)
        pose, correlation = _refine(gray, head, pose, flow_of)
        if correlation < MINIMUM_CORRELATION:  # lost: look for the head anew
            found, again = _refine(gray, head, _locate(gray, head), flow_of)
            if again > correlation:
                pose, correlation = found, again
        yield pose @ np.linalg.inv(head.to_frame), correlation
        if correlation < MINIMUM_CORRELATION:
            pose = None


def _locate(gray: Gray, head: Head) -> Floats:
    """Patch -> frame pose by template matching over the whole frame: translation only."""
    h, w = head.patch.shape
    scale = head.to_frame[0, 0]
    size = (max(w, round(gray.shape[1] / scale)), max(h, round(gray.shape[0] / scale)))
    small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    score = cv2.matchTemplate(small, head.patch, cv2.TM_CCORR_NORMED, mask=head.mask)
    mean = cv2.matchTemplate(small, head.patch, cv2.TM_CCOEFF_NORMED)
    score = np.nan_to_num(score, posinf=0.0, neginf=0.0) + np.nan_to_num(mean)
    v, u = np.unravel_index(int(score.argmax()), score.shape)
    return np.array([[scale, 0, scale * u], [0, scale, scale * v], [0, 0, 1]])


def _refine(gray: Gray, head: Head, pose: Floats, flow_of: Any) -> tuple[Floats, float]:
    size = (head.patch.shape[1], head.patch.shape[0])
    for _ in range(3):
        seen = _carry_back(gray, pose, size)
        flow = flow_of.calc(head.patch, _like_patch(seen, head), None)
        step = _fit_homography(flow, head.mask)
        pose = pose @ step
        pose = pose / pose[2, 2]
        if np.abs(step - np.eye(3))[:2, 2].max() < 1.0:
            break
    return pose, _correlation(head, _carry_back(gray, pose, size))


def _like_patch(seen: Gray, head: Head) -> Gray:
    """`seen` as bright and as rich in contrast as the patch: DIS takes brightness for constant."""
    mean, deviation = _statistics(seen, head.mask)
    wanted_mean, wanted_deviation = _statistics(head.patch, head.mask)
    gain = np.clip(wanted_deviation / max(deviation, 1e-3), 1 / MOST_GAIN, MOST_GAIN)
    levels = np.clip(np.rint(gain * (np.arange(256) - mean) + wanted_mean), 0, 255)
    return np.asarray(levels.astype(np.uint8)[seen])


def _statistics(gray: Gray, mask: NDArray[np.float32]) -> tuple[float, float]:
    """Weighted mean and standard deviation."""
    weight = mask / mask.sum()
    mean = float((weight * gray).sum())
    return mean, float(np.sqrt((weight * (gray - mean) ** 2).sum()))


def _fit_homography(flow: NDArray[np.float32], mask: NDArray[np.float32]) -> Floats:
    """Homography G with ``G p ~ p + flow(p)`` over the mask, every fourth pixel used.

    Two rows a point, linear in g = (g11 .. g32), in coordinates u centred and scaled to about 1:
        u' (g31 u + g32 v + 1) = (1 + g11) u + g12 v + g13, and the same for v'.
    """
    h, w = mask.shape
    v, u = np.nonzero(mask[::2, ::2] > 0.05)
    u, v = 2 * u, 2 * v
    half = max(h, w) / 2
    x, y = (u - w / 2) / half, (v - h / 2) / half
    dx, dy = flow[v, u, 0] / half, flow[v, u, 1] / half
    one, zero = np.ones_like(x), np.zeros_like(x)
    rows_x = np.stack([x, y, one, zero, zero, zero, -x * (x + dx), -y * (x + dx)], axis=1)
    rows_y = np.stack([zero, zero, zero, x, y, one, -x * (y + dy), -y * (y + dy)], axis=1)
    rows, target = np.concatenate([rows_x, rows_y]), np.concatenate([dx, dy])
    prior = np.diag([0, 0, 0, 0, 0, 0, 1, 1]) * PERSPECTIVE_PRIOR / half**2 * len(x)
    base = np.tile(mask[v, u].astype(np.float64), 2)
    weight, g = base, np.zeros(8)
    for _ in range(6):
        weighted = rows * weight[:, None]
        g = np.linalg.solve(weighted.T @ rows + prior + 1e-9 * np.eye(8), weighted.T @ target)
        miss = ((rows @ g - target) * half).reshape(2, -1)
        weight = base / np.tile(1 + (miss**2).sum(0) / ROBUST_SCALE**2, 2)
    normal = np.array([[1 / half, 0, -w / 2 / half], [0, 1 / half, -h / 2 / half], [0, 0, 1]])
    step = np.append(g, 0.0).reshape(3, 3) + np.eye(3)
    full: Floats = np.linalg.inv(normal) @ step @ normal
    full /= full[2, 2]
    return full


def _correlation(head: Head, seen: Gray) -> float:
    weight = head.mask / head.mask.sum()
    a = head.patch - (weight * head.patch).sum()
    b = seen - (weight * seen).sum()
    norm = (weight * a * a).sum() * (weight * b * b).sum()
    return float((weight * a * b).sum() / np.sqrt(norm + 1e-12))


def smooth_poses(poses: Floats, trusted: NDArray[np.bool_], corners: Floats) -> Floats:
    """Smooth the poses of one clip in time; poses that are not `trusted` are interpolated.

    The images c(t) of four `corners`, shape (4, 2) [px], move smoothly:
        min_s sum_t trusted_t |s_t - c_t|^2 + lambda |second differences of s|^2.
    Shapes: poses (T, 3, 3), trusted (T,). At least one pose must be trusted.
    """
    seen = np.array([project(p, corners).ravel() for p in poses])  # (T, 8)
    seen = np.where(trusted[:, None], seen, 0.0)
    smooth = _whittaker(seen, trusted.astype(np.float64))
    return np.array([_homography_between(corners, s.reshape(4, 2)) for s in smooth])


def _whittaker(values: Floats, weight: Floats) -> Floats:
    """The smooth series nearest to `values`, shape (T, d), where `weight`, shape (T,), counts."""
    frames = len(values)
    bands = np.zeros((3, frames))  # upper form of the banded matrix: bands[2] is the diagonal
    bands[2] = weight + 1e-9
    for i, a in enumerate((1.0, -2.0, 1.0)):
        for j, b in enumerate((1.0, -2.0, 1.0)[i:], start=i):
            bands[2 - (j - i), j : max(j, frames - 2 + j)] += TEMPORAL_SMOOTHNESS * a * b
    smooth: Floats = solveh_banded(bands[-min(3, frames) :], weight[:, None] * values)
    return smooth


def project(pose: Floats, points: Floats) -> Floats:
    """Points (..., 2) carried by a homography (3, 3)."""
    carried = points @ pose[:, :2].T + pose[:, 2]
    return carried[..., :2] / carried[..., 2:]


def _homography_between(source: Floats, target: Floats) -> Floats:
    pose = cv2.getPerspectiveTransform(source.astype(np.float32), target.astype(np.float32))
    return np.asarray(pose, np.float64)
