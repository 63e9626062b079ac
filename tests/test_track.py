"""The command ``mmmgpu track``."""

import json

import numpy as np
import pytest
from commands import assert_refused, run_command

from mmmgpu.aam_files import save_aam


@pytest.fixture
def mmmgpu(capfd):
    return lambda *args: run_command(capfd, *args)


@pytest.fixture(scope="module")
def model(drawn, tmp_path_factory):
    path = tmp_path_factory.mktemp("aam") / "ann.aam"
    save_aam(drawn.aam, path)
    return path


def test_track_from_a_box(mmmgpu, drawn, model, tmp_path):
    truth = drawn.points(drawn.held_out)
    low, high = truth[0].min(axis=0), truth[0].max(axis=0)
    box = ",".join(str(round(v)) for v in (*(low + 4), *(high - low)))
    out = tmp_path / "new" / "points"
    args = ("track", model, drawn.held_out, "--start", box, "--out", out)
    ended = mmmgpu(*args, "--json", tmp_path / "facts.json")
    assert ended.status == 0
    with np.load(out / f"{drawn.held_out.stem}.npz") as found:
        off = np.sqrt(((found["points"] - truth) ** 2).sum(axis=2).mean(axis=1))
        assert np.median(off) < 1
        assert found["features"].shape == (len(truth), len(drawn.aam.variance))
    (facts,) = json.loads((tmp_path / "facts.json").read_text())["clips"]
    assert facts["frames"] == len(truth)
    assert 0 < facts["residual"] < facts["worst_residual"] < 0.2
    assert "unsettled" in ended.out


def test_track_from_one_labelled_frame(mmmgpu, drawn, model, tmp_path):
    with np.load(drawn.folder / f"{drawn.held_out.stem}.npz") as arrays:
        points = arrays["points"]
    listed = [{"frame": 7, "points": points[7].tolist()}]
    value = {"format": "mmmgpu-landmarks", "version": 1, "frames": listed}
    (tmp_path / f"{drawn.held_out.stem}.json").write_text(json.dumps(value))
    args = ("track", model, drawn.held_out, "--start", tmp_path, "--out")
    assert_refused(mmmgpu(*args, tmp_path), "would replace the starts")
    assert mmmgpu(*args, tmp_path / "points").status == 0
    with np.load(tmp_path / "points" / f"{drawn.held_out.stem}.npz") as found:
        truth = points[:, list(drawn.aam.rows)]
        off = np.sqrt(((found["points"] - truth) ** 2).sum(axis=2).mean(axis=1))
    assert np.median(off) < 1


def test_what_cannot_be_tracked_is_refused(mmmgpu, drawn, model, tmp_path):
    args = ("track", model, drawn.held_out, "--out", tmp_path / "points", "--start")
    ended = mmmgpu(*args, "about there")
    assert ended.status == 2
    assert "Invalid value for --start: 'about there' must be four whole numbers" in ended.err
    assert_refused(mmmgpu(*args, "900,900,50,50"), drawn.held_out, "outside the picture")
    assert_refused(mmmgpu(*args, tmp_path), "no landmarks of")
    assert not list(tmp_path.rglob("*.npz"))
