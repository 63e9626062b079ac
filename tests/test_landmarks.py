from pathlib import Path

import numpy as np
import pytest

from mmmgpu.errors import InputError
from mmmgpu.landmarks import (
    HULL_SCALE,
    LIPS,
    carried,
    lip_opening,
    mouth_hull,
    moved_landmarks,
    read_landmarks,
)

CLIP = Path("somewhere/clip 1.mkv")
ANGLES = np.linspace(0, 2 * np.pi, 360, endpoint=False)


def outer_lip(seed):
    """20 points about an ellipse and as many inside it, (40, 2)."""
    rng = np.random.default_rng(seed)
    angle = np.pi * (1 + np.arange(20) / 10)
    reach = np.array([22, 9]) * rng.uniform(0.8, 1.2, (20, 1))
    points = (60, 45) + reach * np.stack([np.cos(angle), -np.sin(angle)], axis=1)
    return np.concatenate([points, (60, 45) + 0.1 * (points - (60, 45))])


def outside_by(points, hull):
    """How far each of `points` (n, 2) lies outside the convex hull of `hull`; < 0 inside."""
    direction = np.stack([np.cos(ANGLES), np.sin(ANGLES)])
    return (points @ direction - (hull @ direction).max(axis=0)).max(axis=1)


def pixels():
    """The centres of all pixels of a picture, (90 * 120, 2)."""
    x, y = np.meshgrid(np.arange(120), np.arange(90))
    return np.stack([x.ravel(), y.ravel()], axis=1)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("move", [(0, 0), (-50, 20)])
def test_the_hull_holds_the_points_that_no_line_parts_from_it(seed, move):
    points = outer_lip(seed)
    lip = points[:20]
    centre = pixels()[outside_by(pixels(), lip) < 0].mean(axis=0)
    scaled = centre + HULL_SCALE * (lip - centre) + move
    distance = outside_by(pixels(), scaled).reshape(90, 120)
    inside = mouth_hull(points + move, (90, 120, 3))
    assert inside.shape == (90, 120)
    assert inside[distance < -0.2].all()
    assert not inside[distance > 1.0].any()
    assert inside.sum() > 500


def test_landmarks_without_movement_stay(basis):
    points = np.random.default_rng(0).uniform(70, 90, (9, 2))
    moved = moved_landmarks(basis, np.zeros((3, 4)), points)
    np.testing.assert_array_equal(moved, np.stack([points] * 3))


def test_landmarks_follow_the_flow_of_each_frame(basis):
    corner = np.array(basis.region.box[:2])
    at = np.array([[35, 20], [30, 31], [40, 38]])
    alpha = np.random.default_rng(1).normal(0, 0.5, (4, len(basis.moving)))
    moved = moved_landmarks(basis, alpha, (corner + at).astype(float))
    for points, a in zip(moved, alpha, strict=True):
        for (x, y), point in zip(at, points, strict=True):
            step = sum(w * basis.flows[i, y, x] for w, i in zip(a, basis.moving, strict=True))
            np.testing.assert_allclose(point, np.array([x, y]) + corner + step, atol=1e-4)
    assert np.abs(moved - (corner + at)).max() > 1


def test_between_pixels_the_flow_is_linear(basis):
    corner = np.array(basis.region.box[:2])
    alpha = np.ones((1, len(basis.moving)))
    ends = np.array([[35.0, 30], [36.0, 30]]) + corner
    (left, right) = moved_landmarks(basis, alpha, ends)[0]
    middle = moved_landmarks(basis, alpha, ends.mean(axis=0)[None])[0, 0]
    np.testing.assert_allclose(middle, (left + right) / 2, atol=1e-3)


def test_poses_carry_the_points_of_their_own_frames():
    rng = np.random.default_rng(0)
    poses = np.eye(3) + rng.normal(0, [[0.05], [0.05], [0.001]], (3, 3, 3))
    points = rng.uniform(0, 100, (3, 5, 2))
    got = carried(poses, points)
    for t in range(3):
        for n in range(5):
            x, y, w = poses[t] @ [*points[t, n], 1]
            np.testing.assert_allclose(got[t, n], [x / w, y / w], rtol=1e-12)
    back = carried(np.linalg.inv(poses), got)
    np.testing.assert_allclose(back, points, rtol=1e-9)


def test_the_opening_is_that_of_the_drawn_lips():
    points = np.stack([outer_lip(0)] * 2)
    points[1, 5, 1] += 4
    points[1, 15, 1] -= 1
    closed, opened = lip_opening(points)
    np.testing.assert_allclose(opened - closed, 5)
    assert closed > 0


def save(folder, **arrays):
    np.savez(folder / f"{CLIP.stem}.npz", **arrays)
    return folder


def test_landmarks_are_read(tmp_path):
    points = np.random.default_rng(0).random((4, 103, 2), np.float32)
    got = read_landmarks(save(tmp_path, points=points), CLIP, 4)
    assert got.dtype == np.float64
    np.testing.assert_array_equal(got, points)
    assert got[:, LIPS].shape == (4, 40, 2)


NAN = np.full((4, 40, 2), np.nan)


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        ({"other": np.zeros(3)}, "no landmarks"),
        ({"points": np.zeros((3, 103, 2))}, r"\(4, 40 or more, 2\), has \(3, 103, 2\)"),
        ({"points": np.zeros((4, 39, 2))}, r"has \(4, 39, 2\)"),
        ({"points": np.zeros((4, 206))}, r"has \(4, 206\)"),
        ({"points": np.array(["a"])}, r"has \(1,\)"),
        ({"points": np.full((4, 40, 2), "a")}, "finite numbers"),
        ({"points": np.zeros((4, 40, 3))}, r"has \(4, 40, 3\)"),
        ({"points": NAN}, "finite numbers"),
        ({"points": np.array([None])}, "no landmarks"),
    ],
)
def test_bad_landmarks_are_named(tmp_path, arrays, says):
    folder = save(tmp_path, **arrays)
    with pytest.raises(InputError, match=says) as caught:
        read_landmarks(folder, CLIP, 4)
    assert str(tmp_path / "clip 1.npz") in str(caught.value)


def test_missing_or_damaged_files_are_named(tmp_path):
    path = tmp_path / "clip 1.npz"
    for data in (None, b"no archive"):
        if data is not None:
            path.write_bytes(data)
        with pytest.raises(InputError, match=r"no landmarks of .*; give --landmarks DIR"):
            read_landmarks(tmp_path, CLIP, 4)
