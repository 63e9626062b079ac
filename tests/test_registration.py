import cv2
import numpy as np
import oracles_model as oracles
import pytest
from worlds import texture

from mmmgpu.performer import landmarks, performer, render
from mmmgpu.performer_articulation import ARTICULATORS, REST, Articulation
from mmmgpu.registration import (
    MINIMUM_CORRELATION,
    PATCH_UNIT,
    TEMPORAL_SMOOTHNESS,
    head_from_frame,
    project,
    register,
    smooth_poses,
)

SIZE = (192, 176)
CORNERS = np.array([[40.0, 50], [130, 50], [130, 120], [40, 120]])


@pytest.fixture(scope="module")
def still():
    """A frame of a performer at rest, its mouth (x, y, width), and the truth of its head."""
    face = performer(3, size=SIZE)
    motion = posed(np.zeros((1, 4)))
    points = landmarks(face, motion, 0)
    mouth = np.array([*points[:20].mean(axis=0), np.ptp(points[:20, 0])])
    return next(render(face, motion)), mouth


def posed(pose, jaw=0.0):
    n = len(pose)
    values = np.tile(REST, (n, 1))
    values[:, ARTICULATORS.index("jaw")] = jaw
    return Articulation(values, np.asarray(pose, float), np.zeros(n), np.zeros((n, 2)), 25.0)


def about(mouth, *, shift=(0.0, 0.0), turn=0.0, scale=1.0, tilt=(0.0, 0.0)):
    """A homography about a point of the forehead."""
    x, y = mouth[0], mouth[1] - 1.3 * mouth[2]
    c, s = scale * np.cos(turn), scale * np.sin(turn)
    there = np.array([[1, 0, x + shift[0]], [0, 1, y + shift[1]], [0, 0, 1.0]])
    back = np.array([[1, 0, -x], [0, 1, -y], [0, 0, 1.0]])
    return there @ np.array([[c, -s, 0], [s, c, 0], [*tilt, 1]]) @ back


def seen_by(frame, pose):
    """`frame` moved by a homography: its pixel p is at pose p."""
    return cv2.warpPerspective(
        frame, pose, frame.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )


def head_points(mouth):
    """Points of the upper face, where poses are compared, (n, 2)."""
    x, y, width = mouth
    u, v = np.meshgrid(np.linspace(-0.9, 0.9, 5), np.linspace(-2.0, -0.6, 5))
    return np.stack([x + u.ravel() * width, y + v.ravel() * width], axis=1)


def misses(poses, truth, mouth):
    """Distance [px] of the head's points under each pose from where they are, (T, n)."""
    points = head_points(mouth)
    return np.array(
        [
            np.linalg.norm(project(p, points) - project(q, points), axis=1)
            for p, q in zip(poses, truth, strict=True)
        ]
    )


MOTIONS = {
    "shift": lambda m, t: about(m, shift=(9 * np.sin(t / 4), 5 * np.sin(t / 3))),
    "turn and scale": lambda m, t: about(
        m, turn=0.12 * np.sin(t / 4), scale=1 + 0.1 * np.sin(t / 6)
    ),
    "perspective": lambda m, t: about(m, shift=(t / 3, 0), tilt=(4e-4 * np.sin(t / 5), 0)),
}


@pytest.mark.parametrize("motion", MOTIONS)
def test_known_homographies_are_found(still, motion):
    frame, mouth = still
    truth = [MOTIONS[motion](mouth, t) for t in range(20)]
    found = list(register((seen_by(frame, p) for p in truth), head_from_frame(frame, mouth)))
    poses, correlation = zip(*found, strict=True)
    miss = misses(poses, truth, mouth)
    assert np.median(miss) < 0.15
    assert miss.max() < 1.0
    assert min(correlation) > 0.95


@pytest.mark.parametrize(("gain", "offset"), [(0.6, 0), (1.2, 20), (0.7, 60), (1.0, -30)])
def test_a_change_of_exposure_moves_nothing(still, gain, offset):
    frame, mouth = still
    truth = [about(mouth, shift=(t, t / 2), turn=0.02 * t) for t in range(5)]
    frames = [np.clip(gain * seen_by(frame, p) + offset, 0, 255).astype(np.uint8) for p in truth]
    poses, _ = zip(*register(frames, head_from_frame(frame, mouth)), strict=True)
    assert misses(poses, truth, mouth).max() < 0.6


