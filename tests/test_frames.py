from types import SimpleNamespace

import numpy as np
import pytest

from mmmgpu.frames import Frames, Pictures
from mmmgpu.regions import Region


def row_of(*lengths):
    """Frames of clips of so many frames; what is registered tells the frame."""
    clips = [SimpleNamespace(name=f"clip{i}", length=n) for i, n in enumerate(lengths)]
    tracks = {c.name: SimpleNamespace(registered=np.arange(c.length)) for c in clips}
    return Frames(clips, tracks)


@pytest.mark.parametrize(
    ("lengths", "count"),
    [((75,) * 5, 10), ((500,), 8), ((3,), 3), ((20, 1, 7), 7), ((9,) * 160, 160)],
)
def test_stretches_hold_every_frame_once_and_in_order(lengths, count):
    stretches = row_of(*lengths).stretches
    assert len(stretches) == len({s.name for s in stretches}) == count
    frames = [(s.clip.name, t) for s in stretches for t in s.registered]
    assert frames == [(f"clip{i}", t) for i, n in enumerate(lengths) for t in range(n)]
    assert sum(s.length for s in stretches) == sum(lengths)


def test_the_stretches_of_a_clip_are_of_about_one_length():
    lengths = {s.length for s in row_of(1000, 1000, 1001).stretches}
    assert lengths <= {333, 334}


@pytest.mark.parametrize("lengths", [(75,) * 5, (3,), (20, 1, 7)])
def test_rows_of_all_frames_are_parted_by_clip(lengths):
    frames = row_of(*lengths)
    rows = np.concatenate([s.registered for s in frames.stretches] + [[-1, -1]])
    assert len(frames) == sum(lengths)
    whole = frames.by_clip(np.stack([rows, rows**2], axis=1))
    assert len(whole) == len(lengths)
    for found, n in zip(whole, lengths, strict=True):
        np.testing.assert_array_equal(found, np.stack([np.arange(n), np.arange(n) ** 2], axis=1))


def test_pictures_are_seen_like_frames_of_their_region():
    region = Region((40, 30, 6, 4), (43.0, 32.0, 4.0))
    images = np.random.default_rng(0).random((5, 4, 6, 3), np.float32)
    pictures = Pictures("old", images)
    assert pictures.length == 5
    np.testing.assert_array_equal(np.stack(list(pictures.crops(region))), images)
    with pytest.raises(AssertionError):
        pictures.crops(Region((40, 30, 5, 4), (43.0, 32.0, 4.0)))
