import numpy as np
import oracles_aam as oracles
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmmgpu.meshes import (
    doubled_areas,
    fold_depths,
    make_mesh,
    rasterize,
    triangulate,
)


def some_points(seed, *, count=9, size=20.0):
    return np.random.default_rng(seed).uniform(0, size, (count, 2))


def as_loops_do(vertices, triangles, shape):
    """Place, triangle and coordinates of every pixel in a mesh."""
    height, width = shape
    found = {}
    for y in range(height):
        for x in range(width):
            hit = oracles.triangle_of(vertices, triangles, x, y)
            if hit is not None:
                found[y * width + x] = hit
    return found


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("shape", [(24, 22), (9, 30), (1, 1)])
def test_pixels_are_those_that_the_loops_find(seed, shape):
    points = some_points(seed) - 2
    triangles = triangulate(points)
    pixels = rasterize(points, triangles, shape)
    desired = as_loops_do(points, triangles, shape)
    assert_array_equal(pixels.place, sorted(desired))
    for at, k, shares in zip(pixels.place, pixels.index, pixels.barycentric, strict=True):
        assert k == desired[at][0]
        assert_allclose(shares, desired[at][1], atol=1e-6)


def test_corners_and_edges_at_pixels_belong_to_the_mesh():
    square = np.array([[1.0, 1], [5, 1], [5, 4], [1, 4]])
    pixels = rasterize(square, triangulate(square), (6, 7))
    assert len(pixels.place) == 5 * 4


def test_a_triangle_without_area_holds_nothing():
    line = np.array([[0.0, 0], [2, 2], [4, 4]])
    assert len(rasterize(line, np.array([[0, 1, 2]], np.int32), (6, 6)).place) == 0


def test_where_triangles_overlap_the_first_has_the_pixel():
    points = np.array([[0.0, 0], [6, 0], [0, 6], [6, 6]])
    triangles = np.array([[0, 1, 2], [0, 1, 3]], np.int32)
    pixels = rasterize(points, triangles, (7, 7))
    shared = 1 * 7 + 3  # in both
    assert pixels.index[pixels.place == shared] == 0


def test_triangles_fill_the_hull_and_turn_one_way():
    points = some_points(3, count=30)
    areas = doubled_areas(points, triangulate(points))
    assert (areas > 0).all()
    from scipy.spatial import ConvexHull

    assert_allclose(areas.sum() / 2, ConvexHull(points).volume, rtol=1e-9)


def test_a_mesh_lies_whole_in_its_picture():
    mesh = make_mesh(some_points(5, size=13.0) - (40, -3))
    height, width = mesh.shape
    assert (mesh.vertices >= 1).all()
    assert (mesh.vertices <= (width - 2, height - 2)).all()
    assert max(mesh.vertices[:, 0]) > width - 3.1
    area = doubled_areas(mesh.vertices, mesh.triangles).sum() / 2
    assert abs(len(mesh.pixels.place) - area) < height + width


def test_a_corner_that_has_crossed_a_side_is_as_deep_as_it_went():
    triangle = np.array([[0, 1, 2]], np.int32)
    for height in (3.0, 0.0, -2.0):
        points = np.array([[0.0, 0], [10, 0], [4, height]])
        assert_allclose(fold_depths(points, triangle), max(-height, 0))
    many = np.stack([points, points[::-1]])
    assert fold_depths(many, triangle).shape == (2, 1)
    assert_allclose(fold_depths(many, triangle)[:, 0], [2, 0])