def test_the_reference_is_at_the_identity(still):
    frame, mouth = still
    (pose, correlation), *_ = register([frame] * 2, head_from_frame(frame, mouth))
    assert misses([pose], [np.eye(3)], mouth).max() < 0.1
    assert correlation > 0.999


def test_poses_do_not_follow_the_mouth():
    face = performer(3, size=SIZE)
    closed, wide = (next(render(face, posed(np.zeros((1, 4)), jaw))) for jaw in (0.0, 1.0))
    points = landmarks(face, posed(np.zeros((1, 4))), 0)[:20]
    mouth = np.array([*points.mean(axis=0), np.ptp(points[:, 0])])
    (pose, _), *_ = register([wide], head_from_frame(closed, mouth))
    assert misses([pose], [np.eye(3)], mouth).max() < 0.4


def test_the_mask_holds_the_upper_face_and_not_the_mouth(still):
    frame, mouth = still
    head = head_from_frame(frame, mouth)
    x, y, width = mouth
    there = np.linalg.inv(head.to_frame)

    def weight(across, down):
        u, v = project(there, np.array([[x + across * width, y + down * width]]))[0]
        return head.mask[round(v), round(u)]

    assert weight(0, -1.3) == weight(0.4, -1.3) == weight(-0.4, -1.6) == 1
    assert weight(0, -0.35) == weight(1.3, -1.3) == weight(0, -2.5) == 0
    assert head.mask.min() == 0
    assert head.mask.max() == 1


def test_what_covers_a_part_of_the_face_is_not_followed(still):
    """A finger that rests before one eye while the head moves on."""
    frame, mouth = still
    truth = [about(mouth, shift=(t, t / 2)) for t in range(8)]
    frames = [seen_by(frame, p) for p in truth]
    x, y, width = mouth
    top, left = round(y - 1.9 * width), round(x + 0.2 * width)
    patch = (255 * texture(round(0.5 * width), round(0.7 * width), grain=1.5)).astype(np.uint8)
    for seen in frames:
        seen[top : top + patch.shape[0], left : left + patch.shape[1]] = patch
    poses, _ = zip(*register(frames, head_from_frame(frames[0], mouth)), strict=True)
    miss = misses(poses, truth, mouth)
    assert np.median(miss) < 0.25
    assert miss.max() < 1.5


def test_a_large_head_is_registered_in_a_smaller_patch(still):
    frame, mouth = still
    large = cv2.resize(frame, None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)
    head = head_from_frame(large, 3 * mouth)
    assert head.patch.shape == (round(2.7 * PATCH_UNIT), round(3.4 * PATCH_UNIT))
    assert head.mask.shape == head.patch.shape
    truth = [about(3 * mouth, shift=(2 * t, -t), turn=0.01 * t) for t in range(6)]
    poses, _ = zip(*register([seen_by(large, p) for p in truth], head), strict=True)
    assert misses(poses, truth, 3 * mouth).max() < 1.0


def before_a_wall(frame, mouth, truth):
    """Only the head of `frame` moves, before a wall with a pattern that stays where it is."""
    wall = (255 * texture(*frame.shape[:2], grain=1.5)).astype(np.uint8)
    y, x = np.mgrid[: frame.shape[0], : frame.shape[1]]
    across, down = (x - mouth[0]) / (1.6 * mouth[2]), (y - mouth[1] + mouth[2]) / (2.2 * mouth[2])
    head = (across**2 + down**2 < 1).astype(np.float32)
    for pose in truth:
        alpha = cv2.warpPerspective(head, pose, frame.shape[1::-1])[..., None]
        yield (alpha * seen_by(frame, pose) + (1 - alpha) * wall).astype(np.uint8)


def test_a_static_textured_wall_is_not_locked_on(still):
    frame, mouth = still
    truth = [about(mouth, shift=(14 * np.sin(t / 5), 6 * np.sin(t / 4))) for t in range(30)]
    frames = list(before_a_wall(frame, mouth, truth))
    poses, correlation = zip(*register(frames, head_from_frame(frames[0], mouth)), strict=True)
    miss = misses(poses, truth, mouth)
    assert np.median(miss) < 0.2
    assert miss.max() < 1.5
    assert min(correlation) > MINIMUM_CORRELATION


