"""The operations on made-up but lifelike arrays: what is measured of the kernels, as data.

Bytes are those that must be read and written once; operations are additions, products, roots,
divisions and exponentials, each counted as one.
"""

from dataclasses import dataclass

import numpy as np

EVERY = 5  # rows of a corpus: no divisor of those that kernels take together


@dataclass(frozen=True)
class Case:
    """One operation on one set of arrays.

    operation: a method of `mmmgpu.backends.Backend`, and a function of the peers.
    arrays, scalars: its arguments in order.
    answer: values of what it returns.
    operations: that it does at least.
    touched: values of the first array that it reads; None: all.
    every: the reference works on each so many-th item of the second array, the last axis of what is
        returned, where all would take long.
    """

    name: str
    operation: str
    arrays: tuple[np.ndarray, ...]
    answer: int
    operations: int
    scalars: tuple[float, ...] = ()
    touched: int | None = None
    every: int = 1

    @property
    def bytes(self):
        """Read and written once."""
        first, *others = self.arrays
        read = first.size if self.touched is None else self.touched
        return 4 * (read + self.answer) + sum(a.nbytes for a in others)


def smooth_flow(rng, batch, height, width):
    """Flows like those between mouths: smooth, a few pixels, tearing at a line."""
    y, x = np.mgrid[:height, :width]
    phase = rng.uniform(0, 6, (batch, 2, 1, 1))
    waves = 3 * np.sin(np.stack([y / 20, x / 20]) + phase)
    waves[:, 1] += 6 * np.sign(y - height / 2) * np.exp(-(((y - height / 2) / height * 6) ** 2))
    return np.ascontiguousarray(np.moveaxis(waves, 1, -1), np.float32)


def splat(rng, batch=50, height=256, width=256, channels=4):
    """Each value times four weights, added; then a division."""
    field = rng.random((batch, height, width, channels), dtype=np.float32)
    pixels = batch * height * width
    return Case(
        f"forward_warp {batch}x{height}x{width}x{channels}",
        "forward_warp",
        (field, smooth_flow(rng, batch, height, width)),
        answer=pixels * (channels + 1),
        operations=pixels * (8 * (channels + 1) + channels + 8),
    )


def fill(rng, batch=46, height=160, width=192):
    """One pixel in fifty is a hole. Nearly all that must be done is to copy and to average once."""
    field = rng.random((batch, height, width, 3), dtype=np.float32)
    weight = (rng.random((batch, height, width)) > 0.02).astype(np.float32)
    size = batch * height * width
    name = f"fill_holes {batch}x{height}x{width}x3"
    return Case(name, "fill_holes", (field, weight), 3 * size, 8 * size, (0.5,))


def blend(rng, number=46, height=160, width=192):
    """One weighted sum of mouths."""
    return mixture(rng, number, height, width, channels=3)


def blend_large(rng, number=50, height=256, width=256):
    """One weighted sum of arrays of the size that `splat` works on."""
    return mixture(rng, number, height, width, channels=4)


def mixture(rng, number, height, width, channels):
    """`blend` with one row of weights."""
    images = rng.random((number, height, width, channels), dtype=np.float32)
    weights = rng.dirichlet(np.ones(number), 1).astype(np.float32)
    name, size = f"blend {number}x{height}x{width}x{channels}", channels * height * width
    return Case(name, "blend", (images, weights), size, 2 * number * size)


def equations(rng, number=46, height=142, width=208):
    """The Gram matrix of a frame's analysis: each product once, and those with the frame."""
    *images, wanted = rng.random((number + 1, height, width, 3), dtype=np.float32)
    products = number * (number + 1) // 2 + number
    return Case(
        f"normal_equations {number}x{height}x{width}x3",
        "normal_equations",
        (np.stack(images), wanted),
        answer=(number + 1) * number,
        operations=2 * products * wanted.size,
    )


def sample(rng, height=480, width=640):
    """Backward warping of a picture along a smooth flow, as of one frame."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    points = (np.stack([x, y], -1) + smooth_flow(rng, 1, height, width)[0]).reshape(1, -1, 2)
    return gather(rng, height, width, points, "a warp")


def sample_at_random(rng, height=480, width=640):
    """The same at points without any order, for which caches do not help."""
    points = rng.uniform(0, [width - 1, height - 1], (1, height * width, 2)).astype(np.float32)
    return gather(rng, height, width, points, "at random")


def gather(rng, height, width, points, kind):
    """`sample` of a picture at as many points."""
    field = rng.random((1, height, width, 3), dtype=np.float32)
    name, size = f"sample {width}x{height}x3, {kind}", height * width
    arrays = field, np.ascontiguousarray(points)
    return Case(name, "sample", arrays, answer=3 * size, operations=size * (4 + 3 * 9))


def scan(rng, queries=50, corpus=450, points=16384):
    """For each pair and point two differences and squares, two sums, a root and a product."""
    arrays = tuple(rng.random((n, points, 2), dtype=np.float32) for n in (queries, corpus))
    weights = rng.random(points, dtype=np.float32)
    name = f"distance_scan {queries}x{corpus}x{points}x2"
    work = queries * corpus * points * 8
    return Case(name, "distance_scan", (*arrays, weights), queries * corpus, work, every=EVERY)


def rbf(rng, height=256, width=256, number=38):
    """A map like those between two faces: points apart from each other, weights that cancel."""
    y, x = np.mgrid[:height, :width]
    across = int(np.ceil(np.sqrt(number)))
    cells = rng.permutation(across * across)[:number]
    place = (np.stack([cells % across, cells // across], -1) + 0.5) / across
    centres = (place + rng.uniform(-0.3, 0.3, place.shape) / across) * [width, height]
    plane = np.linalg.qr(np.column_stack([np.ones(number), centres]))[0]
    weights = rng.normal(0, 5, (number, 2))
    weights -= plane @ (plane.T @ weights)  # the side conditions of an interpolant
    affine = np.array([[20, 1.2, 0.1], [-10, -0.1, 1.3]])
    arrays = np.stack([x, y], -1).reshape(-1, 2), centres, weights, affine
    return Case(
        f"evaluate_rbf {width}x{height}, {number} points",
        "evaluate_rbf",
        tuple(a.astype(np.float32) for a in arrays),
        answer=2 * height * width,
        operations=height * width * (number * 11 + 8),
        scalars=(0.001,),
    )


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
    places = np.einsum("pj,bpjc->bpc", barycentric, vertices[:, triangles[index]])
    return Case(
        f"piecewise_warp {batch}x{len(index)} pixels",
        "piecewise_warp",
        (field, vertices, triangles, index, barycentric),
        answer=batch * len(index) * 3,
        operations=batch * len(index) * (10 + 4 + 3 * 9),
        touched=3 * pixels_near(places, height, width),
    )


def pixels_near(places, height, width):
    """How many pixels of some pictures are a corner of one of the places (B, P, 2) in each."""
    near = np.zeros((len(places), height, width), bool)
    x, y = np.moveaxis(places.astype(int), -1, 0)
    for corner in np.ndindex(2, 2):
        near[np.arange(len(places))[:, None], y + corner[0], x + corner[1]] = True
    return int(near.sum())


CASES = (
    *(splat, fill, blend, blend_large, equations),
    *(sample, sample_at_random, scan, rbf, piecewise),
)
