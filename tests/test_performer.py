from typing import NamedTuple

import cv2
import numpy as np
import pytest

from mmmgpu import performer_render
from mmmgpu.errors import InputError
from mmmgpu.performer import (
    ARTICULATORS,
    PHONES,
    Articulation,
    articulate,
    flow,
    landmarks,
    masks,
    performer,
    render,
)
from mmmgpu.performer_render import portrait, repaint

SIZE = (160, 144)


class Segment(NamedTuple):
    label: str
    start: float
    end: float


def posed(*rows, pose=None):
    """An articulation of rest with the given articulators changed, one frame a dict."""
    rest = {"width": 0.5, "tongue_height": 0.3, "tongue_advance": 0.4}
    values = np.array([[{**rest, **row}.get(name, 0.0) for name in ARTICULATORS] for row in rows])
    n = len(rows)
    pose = np.zeros((n, 4)) if pose is None else np.asarray(pose, float)
    return Articulation(values, pose, np.zeros(n), np.zeros((n, 2)), 25.0)


CLOSED = {"press": 1.0}
OPEN = {"jaw": 0.8, "lower_lip": 0.3, "upper_lip": 0.3}
SPREAD = {"jaw": 0.2, "width": 0.9, "lower_lip": 0.5, "upper_lip": 0.4}
ROUND = {"jaw": 0.2, "width": 0.15, "round": 1.0, "lower_lip": 0.2}


def sentence(labels, length=0.14):
    return [Segment(p, i * length, (i + 1) * length) for i, p in enumerate(labels.split())]


@pytest.fixture(scope="module")
def face():
    return performer(5, size=SIZE)


def test_pictures_have_the_promised_shape(face):
    frames = list(render(face, posed(CLOSED, OPEN)))
    assert len(frames) == 2
    assert all(f.shape == (*SIZE, 3) and f.dtype == np.uint8 for f in frames)


def test_a_head_at_rest_is_painted_as_one_that_moves(face):
    still, moved = (posed(OPEN, pose=[[pose] * 4]) for pose in (0, 1e-9))
    np.testing.assert_array_equal(next(render(face, still)), next(render(face, moved)))


@pytest.mark.parametrize("part", [OPEN, SPREAD, ROUND])
def test_the_mouth_is_painted_inside_as_if_it_were_wide_open(face, monkeypatch, part):
    quick = next(render(face, posed(part)))
    monkeypatch.setattr(performer_render, "_around", lambda cover: np.s_[:, :])
    np.testing.assert_array_equal(quick, next(render(face, posed(part))))


def test_rendering_is_lazy(face):
    frames = render(face, posed(*[CLOSED] * 100_000))
    assert next(frames).shape == (*SIZE, 3)


def test_same_seed_same_person_same_pixels():
    a, b = (next(render(performer(3, size=SIZE), posed(OPEN))) for _ in range(2))
    np.testing.assert_array_equal(a, b)
    noisy = [
        next(render(performer(3, size=SIZE), posed(OPEN), rng=np.random.default_rng(1)))
        for _ in range(2)
    ]
    np.testing.assert_array_equal(*noisy)
    assert 0.4 < np.std(noisy[0].astype(float) - a) < 4


def test_two_seeds_are_two_people_with_one_articulation():
    motion = posed(OPEN)
    people = [performer(seed, size=SIZE) for seed in range(6)]
    faces = [next(render(p, motion)).astype(float) for p in people]
    distance = [np.abs(a - b).mean() for i, a in enumerate(faces) for b in faces[:i]]
    assert min(distance) > 4
    assert len({p.shape for p in people}) == len({p.style for p in people}) == 6
    for p in people:
        assert masks(p, motion, 0)["inside"].sum() > 60


@pytest.mark.parametrize("size", [(64, 64), (97, 131), (200, 120)])
def test_any_size_shows_the_same_person(size):
    small, large = performer(2, size=size), performer(2, size=(256, 256))
    assert small.shape == large.shape
    frame = next(render(small, posed(OPEN)))
    assert frame.shape == (*size, 3)
    np.testing.assert_allclose(
        (landmarks(small, posed(OPEN), 0) - small.origin) / small.scale,
        (landmarks(large, posed(OPEN), 0) - large.origin) / large.scale,
        atol=1e-6,
    )


MOVES = {
    "head": (CLOSED, CLOSED, [[0, 0, 0, 0], [0.02, -0.015, 0.03, 0.01]]),
    "jaw": (SPREAD, OPEN, None),
    "lips": (ROUND, SPREAD, [[0.01, 0, 0, 0], [0, 0.01, -0.02, 0]]),
    "closing": (OPEN, CLOSED, None),
}