def test_a_lost_head_is_told_and_found_again(still):
    frame, mouth = still
    truth = [about(mouth, shift=(t, 0)) for t in range(12)]
    frames = [seen_by(frame, p) for p in truth]
    rng = np.random.default_rng(0)
    for t in (4, 5):
        frames[t] = rng.integers(0, 256, frame.shape, np.uint8)
    frames[6] = np.zeros_like(frame)
    found = list(register(frames, head_from_frame(frame, mouth)))
    assert len(found) == 12
    lost = np.array([correlation < MINIMUM_CORRELATION for _, correlation in found])
    assert np.flatnonzero(lost).tolist() == [4, 5, 6]
    kept = [pose for pose, _ in found]
    miss = misses(kept, truth, mouth)[~lost]
    assert miss.max() < 1.0
    assert all(np.isfinite(pose).all() for pose in kept)


def test_a_jump_of_the_head_is_followed_at_once(still):
    frame, mouth = still
    truth = [about(mouth, shift=(-25 if t < 3 else 30, 0)) for t in range(6)]
    found = register([seen_by(frame, p) for p in truth], head_from_frame(frame, mouth))
    poses, correlation = zip(*found, strict=True)
    assert misses(poses, truth, mouth).max() < 1.0
    assert min(correlation) > 0.9


def test_frames_are_asked_for_one_at_a_time(still):
    frame, mouth = still
    taken = []

    def endless():
        while True:
            taken.append(1)
            yield frame

    found = register(endless(), head_from_frame(frame, mouth))
    for _ in range(3):
        next(found)
    assert len(taken) == 3


def noisy_poses(rng, frames):
    """Poses of a slow motion with noise, (T, 3, 3)."""
    poses = np.tile(np.eye(3), (frames, 1, 1))
    poses[:, 0, 2] = 5 * np.sin(np.arange(frames) / 6) + 0.3 * rng.normal(size=frames)
    poses[:, 1, 2] = np.arange(frames) / 4 + 0.3 * rng.normal(size=frames)
    poses[:, 0, 1] = 0.01 * rng.normal(size=frames)
    poses[:, 2, 0] = 1e-4 * rng.normal(size=frames)
    return poses


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 40])
def test_smoothing_is_the_least_squares_of_its_docstring(frames):
    rng = np.random.default_rng(frames)
    poses = noisy_poses(rng, frames)
    trusted = rng.random(frames) > 0.3
    trusted[0] = True
    got = smooth_poses(poses, trusted, CORNERS)
    seen = np.array([project(p, CORNERS).ravel() for p in poses])
    wanted = oracles.smooth(seen, trusted.astype(float), TEMPORAL_SMOOTHNESS)
    carried = np.array([project(p, CORNERS).ravel() for p in got])
    np.testing.assert_allclose(carried, wanted, atol=1e-3)


def test_poses_that_are_not_trusted_do_not_matter():
    rng = np.random.default_rng(1)
    poses = noisy_poses(rng, 30)
    trusted = np.ones(30, bool)
    trusted[[0, 10, 11, 12, 29]] = False
    wild = poses.copy()
    wild[~trusted] = np.diag([3.0, -2.0, 1.0])
    wild[11] = np.nan  # of a frame without any picture
    got, again = (smooth_poses(p, trusted, CORNERS) for p in (poses, wild))
    np.testing.assert_array_equal(got, again)
    miss = [
        np.abs(project(a, CORNERS) - project(b, CORNERS)).max()
        for a, b in zip(got, poses, strict=True)
    ]
    assert max(miss) < 4  # of 300 for the wild ones: those are interpolated


def test_a_steady_motion_is_not_changed():
    poses = np.tile(np.eye(3), (20, 1, 1))
    poses[:, 0, 2] = 1.5 * np.arange(20)
    got = smooth_poses(poses, np.ones(20, bool), CORNERS)
    np.testing.assert_allclose(got, poses, atol=1e-4)


def test_project_divides_by_the_third_coordinate():
    pose = np.array([[1, 0.5, 3], [0, 2, -1], [0.01, 0, 1]])
    x, y, w = pose @ [20, 10, 1]
    np.testing.assert_allclose(project(pose, np.array([[20.0, 10]])), [[x / w, y / w]])
    assert project(pose, np.zeros((4, 5, 2))).shape == (4, 5, 2)
