import shutil

import media
import numpy as np
import pytest
from worlds import FPS, say

from mmmgpu.alignments import SIL, Alignment, Segment, write_textgrid
from mmmgpu.corpora import open_corpus
from mmmgpu.errors import InputError


@pytest.fixture
def folder(tmp_path):
    """Two clips, "a b.mkv" and "-c.mkv", of 1 s with their alignments."""
    for name in ("a b", "-c"):
        media.encode(tmp_path / f"{name}.mkv", media.grey_levels(25))
        write_textgrid(say("B IY", phone=0.2), tmp_path / f"{name}.TextGrid")
    return tmp_path


def clips_of(folder):
    return [folder / "a b.mkv", folder / "-c.mkv"]


def test_clips_come_in_order_with_their_labels(folder):
    first, second = open_corpus(clips_of(folder), folder)
    assert [first.path.name, second.path.name] == ["a b.mkv", "-c.mkv"]
    assert (first.info.frames, first.info.width, first.info.height) == (25, 64, 48)
    wanted = [SIL] * 8 + ["B"] * 5 + ["IY"] * 5 + [SIL] * 7  # from 0.3, 0.5, 0.7 s
    assert first.labels == wanted


@pytest.mark.parametrize("sync", [0.2, -0.2])
def test_sync_moves_the_alignment(folder, sync):
    still, *_ = open_corpus(clips_of(folder), folder)
    moved, *_ = open_corpus(clips_of(folder), folder, sync=sync)
    step = round(sync * FPS)
    assert moved.labels.index("B") == still.labels.index("B") + step
    assert len(moved.labels) == 25


def test_one_alignment_file_serves_one_clip(folder):
    (clip,) = open_corpus([folder / "a b.mkv"], folder / "-c.TextGrid")
    assert "IY" in clip.labels


def rename(folder):
    shutil.copy(folder / "-c.mkv", folder / "a b.mp4")  # they would share an alignment
    return [folder / "a b.mkv", folder / "a b.mp4"]


def late(folder):
    long = Alignment((Segment("AA", 0.0, 1.6),), (), 1.6)
    write_textgrid(long, folder / "-c.TextGrid")
    return clips_of(folder)


def without(suffix):
    def change(folder):
        (folder / f"-c{suffix}").unlink()
        return clips_of(folder)

    return change


def replaced(name, frames, **options):
    def change(folder):
        (folder / name).unlink()
        media.encode(folder / name, frames, **options)
        return clips_of(folder)

    return change


def text(folder):
    (folder / "-c.mkv").write_text("no video at all")
    return clips_of(folder)


BAD = {
    "no clip": (lambda folder: [], "no clip given"),
    "equal names": (rename, "a b.mp4: two clips are called a b"),
    "missing": (without(".mkv"), "-c.mkv: no such file"),
    "no alignment": (without(".TextGrid"), "holds no alignment of .*-c.mkv"),
    "alignment too long": (late, r"-c.TextGrid: ends at 1.60 s but the clip ends at 1.00 s"),
    "one frame": (replaced("-c.mkv", media.grey_levels(1)), "-c.mkv: has 1 frame"),
    "text": (text, "-c.mkv: "),
    "other size": (replaced("-c.mkv", media.grey_levels(25, 48, 80)), "is 80 x 48, .*is 64 x 48"),
}  # fmt: skip


@pytest.mark.parametrize("fault", BAD)
def test_what_cannot_be_used_is_named_on_one_line(folder, fault):
    change, message = BAD[fault]
    with pytest.raises(InputError, match=message) as error:
        open_corpus(change(folder), folder)
    assert "\n" not in str(error.value)


def test_all_labels_have_a_frame_each(world):
    for clip, motion in zip(open_corpus(world.clips, world.alignments), world.motions, strict=True):
        assert len(clip.labels) == clip.info.frames == len(motion)
        assert clip.info.has_sound
        said = [label for label in clip.labels if label != SIL]
        assert len(np.unique(said)) == 8
