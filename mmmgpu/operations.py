"""The image operations: NumPy arrays in, NumPy arrays out, inputs unchanged.

Images, flows and other fields are float32, C order, (..., H, W, C); the leading axes are a batch of
any shape, none and empty included, and broadcast against those of the other arguments. A flow is
(..., H, W, 2) = (dx, dy) [px]. NaN and infinite values are an `InputError` that names the argument.

Where a device's memory does not hold a batch, it is worked on in parts. Chains of operations that
are to stay on a device use `mmmgpu.backends.get_backend` instead.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mmmgpu.arrays import F32, I32, as_batch, as_float32, as_indices, broadcast_leads
from mmmgpu.backends import Backend, get_backend
from mmmgpu.batches import in_parts
from mmmgpu.errors import InputError

FIELD = ("...", "H", "W", "C")


def forward_warp(field: ArrayLike, flow: ArrayLike, *, backend: str = "warp") -> tuple[F32, F32]:
    """Carry every pixel of `field` along `flow` and splat it on its four neighbours: W_F(p, q).

        t = s + q(s),   weight(t) = sum_s w,   warped(t) = sum_s w p(s) / weight(t)

    with w the bilinear weight of source s at pixel t. What falls outside is dropped.

    Args:
        field: Values of any unit, shape (..., H, W, C): an image, or another flow.
        flow: (dx, dy) [px], shape (..., H, W, 2), from a pixel of `field` to where it goes.
        backend: A name for `mmmgpu.backends.get_backend`.

    Returns:
        The warped field, shape (..., H, W, C), 0 where nothing arrived, and the weight that
        arrived [1], shape (..., H, W).
    """
    f = as_float32("field", field, *FIELD)
    height, width, channels = f.shape[-3:]
    q = as_float32("flow", flow, "...", height, width, 2)
    lead = broadcast_leads(field=f.shape[:-3], flow=q.shape[:-3])
    shape = (*lead, height, width)
    if not math.prod(shape) * channels:
        return np.zeros((*shape, channels), np.float32), np.zeros(shape, np.float32)
    given = as_batch(f, lead, 3), as_batch(q, lead, 3)
    warped, weight = _batched(get_backend(backend), "forward_warp", given)
    return warped.reshape(*shape, channels), weight.reshape(shape)


def fill_holes(
    field: ArrayLike, weight: ArrayLike, *, threshold: float = 0.01, backend: str = "warp"
) -> F32:
    """Fill the pixels whose weight is below `threshold` from those around them (pull-push).

    Valid pixels are averaged down a pyramid to one cell, and holes interpolated back up from the
    finest level that has a value near them (Gortler et al., The Lumigraph, 1996). Valid pixels keep
    their bits.

    Args:
        field: Values of any unit, shape (..., H, W, C).
        weight: Confidence, shape (..., H, W), as `forward_warp` returns it.
        threshold: Weight below which a pixel is a hole, in the unit of `weight`.
        backend: A name for `mmmgpu.backends.get_backend`.

    Returns:
        The filled field, shape (..., H, W, C).

    Raises:
        InputError: A field without any valid pixel.
    """
    f = as_float32("field", field, *FIELD)
    w = as_float32("weight", weight, "...", *f.shape[-3:-1])
    if not math.isfinite(threshold):
        raise InputError(f"threshold must be a finite number, got {threshold}")
    lead = broadcast_leads(field=f.shape[:-3], weight=w.shape[:-2])
    shape = (*lead, *f.shape[-3:])
    if not math.prod(shape):
        return np.zeros(shape, np.float32)
    f = np.broadcast_to(f, shape).reshape(-1, *f.shape[-3:])
    w = np.broadcast_to(w, shape[:-1]).reshape(-1, *w.shape[-2:])
    (filled,) = _batched(get_backend(backend), "fill_holes", (f, w), threshold)
    filled = filled.reshape(shape)
    return filled.copy() if np.may_share_memory(filled, f) else filled


def blend(images: ArrayLike, weights: ArrayLike, *, backend: str = "warp") -> F32:
    """Weighted sums of images: blended[b] = sum_m weights[b, m] images[m].

    Args:
        images: Values of any unit, shape (M, H, W, C).
        weights: Weights [1], shape (..., M); they need not sum to 1.
        backend: A name for `mmmgpu.backends.get_backend`.

    Returns:
        The blends, shape (..., H, W, C).
    """
    i = as_float32("images", images, "M", "H", "W", "C")
    w = as_float32("weights", weights, "...", len(i))
    shape = (*w.shape[:-1], *i.shape[1:])
    if not math.prod(shape) * len(i):
        return np.zeros(shape, np.float32)
    k = get_backend(backend)

    def mixed(part: slice) -> F32:
        return k.to_host(k.blend(*_on_device(k, i, w.reshape(-1, len(i))[part])))

    return _joined(in_parts(mixed, math.prod(w.shape[:-1]))).reshape(shape)


def normal_equations(
    images: ArrayLike, wanted: ArrayLike, *, backend: str = "warp"
) -> tuple[F32, F32]:
    """What is to be solved for the weights with which images add up to `wanted`, or nearly.

        G[m, n] = sum images[m] images[n],   h[m] = sum images[m] wanted,

    over all pixels and channels: |sum_m b[m] images[m] - wanted|^2 is b' G b - 2 h' b and a
    constant. The quadratic programme of analysis has these.

    Args:
        images: Values of any unit, shape (M, H, W, C).
        wanted: An image of the same unit, shape (H, W, C).
        backend: A name for `mmmgpu.backends.get_backend`.

    Returns:
        The Gram matrix G, shape (M, M), and h, shape (M,), in the unit squared.
    """
    i = as_float32("images", images, "M", "H", "W", "C")
    w = as_float32("wanted", wanted, *i.shape[1:])
    number, k = len(i), get_backend(backend)
    if not i.size:
        return np.zeros((number, number), np.float32), np.zeros(number, np.float32)
    rows, flat = i.reshape(number, -1), w.ravel()

    def multiplied(part: slice) -> F32:
        here = np.ascontiguousarray(rows[:, part])
        return k.to_host(k.normal_equations(*_on_device(k, here, flat[part])))

    products = np.stack(in_parts(multiplied, w.size)).sum(axis=0, dtype=np.float64)
    return products[:-1].astype(np.float32), products[-1].astype(np.float32)


def sample(field: ArrayLike, points: ArrayLike, *, backend: str = "warp") -> F32:
    """Bilinear samples of `field` at `points`, the border clamped.

    Args:
        field: Values of any unit, shape (batch..., H, W, C).
        points: (x, y) [px], pixel centres at whole numbers, shape (batch..., any..., 2): its first
            axes are the batch axes of `field` (1 broadcasts), the others are free.
        backend: A name for `mmmgpu.backends.get_backend`.

    Returns:
        The samples, shape (batch..., any..., C).
    """
    f = as_float32("field", field, *FIELD)
    p = as_float32("points", points, "...", 2)
    own = f.shape[:-3]
    if p.ndim <= len(own):
        raise InputError(f"points must have shape (*{own}, ..., 2) as field has, got {p.shape}")
    lead = broadcast_leads(field=own, points=p.shape[: len(own)])
    free = p.shape[len(own) : -1]
    shape = (*lead, *free, f.shape[-1])
    if not math.prod(shape):
        return np.zeros(shape, np.float32)
    p = p.reshape(*p.shape[: len(own)], math.prod(free), 2)
    given = as_batch(f, lead, 3), as_batch(p, lead, 2)
    (sampled,) = _batched(get_backend(backend), "sample", given)
    return sampled.reshape(shape)


def distance_scan(
    queries: ArrayLike, corpus: ArrayLike, weights: ArrayLike, *, backend: str = "warp"
) -> F32:
    """Weighted distances of every query to every corpus field (CE05, Eq. 7 and 10).

        D[k, n] = sum_p weights[p] |queries[k, p] - corpus[n, p]|

    with the Euclidean norm over the channels.

    Args:
        queries: Flattened fields of any unit, shape (K, P, C).
        corpus: Fields of the same unit, shape (N, P, C).
        weights: Weight of each point [1], shape (P,).
        backend: A name for `mmmgpu.backends.get_backend`.

    Returns:
        Distances in the unit of the fields, shape (K, N).
    """
    q = as_float32("queries", queries, "K", "P", "C")
    c = as_float32("corpus", corpus, "N", *q.shape[1:])
    w = as_float32("weights", weights, q.shape[1])
    if not q.size * c.size:
        return np.zeros((len(q), len(c)), np.float32)
    k = get_backend(backend)

    def scanned(part: slice) -> F32:
        return k.to_host(k.distance_scan(*_on_device(k, q, c[part], w)))

    return _joined(in_parts(scanned, len(c)), axis=1)


def evaluate_rbf(
    points: ArrayLike,
    centres: ArrayLike,
    weights: ArrayLike,
    affine: ArrayLike,
    sharpness: float,
    *,
    backend: str = "warp",
) -> F32:
    """A smooth map of the plane made of Gaussians and an affine part (CE05, Eq. 6).

        S(p) = affine [1, x, y]' + sum_k weights_k exp(-sharpness |p - centres_k|^2)

    `mmmgpu.correspondence` finds the weights; its own evaluation is float64. Here a Gaussian is
    right to about 2e-7: the result is off by that share of the sum of |weights|.

    Args:
        points: (x, y) [px], shape (..., 2).
        centres: Centres of the Gaussians [px], shape (N, 2).
        weights: What each adds at its centre [px], shape (N, 2).
        affine: Columns for 1 [px], x and y [1], shape (2, 3).
        sharpness: 1 / (2 standard deviation^2) of the Gaussians [1/px^2], at least 0.
        backend: A name for `mmmgpu.backends.get_backend`.

    Returns:
        The points' images [px], shape (..., 2).
    """
    p = as_float32("points", points, "...", 2)
    c = as_float32("centres", centres, "N", 2)
    w = as_float32("weights", weights, len(c), 2)
    a = as_float32("affine", affine, 2, 3)
    if not 0 <= sharpness <= float(np.finfo(np.float32).max):
        raise InputError(f"sharpness must be a finite number, at least 0, got {sharpness}")
    if not p.size:
        return np.zeros(p.shape, np.float32)
    if not len(c):
        c = w = np.zeros((1, 2), np.float32)
    k, at = get_backend(backend), p.reshape(-1, 2)

    def mapped(part: slice) -> F32:
        here, places, shares, plane = _on_device(k, at[part], c, w, a)
        return k.to_host(k.evaluate_rbf(here, places, shares, plane, sharpness))

    return _joined(in_parts(mapped, len(at))).reshape(p.shape)


def piecewise_warp(
    field: ArrayLike,
    vertices: ArrayLike,
    triangles: ArrayLike,
    index: ArrayLike,
    barycentric: ArrayLike,
    *,
    backend: str = "warp",
) -> F32:
    """Read `field` at the pixels of a mesh whose vertices have moved: piecewise-affine warp.

        warped[p] = field(sum_j barycentric[p, j] vertices[triangles[index[p], j]])

    bilinear, the border clamped. In which triangle a pixel lies, and where in it, is computed once
    for a mesh (`mmmgpu.meshes`); from picture to picture only the vertices change.

    Args:
        field: Values of any unit, shape (batch..., H, W, C).
        vertices: (x, y) [px] of the mesh's vertices in `field`, shape (batch..., N, 2).
        triangles: Vertices of each triangle, whole numbers below N, shape (K, 3).
        index: Triangle of each pixel, whole numbers below K, shape (P,).
        barycentric: Barycentric coordinates of each pixel in its triangle [1], shape (P, 3).
        backend: A name for `mmmgpu.backends.get_backend`.

    Returns:
        The values read, shape (batch..., P, C).
    """
    f = as_float32("field", field, *FIELD)
    v = as_float32("vertices", vertices, "...", "N", 2)
    t = as_indices("triangles", triangles, v.shape[-2], "K", 3)
    i = as_indices("index", index, len(t), "P")
    b = as_float32("barycentric", barycentric, len(i), 3)
    lead = broadcast_leads(field=f.shape[:-3], vertices=v.shape[:-2])
    shape = (*lead, len(i), f.shape[-1])
    if not math.prod(shape) * f.size:
        return np.zeros(shape, np.float32)
    given = as_batch(f, lead, 3), as_batch(v, lead, 2)
    (warped,) = _batched(get_backend(backend), "piecewise_warp", given, t, i, b)
    return warped.reshape(shape)


def _batched(k: Backend, operation: str, batches: tuple[F32, ...], *same: Any) -> list[F32]:
    """The results of an operation on arrays with a batch axis; those of one item fit any batch.

    same: what else it takes: arrays and numbers that are the same for all of the batch.
    """

    def compute(part: slice) -> list[F32]:
        parts = _on_device(k, *(a if len(a) == 1 else a[part] for a in batches))
        others = [k.to_device(s) if isinstance(s, np.ndarray) else s for s in same]
        result = getattr(k, operation)(*parts, *others)
        return [k.to_host(r) for r in (result if isinstance(result, tuple) else (result,))]

    done = in_parts(compute, max(map(len, batches)))
    return [_joined(parts) for parts in zip(*done, strict=True)]


def _joined(parts: Sequence[F32], axis: int = 0) -> F32:
    return parts[0] if len(parts) == 1 else np.concatenate(parts, axis)


def _on_device(backend: Backend, *arrays: F32 | I32) -> list[Any]:
    return [backend.to_device(a) for a in arrays]
