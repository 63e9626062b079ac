import numpy as np
import oracles_aam as oracles
import oracles_kernels
import pytest
from drawn_aams import random_features
from numpy.testing import assert_allclose, assert_array_equal

from mmmgpu.appearances import (
    check_light,
    enlarge_points,
    fit_light,
    project,
    put_light_on,
    read_texture,
    reduce_picture,
    reduce_points,
    see,
    synthesize_shape,
    synthesize_texture,
    take_light_off,
)
from mmmgpu.backends import get_backend
from mmmgpu.errors import InputError
from mmmgpu.shapes import place

NUMPY = get_backend("numpy")


def some_texture(seed=0):
    return np.random.default_rng(seed).random((40, 3)).astype(np.float32)


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_a_reduced_picture_is_made_of_means(factor):
    frame = np.random.default_rng(0).integers(0, 256, (13, 11, 3), np.uint8)
    reduced = reduce_picture(frame, factor)
    assert reduced.dtype == np.float32
    assert reduced.shape == (13 // factor, 11 // factor, 3)
    for y, x in np.ndindex(reduced.shape[:2]):
        block = frame[y * factor : (y + 1) * factor, x * factor : (x + 1) * factor]
        assert_allclose(reduced[y, x], block.mean(axis=(0, 1)) / 255, atol=1e-6)


def test_points_stay_on_what_they_mark_in_a_reduced_picture():
    frame = np.zeros((12, 12, 3), np.uint8)
    frame[6:8, 2:4] = 255
    middle = np.array([2.5, 6.5])
    x, y = reduce_points(middle, 2)
    assert reduce_picture(frame, 2)[round(y), round(x), 0] == 1
    assert_allclose(enlarge_points(reduce_points(middle, 4), 4), middle)


def test_a_light_is_that_of_dense_least_squares():
    mean, texture = some_texture(0), some_texture(1)
    assert_allclose(fit_light(texture, mean), oracles.normal_light(texture, mean), rtol=1e-5)


def test_a_light_is_found_taken_off_and_put_back():
    mean, light = some_texture(), np.array([[0.9, 0.05], [1.2, -0.1], [1.0, 0.0]])
    lit = put_light_on(mean, light)
    assert_allclose(fit_light(lit, mean), light, atol=1e-6)
    assert_allclose(take_light_off(lit, light), mean, atol=1e-6)


def test_a_light_in_which_nothing_is_seen_is_an_error():
    light = fit_light(np.full((40, 3), 0.5, np.float32), some_texture())
    with pytest.raises(InputError, match=r"c\.mp4, frame 3: what lies between the landmarks"):
        check_light(light, "c.mp4, frame 3")


def test_a_texture_is_read_where_the_triangles_are(drawn):
    mesh = drawn.aam.mesh
    picture = reduce_picture(drawn.frame(drawn.held_out, 5), 1)
    points = drawn.points(drawn.held_out)[5]
    texture = read_texture(mesh, picture, points, NUMPY)
    some = np.linspace(0, len(texture) - 1, 6).astype(int)
    pixels = mesh.pixels
    desired = oracles_kernels.piecewise_warp(
        picture, points, mesh.triangles, pixels.index[some], pixels.barycentric[some]
    )
    assert_allclose(texture[some], desired, atol=1e-5)


def test_modes_of_shape_and_texture_together_are_orthonormal(drawn):
    n = len(drawn.aam.variance)
    both = np.concatenate(
        [drawn.aam.modes_of_shape.reshape(n, -1), drawn.aam.modes_of_texture.reshape(n, -1)], axis=1
    )
    assert_allclose(both @ both.T, np.eye(n), atol=1e-5)


def test_features_of_what_features_make_are_the_same(drawn):
    aam = drawn.aam
    for c in random_features(aam, 3):
        again = project(aam, synthesize_shape(aam, c), synthesize_texture(aam, c))
        assert_allclose(again, c, atol=1e-4)


def test_features_are_made_one_by_one_or_together(drawn):
    aam, c = drawn.aam, random_features(drawn.aam, 3)
    for make, close in ((synthesize_shape, 1e-9), (synthesize_texture, 1e-5)):
        assert_allclose(make(aam, c)[1], make(aam, c[1]), atol=close)
    assert_allclose(synthesize_shape(aam, 0 * c[0]), aam.mesh.vertices)
    assert_array_equal(synthesize_texture(aam, 0 * c[0]), aam.texture_mean)


def seen(drawn, frames, points):
    return see(drawn.aam, frames, points, NUMPY, where="x.mkv")


def test_head_and_light_are_no_part_of_the_features(drawn):
    """The frame darker and tinted, and moved, turned and enlarged, landmarks and all."""
    import cv2

    frame, points = drawn.frame(drawn.held_out, 20), drawn.points(drawn.held_out)[20]
    plain = seen(drawn, [frame], points[None])
    tinted = np.rint(frame * np.array([0.8, 0.7, 0.75]) + 9).astype(np.uint8)
    dark = seen(drawn, [tinted], points[None])
    scale = np.sqrt(drawn.aam.variance)
    assert_allclose(dark.features / scale, plain.features / scale, atol=0.1)
    assert_allclose(dark.lights[0, :, 0], plain.lights[0, :, 0] * (0.8, 0.7, 0.75), rtol=0.02)
    pose = np.array([1.5 * np.cos(0.1), 1.5 * np.sin(0.1), -20, -40])
    matrix = np.array([[pose[0], -pose[1], pose[2]], [pose[1], pose[0], pose[3]]])
    turned = cv2.warpAffine(frame, matrix, (240, 240), flags=cv2.INTER_CUBIC)
    moved = seen(drawn, [turned], place(pose, points)[None])
    assert_allclose(moved.features / scale, plain.features / scale, atol=0.5)
    corner = place(pose, place(plain.poses[0], drawn.aam.mesh.vertices))
    assert_allclose(place(moved.poses[0], drawn.aam.mesh.vertices), corner, atol=0.01)


def test_no_frames_are_no_rows(drawn):
    nothing = seen(drawn, [], np.zeros((0, len(drawn.aam.mesh.vertices), 2)))
    assert len(nothing) == 0
    assert nothing.features.shape == (0, len(drawn.aam.variance))
    assert nothing.lights.shape == (0, 3, 2)


def test_a_frame_without_a_face_is_named(drawn):
    points = drawn.points(drawn.held_out)[:2]
    frames = [drawn.frame(drawn.held_out, 0), np.zeros((160, 144, 3), np.uint8)]
    with pytest.raises(InputError, match=r"x\.mkv, frame 1: what lies between the landmarks"):
        seen(drawn, frames, points)
