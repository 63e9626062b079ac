"""One clip seen from the reference of the model: head poses, exposure, and its mouth region.

Everything is read one frame at a time; a track is small (a pose a frame) and can be kept.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import tee
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mmmgpu.errors import InputError
from mmmgpu.regions import Region
from mmmgpu.registration import (
    MINIMUM_CORRELATION,
    Head,
    project,
    register,
    smooth_poses,
)
from mmmgpu.videos import read_frames

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]

MINIMUM_SHARE = 0.5  # of the frames of a clip must be registered, or the clip is left out
COLOUR_EVERY = 7  # frames; the exposure of a clip is read off every so many


@dataclass(frozen=True)
class Track:
    """How the frames of one clip are seen from the reference.

    poses: homographies reference pixel -> frame pixel, shape (T, 3, 3), smooth in time.
    registered: frames whose head was found, shape (T,); the poses of the others are interpolated.
    correlation: of the registered head with the reference, shape (T,).
    gain, offset: ``reference ~ gain * frame + offset`` per channel, in [0, 1] colours, shape (3,).
    residual: [px] RMS of what the smoothing removed at the corners of the region.
    """

    poses: Floats
    registered: NDArray[np.bool_]
    correlation: Floats
    gain: Floats
    offset: Floats
    residual: float

    def __len__(self) -> int:
        return len(self.poses)


@dataclass(frozen=True)
class Reference:
    """What a clip is registered to: the head, its colours and the region, in reference pixels."""

    head: Head
    colours: F32  # (n, 3) in [0, 1], of the reference frame at `colour_points`
    colour_points: Floats  # (n, 2) (x, y) [px]
    region: Region


def make_reference(frame: NDArray[np.uint8], head: Head, region: Region) -> Reference:
    """The `Reference` of a reference `frame`, shape (H, W, 3)."""
    v, u = np.nonzero(head.mask[::2, ::2] > 0.9)
    points = project(head.to_frame, np.stack([2.0 * u, 2.0 * v], axis=1))
    inside = ((points >= 0) & (points <= np.array(frame.shape[1::-1]) - 1)).all(axis=1)
    return Reference(head, _colours(frame, points[inside]), points[inside], region)


def _colours(frame: NDArray[np.uint8], points: Floats) -> F32:
    """Slightly smoothed colours in [0, 1] of `frame` at `points` (n, 2), shape (n, 3)."""
    soft = cv2.GaussianBlur(frame, (0, 0), 1.0)
    x, y = points[:, 0].astype(np.float32), points[:, 1].astype(np.float32)
    seen = cv2.remap(soft, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(seen.reshape(-1, 3) / 255, np.float32)


def track_clip(
    path: Path, reference: Reference, *, tick: Callable[[], None] = lambda: None
) -> Track:
    """Register every frame of the clip at `path` to `reference`; `tick` is called after each.

    Raises:
        InputError: The head was found in less than half of the frames, or the video is unreadable.
    """
    poses, correlation, colours = [], [], []
    frames, again = tee(read_frames(path))
    for t, (frame, (pose, score)) in enumerate(
        zip(again, register(frames, reference.head), strict=False)
    ):
        poses.append(pose)
        correlation.append(score)
        if t % COLOUR_EVERY == 0 and score >= MINIMUM_CORRELATION:
            colours.append(_colours(frame, project(pose, reference.colour_points)))
        tick()
    registered = np.array(correlation) >= MINIMUM_CORRELATION
    if registered.mean() < MINIMUM_SHARE or not colours:
        raise InputError(
            f"{path}: the head of the reference was found in {registered.sum()} of "
            f"{len(registered)} frames; leave this clip out, or check --region"
        )
    corners = _anchor(reference.region)
    smooth = smooth_poses(np.array(poses), registered, corners)
    moved = [project(a, corners) - project(b, corners) for a, b in zip(smooth, poses, strict=True)]
    residual = float(np.sqrt(np.mean(np.square(np.array(moved)[registered]))))
    gain, offset = _exposure(np.array(colours), reference.colours)
    return Track(smooth, registered, np.array(correlation), gain, offset, residual)


def _anchor(region: Region) -> Floats:
    """Four points between eyes and chin, (4, 2) [px]: poses are smoothed by where these go."""
    x, y, width = region.mouth
    return np.array(
        [[x + a * width, y + b * width] for a, b in ((-1, -2), (1, -2), (1, 1), (-1, 1))]
    )


def _exposure(seen: F32, wanted: F32) -> tuple[Floats, Floats]:
    """Gain and offset (3,) with ``wanted ~ gain * seen + offset``: robust, per channel.

    Shapes: seen (n_frames, n, 3), wanted (n, 3).
    """
    gain, offset = np.ones(3), np.zeros(3)
    for c in range(3):
        x = seen[..., c].ravel().astype(np.float64)
        y = np.tile(wanted[:, c].astype(np.float64), len(seen))
        design = np.stack([x, np.ones_like(x)], axis=1)
        weight = np.ones_like(x)
        for _ in range(6):
            normal = (design * weight[:, None]).T @ design
            normal += 1e-3 * len(x) * np.diag([1.0, 0.0]) * x.var()
            target = (design * weight[:, None]).T @ y + 1e-3 * len(x) * x.var() * np.array([1.0, 0])
            gain[c], offset[c] = np.linalg.solve(normal + 1e-9 * np.eye(2), target)
            weight = 1 / (1 + ((design @ [gain[c], offset[c]] - y) / 0.02) ** 2)
    return gain, offset


def rebase(track: Track, pose: Floats, gain: Floats, offset: Floats) -> Track:
    """`track` seen from a new reference frame, which the old reference saw with these values.

    After it the pose of the new reference frame is the identity, its gain 1 and its offset 0.
    """
    poses = track.poses @ np.linalg.inv(pose)
    poses = poses / poses[:, 2:, 2:]
    new_gain = track.gain / gain
    return replace(track, poses=poses, gain=new_gain, offset=(track.offset - offset) / gain)


def crop(frame: NDArray[np.uint8], pose: Floats, track: Track, region: Region) -> F32:
    """The region of one RGB frame as the reference sees it: (h, w, 3) float32 in [0, 1]."""
    h, w = region.shape
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    matrix = pose @ region.to_frame
    seen = cv2.warpPerspective(frame, matrix, (w, h), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    image: F32 = seen.astype(np.float32) * (track.gain / 255).astype(np.float32)
    return np.clip(image + track.offset.astype(np.float32), 0, 1)


def crops(
    path: Path, track: Track, region: Region, *, start: int = 0, stop: int | None = None
) -> Iterator[F32]:
    """The regions of the frames `start` <= t < `stop` of a clip, in order; without both, of all."""
    frames = read_frames(path, start=start, stop=stop)
    for frame, pose in zip(frames, track.poses[start:stop], strict=False):
        yield crop(frame, pose, track, region)


def frame_at(path: Path, t: int) -> NDArray[np.uint8]:
    """Frame `t` of the clip at `path`, (H, W, 3) uint8."""
    return next(iter(read_frames(path, start=t, stop=t + 1)))
