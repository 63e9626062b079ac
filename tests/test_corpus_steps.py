from types import SimpleNamespace

import numpy as np
import pytest

from mmmgpu.corpus_steps import Frames


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
