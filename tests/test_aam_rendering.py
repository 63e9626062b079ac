import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from worlds import POSTURES, hold

from mmmgpu.aam_rendering import RING, render_face
from mmmgpu.appearances import see
from mmmgpu.backends import get_backend
from mmmgpu.errors import InputError
from mmmgpu.landmarks import mouth_hull
from mmmgpu.performer import landmarks, render
from mmmgpu.pictures import psnr

WARP = get_backend("warp", 1)


def own_features(drawn, frame, points):
    return see(drawn.aam, [frame], points[None], WARP, where="x").features[0]


def held_out(drawn, t):
    return drawn.frame(drawn.held_out, t), drawn.points(drawn.held_out)[t]


@pytest.mark.parametrize("t", [5, 18, 30])
def test_a_frame_with_its_own_features_stays_nearly_what_it_was(drawn, t):
    frame, points = held_out(drawn, t)
    made = render_face(
        drawn.aam, frame, points, own_features(drawn, frame, points), WARP, where="x"
    )
    assert made.dtype == np.uint8
    face = mouth_hull(points[5:], frame.shape)
    assert psnr(made, frame, face) > 27
    assert psnr(made, frame, ~face) > 30


def test_what_lies_beyond_the_ring_keeps_its_bits(drawn):
    frame, points = held_out(drawn, 20)
    other, at = held_out(drawn, 2)
    made = render_face(drawn.aam, frame, points, own_features(drawn, other, at), WARP, where="x")
    ring = points.mean(axis=0) + RING * (points - points.mean(axis=0))
    low, high = np.floor(ring.min(axis=0)).astype(int), np.ceil(ring.max(axis=0)).astype(int)
    outside = np.ones(frame.shape[:2], bool)
    outside[max(low[1], 0) : high[1] + 1, max(low[0], 0) : high[0] + 1] = False
    assert_array_equal(made[outside], frame[outside])
    assert (made != frame).any()


def test_a_face_takes_on_what_another_frame_shows(drawn, world):
    """The head keeps still; one frame closed, one with the mouth wide open."""
    motion = hold(POSTURES[0], POSTURES[1])
    closed, opened = render(world.face, motion)
    rows = list(drawn.aam.rows)
    at_closed, at_opened = (landmarks(world.face, motion, t)[rows] for t in (0, 1))
    c = own_features(drawn, opened, at_opened)
    made = render_face(drawn.aam, closed, at_closed, c, WARP, where="x")
    near = mouth_hull(at_opened[5:], closed.shape)
    assert psnr(made, opened, near) > psnr(closed, opened, near) + 5


def hull(points, shape):
    """Pixels of a picture inside the convex hull of points (N, 2)."""
    inside = np.zeros(shape[:2], np.uint8)
    outline = cv2.convexHull(points.astype(np.float32))[:, 0]
    cv2.fillConvexPoly(inside, np.rint(outline).astype(np.int32), 1)
    return inside > 0


def test_what_lies_around_the_jaw_moves_along(drawn, world):
    """A closed mouth in place of an open one: below the chin is neck, not the old chin."""
    motion = hold(POSTURES[0], POSTURES[2])
    closed, opened = render(world.face, motion)
    rows = list(drawn.aam.rows)
    at_closed, at_opened = (landmarks(world.face, motion, t)[rows] for t in (0, 1))
    c = own_features(drawn, closed, at_closed)
    made = render_face(drawn.aam, opened, at_opened, c, WARP, where="x")
    below = hull(at_opened, closed.shape) & ~hull(at_closed, closed.shape)
    assert below.sum() > 40
    assert psnr(made, closed, below) > psnr(opened, closed, below) + 3


def test_the_frame_is_not_changed(drawn):
    frame, points = held_out(drawn, 9)
    kept = frame.copy()
    render_face(drawn.aam, frame, points, np.zeros(len(drawn.aam.variance)), WARP, where="x")
    assert_array_equal(frame, kept)


def test_the_light_of_the_frame_is_kept(drawn):
    frame, points = held_out(drawn, 9)
    dark = (frame * 0.5).astype(np.uint8)
    c = own_features(drawn, frame, points)
    plain, made = (render_face(drawn.aam, f, points, c, WARP, where="x") for f in (frame, dark))
    face = mouth_hull(points[5:], frame.shape)
    ratio = made[face].mean() / plain[face].mean()
    assert abs(ratio - 0.5) < 0.02


def test_a_face_at_the_border_of_the_picture_is_cut_off(drawn):
    frame, points = held_out(drawn, 9)
    left, top = (np.floor(points.min(axis=0)) - 1).astype(int)
    right, bottom = (np.ceil(points.max(axis=0)) + 2).astype(int)
    cut = np.ascontiguousarray(frame[top:bottom, left:right])
    c = own_features(drawn, frame, points)
    made = render_face(drawn.aam, cut, points - (left, top), c, WARP, where="x")
    assert made.shape == cut.shape
    assert psnr(made, cut, np.ones(cut.shape[:2], bool)) > 25


def test_a_frame_without_a_face_is_named(drawn):
    _, points = held_out(drawn, 9)
    black = np.zeros((160, 144, 3), np.uint8)
    c = np.zeros(len(drawn.aam.variance))
    with pytest.raises(InputError, match=r"x\.mp4, frame 9: what lies between"):
        render_face(drawn.aam, black, points, c, WARP, where="x.mp4, frame 9")
