"""What is measured: made-up but lifelike inputs, by name."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Case:
    """One operation on one set of arrays; `arrays` are the device arguments in order."""

    name: str
    operation: str
    arrays: tuple[np.ndarray, ...]
    scalars: tuple[float, ...] = ()
    peer: str | None = None  # a function of bench.peers


def smooth_flow(rng, batch, height, width):
    """Flows like those between mouths: smooth, a few pixels, tearing at a line."""
    y, x = np.mgrid[:height, :width]
    phase = rng.uniform(0, 6, (batch, 2, 1, 1))
    waves = 3 * np.sin(np.stack([y / 20, x / 20]) + phase)
    waves[:, 1] += 6 * np.sign(y - height / 2) * np.exp(-(((y - height / 2) / height * 6) ** 2))
    return np.ascontiguousarray(np.moveaxis(waves, 1, -1), np.float32)


def splat(rng, batch=50, height=256, width=256, channels=4):
    field = rng.random((batch, height, width, channels), dtype=np.float32)
    arrays = field, smooth_flow(rng, batch, height, width)
    return Case("forward_warp 50x256x256x4", "forward_warp", arrays, peer="forward_warp")


def fill(rng, batch=46, height=160, width=192):
    field = rng.random((batch, height, width, 3), dtype=np.float32)
    weight = (rng.random((batch, height, width)) > 0.02).astype(np.float32)
    return Case("fill_holes 46x160x192x3", "fill_holes", (field, weight), (0.5,))


def blend(rng, number=46, height=160, width=192):
    images = rng.random((number, height, width, 3), dtype=np.float32)
    return Case("blend 46x160x192x3", "blend", (images, rng.random((1, number), np.float32)))


def sample(rng, height=480, width=640):
    field = rng.random((1, height, width, 3), dtype=np.float32)
    points = rng.uniform(0, [width, height], (1, height * width, 2)).astype(np.float32)
    return Case("sample 640x480x3 at random", "sample", (field, points))


def scan(rng, queries=50, corpus=450, points=16384):
    arrays = tuple(rng.random((n, points, 2), dtype=np.float32) for n in (queries, corpus))
    weights = rng.random(points, dtype=np.float32)
    name = "distance_scan 50x450x16384x2"
    return Case(name, "distance_scan", (*arrays, weights), peer="distance_scan")


def rbf(rng, height=256, width=256, number=38):
    y, x = np.mgrid[:height, :width]
    centres = rng.uniform(0, [width, height], (number, 2))
    affine = np.array([[20, 1.2, 0.1], [-10, -0.1, 1.3]])
    arrays = np.stack([x, y], -1).reshape(-1, 2), centres, rng.normal(0, 5, (number, 2)), affine
    name = "evaluate_rbf 256x256, 38 points"
    return Case(name, "evaluate_rbf", tuple(a.astype(np.float32) for a in arrays), (0.003,))


def piecewise(rng, height=288, width=360, batch=16, across=8):
    """A mesh of 2 x 7 x 7 triangles over 64 x 72 pixels, and where it is found in 16 pictures."""
    field = rng.random((batch, height, width, 3), dtype=np.float32)
    y, x = np.mgrid[:across, :across].reshape(2, -1)
    grid = np.stack([120 + x * 10.2, 150 + y * 9.0], axis=-1)
    vertices = (grid + rng.normal(0, 1, (batch, across**2, 2))).astype(np.float32)
    corner = (np.arange(across - 1)[:, None] * across + np.arange(across - 1)).ravel()
    upper = np.stack([corner, corner + 1, corner + across], axis=1)
    lower = np.stack([corner + 1, corner + across + 1, corner + across], axis=1)
    triangles = np.concatenate([upper, lower]).astype(np.int32)
    index = np.repeat(np.arange(len(triangles)), 47).astype(np.int32)
    barycentric = rng.dirichlet(np.ones(3), len(index)).astype(np.float32)
    arrays = field, vertices, triangles, index, barycentric
    return Case("piecewise_warp 16 x 4606 pixels", "piecewise_warp", arrays)


CASES: list[Callable[[np.random.Generator], Case]] = [
    splat,
    fill,
    blend,
    sample,
    scan,
    rbf,
    piecewise,
]


@dataclass(frozen=True)
class Chain:
    """One frame of synthesis: flows re-oriented, images warped, holes filled, all blended."""

    residual: np.ndarray  # (M, H, W, 2) [px]
    flows: np.ndarray  # (M, H, W, 2) [px]
    images: np.ndarray  # (M, H, W, 3)
    weights: np.ndarray  # (1, M)


def chain(rng, number=46, height=160, width=192):
    flows = smooth_flow(rng, number, height, width)
    weights = rng.dirichlet(np.ones(number))[None].astype(np.float32)
    residual = np.tensordot(weights[0], flows, axes=1) - flows
    images = rng.random((number, height, width, 3), dtype=np.float32)
    return Chain(residual, flows, images, weights)
