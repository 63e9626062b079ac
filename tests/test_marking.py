import json

import numpy as np
import pytest
from marked import pair_of, shown_frames, true_landmarks

from mmmgpu.correspondence import rbf_correspondence
from mmmgpu.errors import InputError
from mmmgpu.marking import (
    LANDMARK_ROWS,
    NAMES,
    Session,
    StaleError,
    folded_points,
    propose,
    template,
    warped_onto,
)
from mmmgpu.points import APART, read_points, write_points
from mmmgpu.reference_pairs import ShownFrame

KINDS = ("closed", "open")


@pytest.fixture
def out(tmp_path):
    return tmp_path / "ann ben.json"


@pytest.fixture
def session(out):
    return Session(out, shown_frames())


def points_of(session, kind):
    """The points of one kind, as the page gets them."""
    return next(p["points"] for p in session.describe()["pairs"] if p["kind"] == kind)


def put(session, kind, points):
    return session.replace(kind, points, session.describe()["revision"])


def moved(session, kind, index, side, place):
    points = points_of(session, kind)
    points[index][side] = place
    return points


def grid_pair(places_a, places_b):
    names = [f"p_{i}" for i in range(len(places_a))]
    return pair_of("closed", places_a, places_b, names)


GRID = np.array([[x, y] for y in (30, 70, 110) for x in (30, 70, 110)], float)


@pytest.mark.parametrize("kind", KINDS)
def test_template_is_38_points_the_same_on_both_sides(kind):
    points = dict(zip(NAMES, template(kind), strict=True))
    assert len(points) == len(set(LANDMARK_ROWS)) == 38
    mirrored = {(-x, y) for x, y in points.values()}
    assert mirrored == {(x, y) for x, y in points.values()}
    assert min(y for _, y in points.values()) > -1  # below the eyes
    width = points["outer_lip_7"] - points["outer_lip_1"]
    assert width.tolist() == [1, 0]


@pytest.mark.parametrize("kind", KINDS)
def test_no_two_points_of_the_template_meet_in_a_small_mouth(kind):
    points = 20 * template(kind)
    distance = np.linalg.norm(points[:, None] - points, axis=-1) + 99 * np.eye(38)
    assert distance.min() > 5 * APART


@pytest.mark.parametrize("kind", KINDS)
def test_proposal_lies_near_the_true_points(kind):
    shown = shown_frames()[kind]
    proposed = propose(kind, *shown)
    assert [p.name for p in proposed] == list(NAMES)
    places = [[p.a for p in proposed], [p.b for p in proposed]]
    for at, true, frame in zip(places, true_landmarks(kind), shown, strict=True):
        distance = np.linalg.norm(np.array(at) - true[list(LANDMARK_ROWS)], axis=1)
        assert distance.mean() < 0.12 * frame.mouth[2]
        assert distance.max() < 0.32 * frame.mouth[2]


def test_each_template_fits_the_lips_it_is_for_better():
    lips = slice(NAMES.index("outer_lip_1"), NAMES.index("inner_lip_7") + 1)
    for kind, other in (KINDS, KINDS[::-1]):
        shown, true = shown_frames()[kind], true_landmarks(kind)[0][[*LANDMARK_ROWS]][lips]
        places = [np.array([p.a for p in propose(k, *shown)])[lips] for k in (kind, other)]
        own, others = (np.linalg.norm(place - true) for place in places)
        assert own < 0.5 * others


def test_points_outside_either_picture_are_not_proposed():
    a, b = shown_frames()["closed"]
    _, y, width = a.mouth
    cut = ShownFrame(b.clip, 0, a.picture[: round(y + 0.7 * width)], a.mouth)
    for pair in ((a, cut), (cut, a)):
        names = {p.name for p in propose("closed", *pair)}
        assert set(NAMES) - names == {"jaw_4", "jaw_5", "jaw_6"}
    assert propose("closed", a, ShownFrame("c", 0, a.picture, (-9999.0, y, width))) == []


def test_session_begins_with_the_proposals(session, out):
    state = session.describe()
    assert (state["out"], state["saved"], state["revision"]) == (str(out), False, 0)
    assert [pair["kind"] for pair in state["pairs"]] == list(KINDS)
    for pair in state["pairs"]:
        assert [p["name"] for p in pair["points"]] == list(NAMES)
        assert pair["points"] == pair["proposal"]
        assert pair["problems"] == []
        assert pair["b"] == {
            "clip": "person 11.mkv",
            "frame": 7 + KINDS.index(pair["kind"]),
            "size": [192, 176],
        }
    json.dumps(state, allow_nan=False)
    assert list(out.parent.iterdir()) == []