@pytest.mark.parametrize("move", MOVES)
def test_flow_carries_one_frame_onto_the_other(face, move):
    *rows, pose = MOVES[move]
    motion = posed(*rows, pose=pose)
    a, b = (f.astype(np.float32) for f in render(face, motion))
    q, valid = flow(face, motion, 0, 1)
    assert q.shape == (*SIZE, 2)
    assert q.dtype == np.float32
    assert valid.shape == SIZE
    assert valid.dtype == bool
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float32)
    back = cv2.remap(b, x + q[..., 0], y + q[..., 1], cv2.INTER_LINEAR)
    skin = valid & masks(face, motion, 0)["face"]
    with_flow = np.abs(back - a)[skin].mean()
    without = np.abs(b - a)[skin].mean()
    assert with_flow < 2.6
    assert with_flow < 0.6 * without


def test_flow_to_itself_is_zero(face):
    motion = posed(OPEN, pose=[[0.01, 0.02, 0.03, 0.01]])
    q, valid = flow(face, motion, 0, 0)
    assert np.abs(q[valid]).max() < 1e-5
    np.testing.assert_array_equal(valid, ~masks(face, motion, 0)["inside"])


def test_flow_there_and_back_is_the_identity(face):
    motion = posed(ROUND, OPEN, pose=[[0.01, 0, 0.02, 0], [-0.01, 0.01, 0, 0.01]])
    there, valid = flow(face, motion, 0, 1)
    back, valid_back = flow(face, motion, 1, 0)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float32)
    mx, my = x + there[..., 0], y + there[..., 1]
    returned = there + cv2.remap(back, mx, my, cv2.INTER_LINEAR)
    sure = cv2.remap(valid_back.astype(np.float32), mx, my, cv2.INTER_LINEAR) > 0.999
    skin = cv2.erode(masks(face, motion, 0)["face"].astype(np.uint8), np.ones((7, 7))) > 0
    error = np.linalg.norm(returned, axis=-1)[valid & sure & skin]
    assert error.size > 3000
    assert np.quantile(error, 0.99) < 0.1  # what bilinear reading of `back` leaves


def test_flow_moves_the_landmarks(face):
    motion = posed(CLOSED, SPREAD, pose=[[0, 0, 0, 0], [0.01, 0.01, 0.02, 0]])
    q, valid = flow(face, motion, 0, 1)
    before, after = landmarks(face, motion, 0), landmarks(face, motion, 1)
    rows = [*range(61, 69), *range(87, 103)]  # nose and cheeks: on the skin, far from its edges
    assert valid[tuple(np.rint(before[rows, ::-1]).astype(int).T)].all()
    points = before[rows].astype(np.float32)
    carried = cv2.remap(q, points[:, None, 0], points[:, None, 1], cv2.INTER_LINEAR)[:, 0]
    np.testing.assert_allclose(before[rows] + carried, after[rows], rtol=0, atol=0.1)


def test_eyes_are_valid_only_while_they_rest(face):
    still = posed(CLOSED, CLOSED)
    blinking = Articulation(still.values, still.pose, np.array([0.0, 1.0]), still.gaze, 25.0)
    eye = tuple(np.rint(landmarks(face, still, 0)[75:81].mean(axis=0)).astype(int)[::-1])
    assert flow(face, still, 0, 1)[1][eye]
    assert not flow(face, blinking, 0, 1)[1][eye]
    open_eye, shut_eye = (f[eye].astype(float) for f in render(face, blinking))
    assert np.abs(open_eye - shut_eye).max() > 25


@pytest.mark.parametrize("seed", range(8))
def test_masks_are_consistent(seed):
    someone = performer(seed, size=SIZE)
    motion = posed(CLOSED, OPEN, SPREAD, ROUND)
    found = [masks(someone, motion, t) for t in range(4)]
    for m in found:
        assert all(v.shape == SIZE and v.dtype == bool for v in m.values())
        assert not (m["lips"] & m["inside"]).any()
        np.testing.assert_array_equal(m["mouth"], m["lips"] | m["inside"])
        assert not (m["mouth"] & ~m["face"]).any()
        assert m["lips"].sum() > 40
    assert not found[0]["inside"].any()
    width = [np.ptp(np.nonzero(m["lips"])[1]) for m in found]
    assert width[2] > width[0] > width[3]
    assert found[1]["inside"].sum() > 2 * found[3]["inside"].sum()


def test_the_inside_of_the_mouth_is_dark_and_holds_teeth(face):
    frame = next(render(face, posed(OPEN))).astype(float).mean(axis=-1)
    inside = masks(face, posed(OPEN), 0)["inside"]
    skin = masks(face, posed(OPEN), 0)["face"]
    assert frame[inside].min() < 60
    assert np.median(frame[inside]) < 0.75 * np.median(frame[skin])
    assert frame[inside].max() > 120


