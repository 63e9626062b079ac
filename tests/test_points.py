import copy
import hashlib
import json

import numpy as np
import pytest
from marked import pair_of, shown_frames

from mmmgpu.errors import InputError
from mmmgpu.points import (
    FEWEST,
    MOST,
    FrameMark,
    check_frames,
    fingerprint_frame,
    mark_of,
    read_points,
    write_points,
)

POINTS_A = [[10.0, 12.0], [40.25, 12.5], [25.0, 50.0], [26.0, 70.125]]
POINTS_B = [[20.0, 22.0], [70.25, 22.5], [45.0, 90.0], [46.0, 110.0]]


@pytest.fixture
def pairs():
    return tuple(pair_of(kind, POINTS_A, POINTS_B) for kind in ("closed", "open"))


@pytest.fixture
def pictures():
    return {kind: tuple(s.picture for s in shown) for kind, shown in shown_frames().items()}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "points.json"


def by_hand():
    """A file as another tool may write it: the plain schema of docs/points.md."""
    marks = {
        "a": {"clip": "ann 012.mp4", "frame": 31, "fingerprint": "0f" * 16, "size": [60, 80]},
        "b": {"clip": "ben.mov", "frame": 0, "fingerprint": "1e" * 16, "size": [100, 120]},
    }
    points = [
        {"name": f"p_{i}", "a": a, "b": b}
        for i, (a, b) in enumerate(zip(POINTS_A, POINTS_B, strict=True))
    ]
    pair = {"kind": "closed", **marks, "points": points}
    return {"format": "mmmgpu-points", "version": 1, "pairs": [pair]}


def refusal(path, value):
    """The one line with which the JSON `value` is refused."""
    path.write_text(value if isinstance(value, str) else json.dumps(value))
    with pytest.raises(InputError) as error:
        read_points(path)
    (line,) = str(error.value).splitlines()
    assert line.startswith(f"{path}: ")
    return line


def test_what_is_written_is_read(path, pairs):
    write_points(path, pairs[::-1])
    found = read_points(path)
    assert [pair.kind for pair in found] == ["closed", "open"]
    for pair, wanted in zip(found, pairs, strict=True):
        assert (pair.a, pair.b, pair.names) == (wanted.a, wanted.b, wanted.names)
        np.testing.assert_array_equal(pair.points_a, POINTS_A)
        np.testing.assert_array_equal(pair.points_b, POINTS_B)


def test_a_file_of_another_tool_is_read(path):
    value = by_hand()
    value["made by"] = "another tool"
    value["pairs"][0]["points"][0]["a"] = [10, 12]
    path.write_text("\ufeff" + json.dumps(value))
    (pair,) = read_points(path)
    assert pair.a == FrameMark("ann 012.mp4", 31, "0f" * 16, (60, 80))
    assert pair.names == ("p_0", "p_1", "p_2", "p_3")
    assert pair.points_a.dtype == np.float64
    np.testing.assert_array_equal(pair.points_b, POINTS_B)


def test_the_written_file_is_the_plain_schema(path):
    value = by_hand()
    path.write_text(json.dumps(value))
    write_points(path, read_points(path))
    assert json.loads(path.read_text()) == value


def test_fingerprint_is_of_size_and_pixels():
    picture = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    wanted = hashlib.sha256(b"3x2:" + bytes(range(18))).hexdigest()[:32]
    assert fingerprint_frame(picture) == wanted
    assert fingerprint_frame(np.asfortranarray(picture)) == wanted
    assert fingerprint_frame(picture.reshape(3, 2, 3)) != wanted
    assert fingerprint_frame(picture + np.uint8(1)) != wanted
    assert mark_of("c.mkv", 4, picture) == FrameMark("c.mkv", 4, wanted, (3, 2))


def pair_with(**changes):
    value = by_hand()
    value["pairs"][0].update(changes)
    return value


def mark_with(side, **changes):
    value = by_hand()
    value["pairs"][0][side].update(changes)
    return value


def points_with(*points):
    """The closed pair with these (index, side, place) changed."""
    value = by_hand()
    for index, side, place in points:
        value["pairs"][0]["points"][index][side] = place
    return value


def without_side(side):
    value = by_hand()
    del value["pairs"][0]["points"][2][side]
    return value