def test_what_is_saved_is_what_was_marked(session, out):
    points = moved(session, "closed", 3, "b", [81.25, 90.5])
    state = put(session, "closed", points)
    assert state == {"revision": 1, "saved": False, "problems": []}
    assert session.save() == {"revision": 1, "saved": True}
    closed, opened = read_points(out)
    assert closed.points_b[3].tolist() == [81.25, 90.5]
    assert closed.names == opened.names == NAMES
    np.testing.assert_array_equal(opened.points_a, [p["a"] for p in points_of(session, "open")])
    assert list(out.parent.iterdir()) == [out]


def test_a_file_is_opened_again(session, out):
    put(session, "open", points_of(session, "open")[:5])
    session.save()
    again = Session(out, shown_frames())
    assert again.saved
    assert points_of(again, "open") == points_of(session, "open")
    assert points_of(again, "closed") == points_of(session, "closed")
    assert len(again.describe()["pairs"][1]["proposal"]) == 38


def test_what_was_not_saved_comes_back(session, out):
    session.save()
    points = moved(session, "closed", 0, "a", None)
    put(session, "closed", points)
    put(session, "open", [])
    again = Session(out, shown_frames())
    assert not again.saved
    assert points_of(again, "closed") == points
    assert points_of(again, "open") == []
    put(again, "closed", points[1:])
    again.save()
    assert list(out.parent.iterdir()) == [out]
    assert len(read_points(out)[0].names) == 37


def other_frames():
    a, b = shown_frames()["closed"]
    other = ShownFrame(b.clip, b.frame, b.picture[::-1].copy(), b.mouth)
    return {**shown_frames(), "closed": (a, other)}


def test_files_of_other_frames_are_refused_and_kept(session, out):
    session.save()
    before = out.read_bytes()
    with pytest.raises(InputError, match="the closed pair, side b: marked in another picture"):
        Session(out, other_frames())
    put(session, "open", [])
    with pytest.raises(InputError, match=r"\.part: holds unsaved points of other frames") as error:
        Session(out, other_frames())
    assert len(str(error.value).splitlines()) == 1
    assert out.read_bytes() == before
    assert session.draft.exists()


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"frames": {}, "points": {"closed": 3}}'])
def test_broken_draft_is_refused(session, out, text):
    session.draft.write_text(text)
    with pytest.raises(InputError, match=r"\.part: cannot be read .*remove this file"):
        Session(out, shown_frames())


def test_broken_file_is_refused_and_kept(out):
    out.write_text("{")
    with pytest.raises(InputError, match="is not JSON"):
        Session(out, shown_frames())
    assert out.read_text() == "{"


@pytest.mark.parametrize(
    ("index", "side", "place", "words", "at_fault"),
    [
        (0, "b", None, ["'nose_1' is unpaired: only in A, not in B"], "nose_1"),
        (1, "a", None, ["'nose_2' is unpaired: only in B, not in A"], "nose_2"),
        (2, "a", [-1, 5], ["side a", "'nose_3'", "outside"], None),
        (2, "b", [192, 5], ["side b", "'nose_3'", "outside"], None),
    ],
)
def test_impossible_points_are_kept_but_not_saved(
    session, out, index, side, place, words, at_fault
):
    session.save()
    before = out.read_bytes()
    state = put(session, "open", moved(session, "open", index, side, place))
    (problem,) = state["problems"]
    assert [word for word in words if word not in problem["text"]] == []
    assert str(out) not in problem["text"]
    assert problem["point"] == at_fault
    with pytest.raises(InputError, match=problem["text"].split("'")[1]):
        session.save()
    assert not session.saved
    assert out.read_bytes() == before


def test_every_unpaired_point_is_a_problem(session):
    points = points_of(session, "closed")
    points[4]["a"] = points[9]["b"] = points[11]["a"] = points[11]["b"] = None
    problems = put(session, "closed", points)["problems"]
    assert [p["point"] for p in problems] == ["nose_5", "outer_lip_5", "outer_lip_7"]


