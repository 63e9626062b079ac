import json

import numpy as np
import pytest
from media import encode, grey_levels
from numpy.testing import assert_allclose, assert_array_equal

from mmmgpu.errors import InputError
from mmmgpu.labelled_clips import ROWS, read_labelled_clip, read_labelled_clips, steadiness

FRAMES = 4
SHAPE = 5 + 30 * np.random.default_rng(0).random((103, 2))


@pytest.fixture
def clip(tmp_path):
    """Four frames of 64 x 48 pixels."""
    return encode(tmp_path / "a b.mkv", grey_levels(FRAMES))


def save(folder, points, name="a b"):
    np.savez(folder / f"{name}.npz", points=np.asarray(points, np.float32))
    return folder


def save_json(folder, value, name="a b"):
    text = value if isinstance(value, str) else json.dumps(value)
    (folder / f"{name}.json").write_text(text)
    return folder


def by_hand(*frames, points=SHAPE[:5], **changed):
    listed = [{"frame": t, "points": points.tolist()} for t in frames]
    return {"format": "mmmgpu-landmarks", "version": 1, "frames": listed} | changed


def test_the_rows_asked_for_are_read_from_every_frame(clip, tmp_path):
    points = SHAPE + 0.1 * np.arange(FRAMES)[:, None, None]
    found = read_labelled_clip(clip, save(tmp_path, points), (3, 100, 7))
    assert found.points.dtype == np.float64
    assert_allclose(found.points, points[:, [3, 100, 7]], atol=1e-5)
    assert_array_equal(found.frames, range(FRAMES))
    assert found.is_complete


def test_all_rows_may_be_asked_for_and_any_number_is_enough(clip, tmp_path):
    points = np.stack([SHAPE[:3]] * FRAMES)
    found = read_labelled_clip(clip, save(tmp_path, points), None)
    assert_allclose(found.points, points, atol=1e-5)


def test_some_frames_may_be_labelled_by_hand(clip, tmp_path):
    found = read_labelled_clip(clip, save_json(tmp_path, by_hand(3, 1)), None)
    assert_array_equal(found.frames, [1, 3])
    assert_array_equal(found.points, [SHAPE[:5], SHAPE[:5]])
    assert not found.is_complete


def test_a_trackers_file_goes_before_one_by_hand(clip, tmp_path):
    save_json(tmp_path, "no JSON at all")
    found = read_labelled_clip(clip, save(tmp_path, [SHAPE] * FRAMES), ROWS)
    assert found.points.shape == (FRAMES, len(ROWS), 2)


def spoilt(t, i, value):
    points = np.stack([SHAPE] * FRAMES)
    points[t, i] = value
    return points


@pytest.mark.parametrize(
    ("points", "says"),
    [
        (
            spoilt(2, ROWS[5], (-1, 9)),
            r"frame 2: landmark at \(-1\.0, 9\.0\) is outside .* 64 x 48",
        ),
        (spoilt(1, ROWS[5], (9, 47.5)), r"frame 1: .* is outside the picture"),
        (spoilt(1, 0, (np.nan, 9)), "must hold finite numbers"),
        ([SHAPE] * 3, r"must hold points of shape \(4, 103 or more, 2\), has \(3, 103, 2\)"),
        ([SHAPE[:60]] * 4, r"\(4, 103 or more, 2\), has \(4, 60, 2\)"),
        ([np.stack([SHAPE[:, 0], SHAPE[:, 0]], 1)] * 4, "frame 0: the landmarks lie on one line"),
    ],
)
def test_landmarks_that_cannot_be_right_are_named(clip, tmp_path, points, says):
    save(tmp_path, points)
    with pytest.raises(InputError, match=says) as caught:
        read_labelled_clip(clip, tmp_path, ROWS)
    assert str(tmp_path / "a b.npz") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_landmarks_that_are_not_used_may_lie_anywhere(clip, tmp_path):
    unused = min(set(range(103)) - set(ROWS))
    assert read_labelled_clip(clip, save(tmp_path, spoilt(0, unused, -9)), ROWS).is_complete


def test_missing_landmarks_are_named(clip, tmp_path):
    with pytest.raises(InputError, match=r"a b\.npz: no landmarks of .*give --landmarks DIR"):
        read_labelled_clip(clip, tmp_path / "elsewhere", ROWS)


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ("nothing", "is not JSON"),
        ("[1]", "is no file of landmarks"),
        (by_hand(0, format="other"), "is no file of landmarks"),
        (by_hand(0, version=2), "has version 2, this mmmgpu reads 1"),
        (by_hand(), "none"),
        (by_hand(0, 0), "one frame twice"),
        (by_hand(4), "frame 4 where the clip has 4"),
        (by_hand(-1), "frame -1"),
        (by_hand("1"), "frame '1'"),
        (by_hand(0, points=SHAPE[:5, :1]), "not finite pairs"),
        (by_hand(0, points=np.full((5, 2), np.nan)), "not finite pairs"),
        (by_hand(0, frames=[{"frame": 0}]), "points"),
        (by_hand(0, frames=[3]), "must list frames"),
        (by_hand(0, frames=None), "must list frames"),
        (by_hand(0, points=SHAPE[:2]), "has 2 landmarks a frame, 3 are needed"),
    ],
)
def test_files_by_hand_that_cannot_be_used_are_named(clip, tmp_path, value, says):
    save_json(tmp_path, value)
    with pytest.raises(InputError, match=says) as caught:
        read_labelled_clip(clip, tmp_path, None)
    assert str(tmp_path / "a b.json") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_frames_by_hand_must_have_one_number_of_points(clip, tmp_path):
    value = by_hand(0, 1)
    value["frames"][1]["points"].pop()
    save_json(tmp_path, value)
    with pytest.raises(InputError, match=r"a b\.json: must list frames with their points"):
        read_labelled_clip(clip, tmp_path, None)


def test_a_row_that_hand_labels_lack_is_said(clip, tmp_path):
    save_json(tmp_path, by_hand(0))
    with pytest.raises(
        InputError, match=r"has 5 landmarks a frame, 103 are needed; .*--all-points"
    ):
        read_labelled_clip(clip, tmp_path, ROWS)


def test_clips_go_together(clip, tmp_path):
    other = encode(tmp_path / "c.mkv", grey_levels(FRAMES))
    save(save(tmp_path, [SHAPE[:50]] * 4), [SHAPE[:51]] * 4, "c")
    with pytest.raises(InputError, match=r"c\.mkv: has 51 landmarks a frame, .*a b\.mkv has 50"):
        read_labelled_clips([clip, other], tmp_path, None)
    with pytest.raises(InputError, match="two clips are called a b"):
        read_labelled_clips([clip, tmp_path / "sub" / "a b.mp4"], tmp_path, None)
    with pytest.raises(InputError, match="no clip given"):
        read_labelled_clips([], tmp_path, None)


def test_what_does_not_speak_says_where_the_head_is():
    weights = dict(zip(ROWS, steadiness(ROWS, len(ROWS)), strict=True))
    assert {row for row, weight in weights.items() if weight == 1} == {
        *(42, 44, 56, 58),
        *(68, 69, 70, 71, 72),
        *(87, 88),
    }
    assert max(weights[row] for row in (0, 10, 25, 50, 102)) < 0.1


@pytest.mark.parametrize("rows", [None, (0, 5, 10, 68, 71)])
def test_points_of_which_too_little_is_known_weigh_the_same(rows):
    assert_array_equal(steadiness(rows, 5), np.ones(5))
