"""mark, transfer and adapt as commands, and the other commands on what they make."""

import json

import pytest
from commands import assert_refused, run_command

from mmmgpu.model_files import load
from mmmgpu.points import read_points
from mmmgpu.reference_pairs import source_references
from mmmgpu.videos import probe

pytestmark = pytest.mark.usefixtures("kept")


@pytest.fixture
def mmmgpu(capfd):
    return lambda *args: run_command(capfd, *args)


@pytest.fixture(scope="module")
def made(two_persons, tmp_path_factory):
    """The folder in which the first tests leave their models."""
    return tmp_path_factory.mktemp("made ü")


def clips_and_alignments(two_persons):
    second = two_persons.second
    return (*second.clips, "--alignments", second.alignments)


def test_marking_from_landmarks(mmmgpu, world, two_persons, made):
    points, second = made / "points.json", two_persons.second
    folders = (world.alignments, second.alignments)
    ended = mmmgpu(
        "mark", two_persons.source, *second.clips, "--out", points, "--landmarks", *folders
    )
    assert (ended.status, ended.out) == (0, f"{points}\n")
    assert points.read_bytes() == two_persons.points.read_bytes()


def test_marking_in_a_given_frame(mmmgpu, world, two_persons, tmp_path):
    points, second = tmp_path / "points.json", two_persons.second
    ended = mmmgpu(
        *("mark", two_persons.source, *second.clips, "--out", points),
        *("--closed", f"{second.clips[1].name}:3"),
        *("--landmarks", world.alignments, second.alignments),
    )
    assert ended.status == 0
    closed = next(pair for pair in read_points(points) if pair.kind == "closed")
    assert (closed.b.clip, closed.b.frame) == (second.clips[1].name, 3)
    shown = source_references(load(two_persons.source))["closed"]
    assert (closed.a.clip, closed.a.frame) == (shown.clip, shown.frame)


@pytest.mark.parametrize("frame", ["other.mkv:3", "clip 0.mkv:5000"])
def test_a_frame_that_is_not_there_is_refused(mmmgpu, two_persons, tmp_path, frame):
    ended = mmmgpu(
        *("mark", two_persons.source, *two_persons.second.clips),
        *("--out", tmp_path / "p.json", "--open", frame),
    )
    assert_refused(ended, f"{frame}: no such frame", "clip 0.mkv")
    assert list(tmp_path.iterdir()) == []


def test_transfer_and_adapt(mmmgpu, two_persons, made):
    given = clips_and_alignments(two_persons)
    ended = mmmgpu(
        *("transfer", two_persons.source, *given, "--points", two_persons.points),
        *("--out", made / "b.mmm", "--report", made / "b.html", "--json", made / "b.json"),
    )
    assert ended.status == 0
    assert "matching" in ended.out
    assert "open: " in (made / "b.html").read_text()
    facts = json.loads((made / "b.json").read_text())
    assert len(facts["notes"]["matching"]["history"][0]) == 6

    ended = mmmgpu(
        *("adapt", made / "b.mmm", *given, "--out", made / "a.mmm"),
        *("--report", made / "a.html", "--json", made / "a.json", "--source", two_persons.source),
    )
    assert ended.status == 0
    assert "frames per phone without silence" in ended.out
    assert "AA, first person" in (made / "a.html").read_text()
    facts = json.loads((made / "a.json").read_text())
    assert facts["notes"]["adaptation"]["method"] == "gdlr"


@pytest.mark.parametrize("name", ["b.mmm", "a.mmm"])
def test_the_other_commands_work_on_the_results(mmmgpu, two_persons, made, tmp_path, name):
    second = two_persons.second
    clip = second.clips[0]
    assert mmmgpu("info", made / name).status == 0
    ended = mmmgpu(
        *("speak", made / name, "--audio", clip, "--alignment", clip.with_suffix(".TextGrid")),
        *("--out", tmp_path / "s.mkv", "--lossless"),
    )
    assert ended.status == 0
    assert probe(tmp_path / "s.mkv").frames == probe(clip).frames
    ended = mmmgpu("reconstruct", made / name, clip, "--out", tmp_path / "r.mkv", "--lossless")
    assert ended.status == 0
    ended = mmmgpu(
        *("evaluate", made / name, clip, "--alignments", second.alignments, "--pictures"),
        *("--landmarks", second.alignments, "--json", tmp_path / "e.json"),
        *("--report", tmp_path / "e.html"),
    )
    assert ended.status == 0
    assert "Errors" in (tmp_path / "e.html").read_text()
    found = json.loads((tmp_path / "e.json").read_text())
    others = {"map", "mllr", "shift"} if name == "a.mmm" else set()
    assert set(found["alpha"]["all"]["rms"]) == {"pooled", "trained"} | others
    assert found["mouth_psnr_db_speech"]["trained"]["mean"] > 15


def test_points_that_cannot_be_read_are_refused(mmmgpu, two_persons, tmp_path):
    given = clips_and_alignments(two_persons)
    for name, text in (("none.json", None), ("empty.json", ""), ("other.json", "{}")):
        points = tmp_path / name
        if text is not None:
            points.write_text(text)
        ended = mmmgpu(
            *("transfer", two_persons.source, *given, "--points", points),
            *("--out", tmp_path / "m.mmm"),
        )
        assert_refused(ended, points)
    assert {p.name for p in tmp_path.iterdir()} == {"empty.json", "other.json"}


def test_unknown_choices_are_refused(mmmgpu, two_persons, made, tmp_path):
    given = clips_and_alignments(two_persons)
    ended = mmmgpu("adapt", made / "b.mmm", *given, "--out", tmp_path / "m.mmm", "--method", "x")
    assert_refused(ended, "method: must be one of none, shift, map, mllr, gdlr")
    assert list(tmp_path.iterdir()) == []