def test_duplicates_and_few_points_are_problems(session):
    points = points_of(session, "closed")
    points[1]["a"] = points[0]["a"]
    assert "duplicates" in put(session, "closed", points)["problems"][0]["text"]
    assert "has 2 points" in put(session, "closed", points[1:3])["problems"][0]["text"]
    assert "has 0 points" in put(session, "closed", [])["problems"][0]["text"]


def test_points_that_determine_no_sound_map_are_a_problem(session):
    """Such as `transfer` would refuse: some all but in one place among points far apart."""
    points = points_of(session, "closed")
    x, y = points[0]["a"]
    for i in range(1, 9):
        place = [x + 0.15 * (i % 3), y + 0.15 * (i // 3)]
        points.append({"name": f"near_{i}", "a": place, "b": [10.0 + i, 10.0 + i % 4]})
    at = [[p[side] for p in points] for side in "ab"]
    with pytest.raises(InputError) as error:
        rbf_correspondence(*at)
    (problem,) = put(session, "closed", points)["problems"]
    assert str(error.value) in problem["text"]


def test_an_open_pair_without_points_is_left_out(session, out):
    assert put(session, "open", [])["problems"] == []
    session.save()
    assert [pair.kind for pair in read_points(out)] == ["closed"]
    assert points_of(Session(out, shown_frames()), "open") == []


def test_two_windows_cannot_overwrite_each_other(session):
    points = points_of(session, "closed")
    session.replace("closed", points[1:], 0)
    with pytest.raises(StaleError, match="another window"):
        session.replace("closed", points[2:], 0)
    assert points_of(session, "closed") == points[1:]
    assert session.describe()["revision"] == 1


def test_no_change_is_none(session):
    session.save()
    assert put(session, "closed", points_of(session, "closed"))["revision"] == 0
    assert session.saved
    assert not session.draft.exists()


@pytest.mark.parametrize(
    "points", [None, {}, [3], [{"name": "x", "a": [1], "b": None}], [{"name": "", "a": None}]]
)
def test_what_is_no_list_of_points_changes_nothing(session, points):
    before = session.describe()
    with pytest.raises(InputError):
        put(session, "closed", points)
    assert session.describe() == before


def test_equal_points_carry_the_picture_onto_itself():
    a, _ = shown_frames()["closed"]
    pair = grid_pair(GRID, GRID)
    seen = warped_onto(pair, a.picture)
    height, width = a.picture.shape[:2]
    assert seen.shape == (176, 192, 3)
    np.testing.assert_array_equal(seen[:height, :width], a.picture)
    assert not seen[height:].any()
    assert not seen[:, width:].any()


def test_warped_picture_shows_a_at_the_place_of_its_partner():
    """Against S itself: what A shows at p is shown at S(p)."""
    pair = grid_pair(GRID, 1.1 * GRID + np.array([4, 2]) + 2 * np.sin(GRID[:, ::-1]))
    rows, columns = np.mgrid[:160, :144]
    picture = np.stack([columns, rows, rows + columns], axis=-1).astype(np.float32) * 0.8
    seen = warped_onto(pair, np.round(picture).astype(np.uint8)).astype(float)
    inside = np.array([[x, y] for y in range(35, 106, 10) for x in range(35, 106, 10)])
    partners = np.rint(rbf_correspondence(pair.points_a, pair.points_b)(inside)).astype(int)
    found = seen[partners[:, 1], partners[:, 0], :2] / 0.8
    assert np.abs(found - inside).max() < 1.2  # half a pixel of B, and the rounding of colours
    np.testing.assert_allclose((found - inside).mean(axis=0), 0, atol=0.25)


def test_crossed_points_fold():
    crossed = GRID.copy()
    crossed[[3, 4]] = GRID[[4, 3]]
    assert folded_points(grid_pair(GRID, GRID)) == []
    named = folded_points(grid_pair(GRID, crossed))
    assert {"p_3", "p_4"} <= set(named)
    assert set(named).isdisjoint({"p_2", "p_5", "p_8"})


def test_saved_file_is_one_that_write_points_would_write(session, out, tmp_path):
    session.save()
    copy = tmp_path / "copy.json"
    write_points(copy, [session.pair(kind) for kind in KINDS])
    assert copy.read_bytes() == out.read_bytes()
