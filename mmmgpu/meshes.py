"""Meshes: the triangles between landmarks, and the pixels that lie in them.

The mesh of the mean shape is made once (Delaunay), with its triangle and barycentric coordinates at
every pixel; `mmmgpu.operations.piecewise_warp` then reads a picture at those pixels wherever the
landmarks have gone. Triangles of one mesh have one sense of rotation; a triangle that has the other
in a picture is turned over there.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

EDGE = 1  # [px] about the mean shape in its picture
INSIDE = -1e-9  # least barycentric coordinate of a pixel of a triangle: its edges belong to it
NO_AREA = 1e-12  # [px^2] of a triangle that holds no pixel


@dataclass(frozen=True)
class Pixels:
    """The pixels of a picture that lie in some triangle, P of them.

    place: flat index of each in a picture (height, width), rising, (P,).
    index: its triangle, (P,).
    barycentric: its coordinates in that triangle, (P, 3) float32.
    """

    place: NDArray[np.int64]
    index: Ints
    barycentric: NDArray[np.float32]


@dataclass(frozen=True)
class Mesh:
    """The mean shape as a mesh in a picture of its own.

    vertices: (N, 2), (x, y) [px] in that picture.
    triangles: (K, 3) vertices of each.
    shape: (height, width) [px] of the picture.
    pixels: those in it.
    """

    vertices: Floats
    triangles: Ints
    shape: tuple[int, int]
    pixels: Pixels


def make_mesh(points: Floats, triangles: Ints | None = None) -> Mesh:
    """The mesh of `points` (N, 2) [px], moved into the corner of a picture that just holds them.

    triangles: those of Delaunay, if None.
    """
    vertices = points - np.floor(points.min(axis=0)) + EDGE
    width, height = (int(n) for n in np.ceil(vertices.max(axis=0)) + 1 + EDGE)
    chosen = triangulate(vertices) if triangles is None else triangles
    return Mesh(vertices, chosen, (height, width), rasterize(vertices, chosen, (height, width)))


def triangulate(points: Floats) -> Ints:
    """Delaunay's triangles of `points` (N, 2), all with one sense of rotation: (K, 3)."""
    from scipy.spatial import Delaunay

    triangles = Delaunay(points).simplices.astype(np.int32)
    backward = doubled_areas(points, triangles) < 0
    triangles[backward] = triangles[backward][:, [0, 2, 1]]
    return np.asarray(triangles[np.lexsort(triangles.T)], np.int32)


def doubled_areas(points: Floats, triangles: Ints) -> Floats:
    """Twice the signed area of each triangle [px^2], points (..., N, 2) -> (..., K)."""
    a, b, c = (points[..., triangles[:, i], :] for i in range(3))
    first, second = b - a, c - a
    doubled: Floats = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
    return doubled


def fold_depths(points: Floats, triangles: Ints) -> Floats:
    """How far each triangle is turned over [px]: by so much a corner has crossed the side opposite.

    0 where it is not. Points (..., N, 2) -> (..., K).
    """
    corners = points[..., triangles, :]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=-2), axis=-1).max(axis=-1)
    height = doubled_areas(points, triangles) / np.maximum(sides, 1e-12)
    return np.asarray(np.maximum(-height, 0.0))


def rasterize(vertices: Floats, triangles: Ints, shape: tuple[int, int]) -> Pixels:
    """The pixels of a picture (height, width) inside the triangles (K, 3) of `vertices` (N, 2).

    A pixel in several of them, on an edge or in a fold, belongs to the first.
    """
    height, width = shape
    owner = np.full(height * width, -1, np.int32)
    coordinates = np.zeros((height * width, 3))
    for k in range(len(triangles) - 1, -1, -1):
        corners = vertices[triangles[k]]
        low = np.maximum(np.ceil(corners.min(axis=0) - 1e-6), 0).astype(int)
        high = np.minimum(np.floor(corners.max(axis=0) + 1e-6), (width - 1, height - 1)).astype(int)
        if (low > high).any():
            continue
        x, y = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
        shares = _barycentric(corners, x.ravel(), y.ravel())
        inside = (shares >= INSIDE).all(axis=1)
        at = (y.ravel() * width + x.ravel())[inside]
        owner[at], coordinates[at] = k, shares[inside]
    found = np.flatnonzero(owner >= 0)
    return Pixels(found, owner[found], coordinates[found].astype(np.float32))


def _barycentric(corners: Floats, x: NDArray[np.int64], y: NDArray[np.int64]) -> Floats:
    """Coordinates (n, 3) in a triangle (3, 2); all -1 where it has no area."""
    (ax, ay), (bx, by), (cx, cy) = corners
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if abs(area) < NO_AREA:
        return np.full((len(x), 3), -1.0)
    second = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
    third = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
    return np.stack([1 - second - third, second, third], axis=1)
