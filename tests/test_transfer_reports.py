from dataclasses import replace

import numpy as np
import pytest

from mmmgpu.corpora import open_corpus
from mmmgpu.model_files import load
from mmmgpu.reconstruction import analyse_clip
from mmmgpu.trajectory_files import Trajectory
from mmmgpu.transfer_reports import points_in_clips, write_transfer_report


@pytest.fixture(scope="module")
def stages(two_persons, transferred, adapted):
    """The first person's model, the transferred one, and the adapted one."""
    return load(two_persons.source), transferred[1], adapted[1]


def test_all_figures_are_there(two_persons, stages, tmp_path):
    source, before, after = stages
    second, page = two_persons.second, tmp_path / "ü.html"
    (clip,) = open_corpus(second.clips[:1], second.alignments)
    found = analyse_clip(after, clip.path)
    real = Trajectory(tuple(clip.labels), found.alpha, found.beta, clip.info.fps)
    points = points_in_clips(two_persons.points, second.clips)
    write_transfer_report(page, source=source, before=before, after=after, points=points, real=real)
    text = page.read_text()
    assert "closed: " in text
    assert "open: " in text  # Fig. 2
    for k in range(len(source.sources)):
        assert f"prototype {k}, and what was chosen for it" in text  # Fig. 3
    assert text.count("<svg") == 5  # two descents of each stream, and Fig. 4
    for name in ("first person", "second, before", "second, after"):
        assert f"AA, {name}" in text  # Fig. 5
        assert f"UH, {name}" not in text  # never said
    assert "GDLR (speaks)" in text
    assert "iteration 1" in text
    assert before.notes["matching"]["outcome"] in text
    assert not list(tmp_path.glob(".*"))


def test_a_transfer_alone_can_be_shown(stages, tmp_path):
    _, before, _ = stages
    write_transfer_report(tmp_path / "r.html", before=before)
    text = (tmp_path / "r.html").read_text()
    assert "AA, second, before" in text
    assert "first person</" not in text.replace("clips of the first person</", "")
    assert "<svg" not in text


def test_names_are_escaped(stages, tmp_path):
    _, before, _ = stages
    notes = before.notes | {"skipped": {"<b>.mp4": "why"}}
    write_transfer_report(tmp_path / "r.html", before=replace(before, notes=notes))
    assert "<b>.mp4" not in (tmp_path / "r.html").read_text()


def test_the_points_come_with_the_frames_of_the_second(two_persons):
    second = two_persons.second
    for pair, picture in points_in_clips(two_persons.points, second.clips):
        height, width = picture.shape[:2]
        assert (width, height) == pair.b.size
        assert (pair.points_b >= 0).all()
        assert (pair.points_b < np.array([width, height])).all()