def on_a_line(side):
    """Slanted, and off the line by less than the tolerance."""
    places = [[10 + 4 * i, 20 + 7 * i + 0.4 * (i % 2)] for i in range(4)]
    return points_with(*((i, side, place) for i, place in enumerate(places)))


BAD = {
    "no JSON": ("{", ["is not JSON"]),
    "deep": ("[" * 100_000, ["is not JSON"]),
    "no object": ([], ["is no file of points"]),
    "other format": ({"format": "x"}, ["is no file of points"]),
    "newer": ({**by_hand(), "version": 2}, ["version 2", "newer", "update mmmgpu"]),
    "version 0": ({**by_hand(), "version": 0}, ["version", "0"]),
    "version true": ({**by_hand(), "version": True}, ["version", "True"]),
    "pairs missing": ({"format": "mmmgpu-points", "version": 1}, ["pairs must be a list"]),
    "no pairs": ({**by_hand(), "pairs": []}, ["no closed pair"]),
    "pair is a number": ({**by_hand(), "pairs": [3]}, ["kind of a pair", "3"]),
    "only open": (pair_with(kind="open"), ["no closed pair"]),
    "twice": ({**by_hand(), "pairs": by_hand()["pairs"] * 2}, ["more than one closed pair"]),
    "unknown kind": (pair_with(kind="half"), ["'half'", "closed or open"]),
    "kind is a list": (pair_with(kind=["closed"]), ["closed or open"]),
    "no mark": (pair_with(b=None), ["the closed pair, b", "which frame"]),
    "clip is a number": (mark_with("a", clip=3), ["the closed pair, a: clip", "3"]),
    "clip without name": (mark_with("b", clip=""), ["the closed pair, b: clip"]),
    "frame before the first": (mark_with("a", frame=-1), ["frame", "-1"]),
    "frame is a fraction": (mark_with("a", frame=1.5), ["frame", "1.5"]),
    "frame is true": (mark_with("a", frame=True), ["frame", "True"]),
    "no fingerprint": (mark_with("b", fingerprint=None), ["fingerprint", "None"]),
    "size of one": (mark_with("b", size=[5]), ["size", "[5]"]),
    "size zero": (mark_with("b", size=[5, 0]), ["size", "[5, 0]"]),
    "size of fractions": (mark_with("a", size=[5.0, 7]), ["size"]),
    "points missing": (pair_with(points=None), ["points must be a list"]),
    "no points": (pair_with(points=[]), ["has 0 points", str(FEWEST)]),
    "two points": (pair_with(points=by_hand()["pairs"][0]["points"][:2]), ["has 2 points"]),
    "too many": (
        pair_with(points=[{"name": str(i), "a": [1, 1], "b": [1, 1]} for i in range(MOST + 1)]),
        [f"has {MOST + 1} points", f"at most {MOST}"],
    ),
    "point is a list": (pair_with(points=[[1, 2]] * 3), ["point 1 must have a name"]),
    "no name": (points_with((1, "name", None)), ["point 2 must have a name"]),
    "empty name": (points_with((1, "name", "")), ["point 2 must have a name"]),
    "name of two lines": (points_with((1, "name", "a\nb")), ["point 2 must have a name"]),
    "long name": (points_with((1, "name", "n" * 61)), ["point 2 must have a name"]),
    "one name twice": (points_with((1, "name", "p_0")), ["2 points are named 'p_0'"]),
    "only in a": (without_side("b"), ["'p_2' is unpaired: it has no b"]),
    "only in b": (without_side("a"), ["'p_2' is unpaired: it has no a"]),
    "null": (points_with((0, "a", None)), ["'p_0' is unpaired"]),
    "three numbers": (points_with((0, "a", [1, 2, 3])), ["'p_0', a", "two numbers"]),
    "text": (points_with((0, "b", ["1", "2"])), ["'p_0', b", "two numbers"]),
    "true": (points_with((0, "b", [True, 2])), ["'p_0', b", "two numbers"]),
    "NaN": (points_with((3, "b", [float("nan"), 2])), ["'p_3', b", "finite"]),
    "infinite": (points_with((3, "a", [5, float("inf")])), ["'p_3', a", "finite"]),
    "huge": (points_with((3, "a", [5, 10**400])), ["'p_3', a", "finite"]),
    "left of a": (points_with((1, "a", [-0.5, 3])), ["side a", "'p_1'", "outside", "60 x 80"]),
    "below b": (points_with((1, "b", [3, 119.5])), ["side b", "'p_1'", "outside", "100 x 120"]),
    "right of a": (points_with((1, "a", [59.01, 3])), ["side a", "'p_1'", "outside"]),
    "duplicates in a": (
        points_with((3, "a", [40.3, 12.5])),
        ["side a", "'p_1' and 'p_3'", "duplicates"],
    ),
    "duplicates in b": (points_with((2, "b", POINTS_B[0])), ["side b", "'p_0' and 'p_2'"]),
    "line in a": (on_a_line("a"), ["side a", "one line"]),
    "line in b": (on_a_line("b"), ["side b", "one line"]),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_file_is_refused(path, name):
    value, words = BAD[name]
    line = refusal(path, value)
    assert [word for word in words if word not in line] == []


def test_the_closed_pair_or_the_open_one_is_named(path):
    value = by_hand()
    value["pairs"].append(copy.deepcopy(value["pairs"][0]))
    value["pairs"][1]["kind"] = "open"
    path.write_text(json.dumps(value))
    assert len(read_points(path)) == 2
    value["pairs"][1]["points"][0]["a"] = None
    assert "the open pair" in refusal(path, value)


def test_edges_of_the_picture_are_inside(path):
    path.write_text(json.dumps(points_with((0, "a", [0, 0]), (1, "a", [59, 79]))))
    assert read_points(path)[0].points_a[:2].tolist() == [[0, 0], [59, 79]]


def test_three_points_and_nearly_a_line_are_enough(path):
    value = pair_with(points=by_hand()["pairs"][0]["points"][:3])
    value["pairs"][0]["points"][2]["a"] = [25.0, 14.1]
    path.write_text(json.dumps(value))
    assert len(read_points(path)[0].names) == 3


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda folder: folder / "none.json", ["cannot be read"]),
        (lambda folder: folder, ["cannot be read"]),
    ],
)
def test_unreadable_file_is_refused(tmp_path, make, words):
    place = make(tmp_path)
    with pytest.raises(InputError) as error:
        read_points(place)
    assert all(word in str(error.value) for word in [str(place), *words])


