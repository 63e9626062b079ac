"""The command ``aam``, and ``info`` of what it writes."""

import json

import numpy as np
import pytest
from commands import assert_refused, run_command

from mmmgpu.aam_files import load_aam, save_aam
from mmmgpu.files import require_folder


@pytest.fixture
def out(tmp_path):
    """A folder for results, which a refusal must leave empty."""
    return require_folder(tmp_path / "out")


@pytest.fixture
def aam(capfd, drawn):
    """Run ``mmmgpu aam``, on the first clip with its landmarks where nothing else is given."""

    def run(*more, clips=(drawn.clips[0],), landmarks=drawn.folder):
        return run_command(capfd, "aam", *clips, "--landmarks", landmarks, *more)

    return run


def spoilt(drawn, folder, change):
    """The folder with landmarks of the first clip as `change` makes them."""
    name = f"{drawn.clips[0].stem}.npz"
    with np.load(drawn.folder / name) as arrays:
        points = change(arrays["points"].copy())
    np.savez(folder / name, points=points)
    return folder


def test_a_model_its_numbers_and_its_report_are_written(aam, drawn, out):
    ended = aam(
        *("--out", out / "a.aam", "--parameters", 6, "--frames", 30, "--test", drawn.held_out),
        *("--json", out / "a.json", "--report", out / "a.html"),
        clips=(*drawn.clips[:1], drawn.held_out),
    )
    assert ended.status == 0
    facts = json.loads((out / "a.json").read_text())
    assert facts["parameters"] == len(load_aam(out / "a.aam").variance) == 6
    assert facts["notes"]["clips"] == [drawn.clips[0].name]  # what judges was not learned from
    assert facts["notes"]["frames"] == 30
    assert facts["test"]["clips"] == [drawn.held_out.name]
    assert "6, with" in ended.out
    assert "converged" in ended.out
    assert "On clips that were not learned from" in (out / "a.html").read_text()


def test_a_share_of_the_variance_may_be_asked_for(aam, out):
    assert aam("--out", out / "a.aam", "--variance", 0.8, "--frames", 30).status == 0
    model = load_aam(out / "a.aam")
    assert 0.8 <= model.share < 1


def test_all_points_may_be_used(aam, drawn, out, tmp_path):
    spoilt(drawn, tmp_path, lambda points: points[:, [0, 5, 10, 15, 42, 50, 58, 68, 87, 88]])
    more = ("--out", out / "a.aam", "--parameters", 3)
    assert_refused(aam(*more, landmarks=tmp_path), "must hold points of shape (45, 103 or more, 2)")
    assert aam(*more, "--all-points", landmarks=tmp_path).status == 0
    assert len(load_aam(out / "a.aam").mesh.vertices) == 10


def test_info_shows_what_a_model_holds(capfd, drawn, tmp_path):
    save_aam(drawn.aam, tmp_path / "a.aam")
    ended = run_command(capfd, "info", tmp_path / "a.aam", "--json", tmp_path / "a.json")
    assert ended.status == 0
    assert "10, with" in ended.out
    facts = json.loads((tmp_path / "a.json").read_text())
    assert facts["points"] == 38
    assert facts["format_version"] == 1
    assert len(facts["variance_of_parameters"]) == 10


def test_info_refuses_a_truncated_model(capfd, drawn, tmp_path):
    path = tmp_path / "a.aam"
    save_aam(drawn.aam, path)
    path.write_bytes(path.read_bytes()[:-9])
    assert_refused(run_command(capfd, "info", path), path, "truncated")


def outside(points):
    points[7, 50] = (400, 20)
    return points


def turned_over(points):
    points[7, [49, 50, 51], 1] -= 60
    return points


def not_a_number(points):
    points[7, 50] = np.nan
    return points


BAD = {
    "outside": (outside, "frame 7", "outside the picture of 144 x 160"),
    "turned over": (turned_over, "frame 7", "turned over"),
    "NaN": (not_a_number, "finite numbers", ""),
    "too short": (lambda points: points[:-1], "(45, 103 or more, 2)", "has (44, 103, 2)"),
    "too few points": (lambda points: points[:, :50], "(45, 103 or more, 2)", ""),
}


@pytest.mark.parametrize("fault", BAD)
def test_landmarks_that_cannot_be_right_are_one_line(aam, drawn, out, tmp_path, fault):
    change, *words = BAD[fault]
    folder = spoilt(drawn, tmp_path, change)
    ended = aam("--out", out / "a.aam", "--parameters", 3, landmarks=folder)
    assert_refused(ended, "clip 0", *words)
    assert list(out.iterdir()) == []


def test_missing_landmarks_are_one_line(aam, out, tmp_path):
    ended = aam("--out", out / "a.aam", landmarks=tmp_path)
    assert_refused(ended, "clip 0.npz", "no landmarks", "give --landmarks DIR")
    assert list(out.iterdir()) == []


def test_too_few_frames_are_one_line(aam, out):
    ended = aam("--out", out / "a.aam", "--parameters", 45)
    assert_refused(ended, "45 labelled frame(s) are too few for 45 parameters", "give more clips")
    assert list(out.iterdir()) == []


def test_a_test_clip_without_landmarks_is_refused_before_the_work(aam, world, out, tmp_path):
    (tmp_path / "b.mkv").write_bytes(world.clips[1].read_bytes())
    ended = aam("--out", out / "a.aam", "--test", tmp_path / "b.mkv")
    assert_refused(ended, "b.npz", "no landmarks")
    assert list(out.iterdir()) == []


def test_nothing_left_to_learn_from_is_said(aam, drawn, out):
    ended = aam("--out", out / "a.aam", "--test", drawn.clips[0])
    assert_refused(ended, "no clip given")


def test_the_clip_is_never_replaced(aam, drawn):
    before = drawn.clips[0].read_bytes()
    assert_refused(aam("--out", drawn.clips[0]), "would replace what is read")
    assert drawn.clips[0].read_bytes() == before
