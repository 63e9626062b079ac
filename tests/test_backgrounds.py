from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from media import encode, grey_levels, which
from worlds import make_model

from mmmgpu import backgrounds
from mmmgpu.backgrounds import Background, extended, open_background
from mmmgpu.errors import InputError
from mmmgpu.models import Calm

N = 6
FRAME_BYTES = 48 * 64 * 3


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return encode(tmp_path_factory.mktemp("clip") / "grey.mkv", grey_levels(N))


def shown(clip, length):
    """The numbers `extended` gives, after a check that they are those of its frames."""
    pairs = list(extended(Background(clip, Fraction(25), None), length))
    numbers = [t for _, t in pairs]
    assert which([frame for frame, _ in pairs], N) == numbers
    return numbers


@pytest.mark.parametrize("length", [0, 1, 5, 6, 7, 11, 40])
def test_a_background_of_any_length_never_jumps(clip, length):
    numbers = shown(clip, length)
    assert len(numbers) == length
    assert numbers[:N] == list(range(N))[:length]
    assert all(abs(step) == 1 for step in np.diff(numbers))


def test_it_goes_back_and_forth(clip):
    forth, back = list(range(N)), list(range(N - 2, 0, -1))
    assert shown(clip, 3 * N + 2 * len(back)) == forth + back + forth + back + forth


@pytest.mark.parametrize(("room", "kept"), [(3, 3), (2, 2), (0, 2)])
def test_no_more_frames_are_kept_than_there_is_room_for(clip, monkeypatch, room, kept):
    monkeypatch.setattr(backgrounds, "BYTES_KEPT", room * FRAME_BYTES)
    numbers = shown(clip, 30)
    assert set(numbers[N:]) == set(range(N - kept, N))
    assert all(abs(step) == 1 for step in np.diff(numbers))


def test_a_single_frame_is_repeated(tmp_path):
    clip = encode(tmp_path / "one.mkv", grey_levels(N)[2:3])
    pairs = list(extended(Background(clip, Fraction(25), None), 4))
    assert [t for _, t in pairs] == [0] * 4


def test_the_model_brings_its_own(basis, clip):
    model = make_model(basis)
    data = np.frombuffer(clip.read_bytes(), np.uint8)
    model = replace(model, calm=Calm(data, ".mkv", model.calm.track))
    with open_background(model, None) as behind:
        assert behind.path.read_bytes() == clip.read_bytes()
        assert behind.fps == 25
        assert behind.track is model.calm.track
    assert not behind.path.exists()


def test_a_missing_clip_is_refused(basis, tmp_path):
    missing = tmp_path / "none.mkv"
    with pytest.raises(InputError, match="no such"), open_background(make_model(basis), missing):
        pass
