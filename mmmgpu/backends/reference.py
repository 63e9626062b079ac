"""NumPy backend: the oracle. Written to be checked against the paper, not to be fast.

It accumulates in float64; what decides where a value goes (the split of a flow into integer and
fraction, the weights of the taps) is float32, as on every other backend.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from mmmgpu.arrays import F32, I32, check_some_valid
from mmmgpu.backends.planes import picture, planes
from mmmgpu.errors import InputError

FAR = 1e8  # [px] beyond any picture, inside int32


def open_backend(device: str, threads: int | None) -> "Reference":
    """The reference takes no device, and its answer does not depend on threads."""
    if device:
        raise InputError(f"backend 'numpy' has no device {device!r}; ask for 'numpy'")
    return Reference()


def list_devices() -> dict[str, str]:
    """Names for `get_backend` and what they stand for."""
    return {"numpy": f"NumPy {np.__version__}"}


@dataclass(frozen=True)
class Prototypes:
    """Pictures (M, H, W, 3), flows (M, H, W, 2), and the least weight of a pixel that is none."""

    images: F32
    flows: F32
    hole: float


@dataclass(frozen=True)
class Reference:
    """The operations in plain NumPy; device arrays are NumPy arrays."""

    on_host: ClassVar[bool] = True

    def wait(self) -> None:
        """Nothing is ever left to do."""

    def to_device(self, array: NDArray[Any]) -> NDArray[Any]:
        return array

    def to_host(self, array: F32) -> F32:
        return array

    def forward_warp(self, field: F32, flow: F32) -> tuple[F32, F32]:
        batch = max(len(field), len(flow))
        pairs = [_splat(field[b % len(field)], flow[b % len(flow)]) for b in range(batch)]
        return np.stack([f for f, _ in pairs]), np.stack([w for _, w in pairs])

    def fill_holes(self, field: F32, weight: F32, threshold: float) -> F32:
        valid = weight >= np.float32(threshold)
        check_some_valid(valid.sum(axis=(1, 2)))
        return np.stack([_pull_push(f, v) for f, v in zip(field, valid, strict=True)])

    def blend(self, images: F32, weights: F32) -> F32:
        return np.tensordot(weights.astype(np.float64), images, axes=1).astype(np.float32)

    def normal_equations(self, images: F32, wanted: F32) -> F32:
        rows = images.reshape(len(images), wanted.size).astype(np.float64)
        return np.vstack([rows @ rows.T, rows @ wanted.ravel()]).astype(np.float32)

    def sample(self, field: F32, points: F32) -> F32:
        batch = max(len(field), len(points))
        gathered = [_gather(field[b % len(field)], points[b % len(points)]) for b in range(batch)]
        return np.stack(gathered)

    def distance_scan(self, queries: F32, corpus: F32, weights: F32) -> F32:
        distance = np.empty((len(queries), len(corpus)), np.float32)
        for k, query in enumerate(queries.astype(np.float64)):
            for n, frame in enumerate(corpus):
                distance[k, n] = np.sqrt(((query - frame) ** 2).sum(axis=-1)) @ weights
        return distance

    def evaluate_rbf(
        self, points: F32, centres: F32, weights: F32, affine: F32, sharpness: float
    ) -> F32:
        p = points.astype(np.float64)
        mapped = p @ affine[:, 1:].T + affine[:, 0]
        for centre, weight in zip(centres, weights, strict=True):
            phi = np.exp(-np.float64(np.float32(sharpness)) * ((p - centre) ** 2).sum(axis=-1))
            mapped += phi[:, None] * weight
        return mapped.astype(np.float32)

    def hold_prototypes(self, images: F32, flows: F32, hole: float) -> Prototypes:
        return Prototypes(images, flows, hole)

    def move_prototypes(
        self, held: Prototypes, flow: F32, used: NDArray[np.int64], scale: F32
    ) -> F32:
        to = picture(flow[0], held.images.shape[2])[None]
        moved = np.empty((len(used), *held.images.shape[1:]), np.float32)
        for j, i in enumerate(used):
            own = held.flows[i : i + 1]
            oriented = self._filled_warp(to - own, own, held.hole)
            moved[j] = self._filled_warp(held.images[i : i + 1], oriented, held.hole)[0]
        return np.asarray(planes(moved) * scale, np.float32)

    def prototype_equations(
        self, held: Prototypes, flow: F32, used: NDArray[np.int64], wanted: F32, scale: F32
    ) -> F32:
        moved = self.move_prototypes(held, flow[None], used, scale)
        return self.normal_equations(moved, wanted)

    def mix_prototypes(self, held: Prototypes, flows: F32, weights: F32, scale: F32) -> F32:
        mixed = np.zeros((len(flows), 3, *scale.shape), np.float32)
        for b, (flow, share) in enumerate(zip(flows, weights, strict=True)):
            used = np.flatnonzero(share)
            moved = self.move_prototypes(held, flow[None], used, scale)
            mixed[b] = np.tensordot(share[used].astype(np.float64), moved, axes=1)
        return mixed

    def _filled_warp(self, field: F32, flow: F32, hole: float) -> F32:
        return self.fill_holes(*self.forward_warp(field, flow), hole)

    def piecewise_warp(
        self, field: F32, vertices: F32, triangles: I32, index: I32, barycentric: F32
    ) -> F32:
        corners = vertices[:, triangles[index]].astype(np.float64)  # (sets, P, 3, 2)
        points = (barycentric[..., None] * corners).sum(axis=-2)
        batch = max(len(field), len(points))
        gathered = [_gather(field[b % len(field)], points[b % len(points)]) for b in range(batch)]
        return np.stack(gathered)


def _splat(field: F32, flow: F32) -> tuple[F32, F32]:
    """Forward warp of one field (H, W, C) along one flow (H, W, 2)."""
    height, width, channels = field.shape
    target, source, share = landings(flow)
    carried = np.concatenate([field, np.ones_like(field[..., :1])], axis=-1, dtype=np.float64)
    arriving = share[:, None] * carried.reshape(-1, channels + 1)[source]
    total = np.empty((height * width, channels + 1))
    for c in range(channels + 1):
        total[:, c] = np.bincount(target, arriving[:, c], minlength=height * width)
    weight = total[:, -1:]
    warped = total[:, :-1] / np.where(weight > 0, weight, 1)
    return (
        warped.reshape(field.shape).astype(np.float32),
        weight.reshape(height, width).astype(np.float32),
    )


def landings(flow: F32) -> tuple[NDArray[np.int64], NDArray[np.int64], F32]:
    """Where the pixels of a picture go along `flow` (H, W, 2): numbers of targets and sources.

    A pixel has up to four targets; the third array is the share that each gets, float32.
    """
    height, width, _ = flow.shape
    whole = np.floor(flow)
    fraction = flow - whole  # float32
    x, y = np.moveaxis(np.clip(whole, -FAR, FAR).astype(np.int64), -1, 0)
    x = x + np.arange(width)
    y = y + np.arange(height)[:, None]
    taps = []
    for dy, wy in enumerate((1 - fraction[..., 1], fraction[..., 1])):
        for dx, wx in enumerate((1 - fraction[..., 0], fraction[..., 0])):
            inside = (x + dx >= 0) & (x + dx < width) & (y + dy >= 0) & (y + dy < height)
            target = (y + dy) * width + x + dx
            taps.append((target[inside], np.flatnonzero(inside), (wx * wy)[inside]))
    target, source, share = (np.concatenate(part) for part in zip(*taps, strict=True))
    return target, source, share


def _pull_push(field: F32, valid: NDArray[np.bool_]) -> F32:
    """Fill the pixels of one field (H, W, C) that are not `valid` (H, W)."""
    if valid.all():
        return field.copy()
    number = valid.astype(np.float64)
    total = np.where(valid[..., None], field, 0).astype(np.float64)  # sum over the valid pixels
    filled = _push(total, number).astype(np.float32)
    filled[valid] = field[valid]
    return filled


def _push(total: NDArray[np.float64], number: NDArray[np.float64]) -> NDArray[np.float64]:
    """Means (h, w, C) of a level's cells, empty ones interpolated from the next coarser level."""
    mean = total / np.maximum(number, 1)[..., None]
    if number.all():
        return mean
    coarse = _push(_halve(total), _halve(number))
    return np.where(number[..., None] > 0, mean, _double(coarse, number.shape))


