import re
from base64 import b64decode
from dataclasses import replace
from fractions import Fraction
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
from commands import trained_model
from worlds import FPS

from mmmgpu.corpora import open_corpus
from mmmgpu.errors import InputError
from mmmgpu.evaluation import evaluate
from mmmgpu.landmarks import lip_opening, moved_landmarks
from mmmgpu.model_files import load
from mmmgpu.performer import landmarks
from mmmgpu.reconstruction import analyse_clip
from mmmgpu.report_parts import LARGEST_TILE
from mmmgpu.reports import _middles, _opening, write_report
from mmmgpu.speaking import plan
from mmmgpu.trajectory_files import Trajectory
from mmmgpu.video_writing import write_video

VOID = {"meta", "img", "br", "link", "use", "path"}


class Page(HTMLParser):
    """What a report holds: addresses, alternative texts, headings, and tags left open."""

    def __init__(self, text):
        super().__init__()
        self.addresses, self.alts, self.texts, self.open = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.addresses += [values[k] for k in ("src", "href", "poster") if k in values]
        if tag == "img":
            self.alts.append(values.get("alt"))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        pass

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)


def pictures(page):
    """All pictures of a page, decoded."""
    data = [a.split(",")[1] for a in page.addresses if a.startswith("data:image/")]
    return [cv2.imdecode(np.frombuffer(b64decode(d), np.uint8), cv2.IMREAD_COLOR) for d in data]


@pytest.fixture(scope="module")
def model(world):
    return load(trained_model(world))


@pytest.fixture(scope="module")
def held_out(world, model):
    (clip,) = open_corpus(world.clips[2:3], world.alignments)
    found = analyse_clip(model, clip.path)
    return Trajectory(tuple(clip.labels), found.alpha, found.beta, clip.info.fps)


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    path = tmp_path_factory.mktemp("film") / "a film & more.mp4"
    write_video(path, [np.full((32, 48, 3), 90, np.uint8)] * 3, fps=FPS)
    return path


@pytest.fixture(scope="module")
def full(world, model, held_out, film):
    (clip,) = open_corpus(world.clips[2:3], world.alignments)
    path = film.with_name("report.html")
    write_report(
        model,
        path,
        evaluation=evaluate(model, world.clips[2:], world.alignments),
        held_out=held_out,
        spoken=plan(model, clip.alignment),
        videos={"It says <hello>": film},
    )
    return path.read_text()


def test_a_report_holds_all_that_it_shows(full, film):
    page = Page(full)
    assert page.open == []
    outside = [a for a in page.addresses if not a.startswith(("data:", "#"))]
    assert outside == ["a film & more.mp4"]  # a link, nothing that is loaded
    assert not re.search(r"https?://(?!www\.w3\.org|purl\.org)", full.split("<body>")[0])
    assert "@import" not in full
    assert "url(http" not in full
    assert len(full) < 5_000_000


def test_every_picture_is_described_and_can_be_decoded(full, model):
    page = Page(full)
    assert None not in page.alts
    assert "" not in page.alts
    decoded = pictures(page)
    assert all(p is not None and p.size for p in decoded)
    assert sum("prototype" in alt and "frame" in alt for alt in page.alts) == len(model.sources)


def test_the_page_says_what_was_learned(full, model):
    said = " ".join(Page(full).texts)
    for heading in ("Videos", "prototypes", "Flows", "phone", "training", "Movement", "Errors"):
        assert heading in said
    for label, count in zip(model.alpha.trained.labels, model.alpha.trained.count, strict=True):
        assert f"{label} · {count}" in said
    assert "It says <hello>" in said
    assert f"{model.notes['frames']} (" in said


def test_a_model_alone_has_a_report(model, tmp_path):
    path = tmp_path / "only model.html"
    write_report(model, path, backend="numpy")
    page = Page(path.read_text())
    said = " ".join(page.texts)
    assert page.open == []
    assert "Errors" not in said
    assert "Videos" not in said
    assert len(pictures(page)) > len(model.sources)


def test_skipped_clips_are_told_with_the_reason(model, tmp_path):
    notes = {**model.notes, "skipped": {"bad <clip>.mp4": "no head & no mouth"}}
    path = tmp_path / "report.html"
    write_report(replace(model, notes=notes), path)
    assert "bad &lt;clip&gt;.mp4" in path.read_text()
    assert "bad <clip>.mp4: no head & no mouth" in "".join(Page(path.read_text()).texts)


def test_large_videos_are_linked_only(model, film, tmp_path, monkeypatch):
    monkeypatch.setattr("mmmgpu.report_parts.LARGEST_VIDEO", film.stat().st_size - 1)
    path = tmp_path / "report.html"
    write_report(model, path, videos={"film": film})
    page = Page(path.read_text())
    assert not [a for a in page.addresses if a.startswith("data:video")]
    assert [a for a in page.addresses if a.endswith(film.name)]


def test_tiles_are_small(full):
    tiles = [p for p in pictures(Page(full)) if p.shape[0] <= LARGEST_TILE]
    assert len(tiles) > 20


def test_a_report_that_cannot_be_written_says_so(model, tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        write_report(model, tmp_path / "nowhere" / "report.html")


def test_the_opening_is_that_of_the_lips(world, model, held_out):
    name, t = model.sources[model.basis.reference]
    which = [clip.name for clip in world.clips].index(name)
    lips = landmarks(world.face, world.motions[which], t)[:40]
    truth = lip_opening(moved_landmarks(model.basis, held_out.alpha, lips))
    ours = _opening(model, held_out.alpha)
    assert np.corrcoef(ours, truth)[0, 1] > 0.95
    np.testing.assert_allclose(_opening(model, np.zeros_like(held_out.alpha)), 0, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("labels", "expected"),
    [
        (("SIL", "M", "M", "M", "SIL", "AA"), [2, 5]),
        (("SIL", "SIL"), [1]),
        (("M",), [0]),
        (("M", "M", "AA", "AA", "M"), [1, 3, 4]),
    ],
)
def test_middles_of_phones(labels, expected):
    assert _middles(labels) == expected


def test_a_report_of_another_frame_rate_keeps_its_time(model, held_out, tmp_path):
    slow = Trajectory(held_out.labels, held_out.alpha, held_out.beta, Fraction(10))
    path = tmp_path / "report.html"
    write_report(model, path, held_out=slow)
    ticks = [float(t) for t in Page(path.read_text()).texts if re.fullmatch(r"\d+(\.\d+)?", t)]
    assert max(t for t in ticks if t < 100) >= len(slow) // 10 - 1
