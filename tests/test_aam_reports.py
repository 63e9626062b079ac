import re

import pytest

from mmmgpu.aam_reports import FRAMES_SHOWN, MODES_SHOWN, write_aam_report
from mmmgpu.errors import InputError

TEST = {
    "clips": ["a.mkv", "b.mkv"],
    "away_px": 5.0,
    "frames": 90,
    "psnr_db": {"mean": 41.25, "half_width_95": 0.5},
    "psnr_of_worst_frame_db": 33.3,
    "points_of_features_px": 0.12,
    "landmark_jitter_px": 0.41,
    "fit_px": {"median": 0.52, "95_percent_within": 0.9, "worst": 1.9},
    "within_1_px": 0.93,
    "converged": 0.968,
}


@pytest.fixture(scope="module")
def page(drawn, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "r.html"
    write_aam_report(drawn.aam, path, clip=drawn.held_out, landmarks=drawn.folder, test=TEST)
    return path.read_text()


def test_the_page_needs_no_other_file(page):
    assert page.startswith("<!doctype html>")
    assert not re.findall(r'(?:src|href)="(?!data:)', page)


def test_landmarks_frames_and_modes_are_shown(page):
    assert page.count("<img ") == 1 + FRAMES_SHOWN + MODES_SHOWN
    for said in ("clip 3.mkv and its landmarks", "real above, rebuilt below", "Feature 6: "):
        assert said in page


def test_numbers_of_the_test_are_shown(page):
    for said in ("41.2 dB", "33.3 dB", "0.41 px", "0.52 px (median)", "96.8 %", "2, 90"):
        assert said in page


def test_every_picture_is_described(page):
    assert all(re.search(r'alt="[^"]+', img) for img in re.findall(r"<img [^>]*>", page))


def test_without_a_test_none_is_spoken_of(drawn, tmp_path):
    write_aam_report(drawn.aam, tmp_path / "r.html", clip=drawn.clips[0], landmarks=drawn.folder)
    assert "not learned from" not in (tmp_path / "r.html").read_text()


def test_a_clip_without_landmarks_is_refused(drawn, tmp_path):
    with pytest.raises(InputError, match="no landmarks of"):
        write_aam_report(drawn.aam, tmp_path / "r.html", clip=drawn.held_out, landmarks=tmp_path)
    assert list(tmp_path.iterdir()) == []