def test_landmarks_lie_where_their_names_say(face):
    motion = posed(OPEN)
    points, m = landmarks(face, motion, 0), masks(face, motion, 0)
    assert points.shape == (103, 2)
    centre = points[0:20].mean(axis=0)
    grown = cv2.dilate(m["lips"].astype(np.uint8), np.ones((3, 3))) > 0
    clear = [*range(2, 9), *range(12, 19)]  # at the corners the lips are too thin to hit
    for x, y in np.rint(centre + 0.97 * (points[clear] - centre)).astype(int):
        assert grown[y, x]
    assert points[0, 0] < points[10, 0]  # from the person's right corner ...
    assert points[5, 1] > points[15, 1]  # ... along the lower lip
    assert points[50, 1] == points[40:61, 1].max()  # the chin
    assert points[75:81, 0].max() < points[61, 0] < points[81:87, 0].min()
    polygon = points[20:40].astype(np.float32)
    area = cv2.contourArea(polygon)
    assert abs(area - m["inside"].sum()) < 0.15 * area


def test_bilabials_close_and_silence_is_closed_in_running_speech():
    phones = sentence("SIL SIL SIL AA M AA B IY P AE M UW SIL SIL SIL", 0.12)
    n = 45
    for seed in range(4):
        someone = performer(seed, size=SIZE)
        motion = articulate(someone, phones, n, 25.0, np.random.default_rng(0))
        gap = np.array([masks(someone, motion, t)["inside"].sum() for t in range(n)])
        middle = np.array([(p.start + p.end) / 2 for p in phones]) * 25
        at = {i: gap[int(m)] for i, m in enumerate(middle)}
        assert [at[i] for i, p in enumerate(phones) if p.label in ("M", "B", "P")] == [0] * 4
        assert gap[:5].max() == 0
        assert gap[-6:].max() == 0
        assert min(at[i] for i, p in enumerate(phones) if p.label in ("AA", "AE")) > 40


@pytest.mark.parametrize("frame", [-1, 2])
def test_a_frame_that_is_not_there_is_named(face, frame):
    motion = posed(CLOSED, OPEN)
    for call in (lambda: masks(face, motion, frame), lambda: landmarks(face, motion, frame)):
        with pytest.raises(InputError, match=f"frame {frame} does not exist.* has 2"):
            call()
    with pytest.raises(InputError, match=f"frame {frame} does not exist"):
        flow(face, motion, 0, frame)


def test_bad_arguments_of_a_performer_are_named():
    with pytest.raises(InputError, match="seed must be >= 0, got -1"):
        performer(-1)
    with pytest.raises(InputError, match=r"size must be .* >= 64, got \(63, 100\)"):
        performer(0, size=(63, 100))


def test_all_phones_can_be_said(face):
    phones = sentence(" ".join(PHONES), 0.08)
    motion = articulate(face, phones, 90, 25.0, np.random.default_rng(0))
    assert len(motion) == 90
    assert np.ptp(motion.values, axis=0).min() > 0.2


@pytest.mark.parametrize("seed", range(6))
def test_lips_are_redder_than_the_skin(seed):
    someone, motion = performer(seed, size=SIZE), posed({})
    frame, m = next(render(someone, motion)).astype(float), masks(someone, motion, 0)
    redness = frame[..., 0] / frame[..., 1]
    skin = m["face"] & ~cv2.dilate(m["mouth"].astype(np.uint8), np.ones((5, 5))).astype(bool)
    assert np.median(redness[m["lips"]]) > 1.05 * np.median(redness[skin])


@pytest.mark.parametrize("seed", range(6))
def test_what_is_painted_again_leaves_no_seam(seed):
    """The windows painted anew at every frame meet the still picture: at rest they are equal."""
    someone = performer(seed, size=SIZE)
    art = portrait(someone)
    canvas = art.still.copy()
    rest = posed({})
    repaint(someone, art, canvas, rest, 0)
    eyes = np.zeros(canvas.shape[:2], bool)
    eyes[art.eyes] = True
    lips = cv2.resize(masks(someone, rest, 0)["mouth"].astype(np.uint8), canvas.shape[1::-1]) > 0
    change = np.abs(canvas.astype(int) - art.still).max(axis=-1)
    assert (
        change[~eyes & ~cv2.dilate(lips.astype(np.uint8), np.ones((9, 9))).astype(bool)].max() < 8
    )
    rows, cols = art.eyes
    edge = [change[rows.start + 2, cols], change[rows.stop - 3, cols]]
    edge += [change[rows, cols.start + 2], change[rows, cols.stop - 3]]
    assert max(e.max() for e in edge) < 12