def _halve(level: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums over 2 x 2 blocks, the last row and column padded with zeros: (h, w, ...) -> half."""
    odd = [(0, n % 2) for n in level.shape[:2]] + [(0, 0)] * (level.ndim - 2)
    a = np.pad(level, odd)
    return a[::2, ::2] + a[::2, 1::2] + a[1::2, ::2] + a[1::2, 1::2]


def _double(level: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Bilinear upsampling by two to `shape` (h, w), the border clamped."""
    for axis, size in enumerate(shape):
        i = np.arange(size)
        near = i // 2
        far = np.clip(near + 2 * (i % 2) - 1, 0, level.shape[axis] - 1)
        level = 0.75 * level.take(near, axis) + 0.25 * level.take(far, axis)
    return level


def _gather(field: F32, points: NDArray[np.floating]) -> F32:
    """Bilinear samples (..., C) of one field (H, W, C) at points (..., 2)."""
    height, width, _ = field.shape
    limit = np.array([width - 1, height - 1], np.float32)
    p = np.clip(points, 0, limit)
    x0, y0 = np.moveaxis(p.astype(np.int64), -1, 0)
    x1 = np.minimum(x0 + 1, width - 1)
    y1 = np.minimum(y0 + 1, height - 1)
    fx, fy = np.moveaxis((p - np.floor(p)).astype(np.float64)[..., None], -2, 0)
    top = (1 - fx) * field[y0, x0] + fx * field[y0, x1]
    bottom = (1 - fx) * field[y1, x0] + fx * field[y1, x1]
    sampled: F32 = ((1 - fy) * top + fy * bottom).astype(np.float32)
    return sampled