def test_binary_file_is_refused(path):
    path.write_bytes(b"\x89PNG\xff\xfe\x00")
    with pytest.raises(InputError, match="is not JSON"):
        read_points(path)


def test_impossible_pairs_are_not_written(path, pairs):
    write_points(path, pairs)
    before = path.read_bytes()
    straight = pair_of("closed", [[5, 5], [10, 10], [20, 20]], POINTS_B[:3])
    for bad, word in [
        ((straight,), "one line"),
        (pairs[1:], "no closed"),
        (pairs * 2, "more than"),
    ]:
        with pytest.raises(InputError, match=word):
            write_points(path, bad)
    nowhere = pair_of("closed", [*POINTS_A[:3], [np.nan, 4]], POINTS_B)
    with pytest.raises(InputError, match="'p_3' is not finite"):
        write_points(path, [nowhere])
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def test_the_frames_it_was_made_for_pass(path, pairs, pictures):
    check_frames(pairs, pictures, path)


@pytest.mark.parametrize("kind", ["closed", "open"])
@pytest.mark.parametrize("side", [0, 1])
def test_other_frames_are_refused(path, pairs, pictures, kind, side):
    changed = [picture.copy() for picture in pictures[kind]]
    changed[side][3, 4, 1] ^= 1
    with pytest.raises(InputError) as error:
        check_frames(pairs, {**pictures, kind: tuple(changed)}, path)
    (line,) = str(error.value).splitlines()
    clip = shown_frames()[kind][side].clip
    for word in [str(path), f"the {kind} pair, side {'ab'[side]}", clip, "fingerprint", "mark"]:
        assert word in line


def test_frames_of_another_size_are_refused(path, pairs, pictures):
    a, b = pictures["closed"]
    with pytest.raises(InputError, match=r"side b.*192 x 176.*has 191 x 176") as error:
        check_frames(pairs, {**pictures, "closed": (a, b[:, :-1])}, path)
    assert len(str(error.value).splitlines()) == 1
