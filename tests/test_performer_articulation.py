from typing import NamedTuple

import numpy as np
import pytest

from mmmgpu.errors import InputError
from mmmgpu.performer import ARTICULATORS, PHONES, Articulation, articulate, performer
from mmmgpu.performer_articulation import REST

ARPABET = {
    *["AA", "AE", "AH", "AO", "AW", "AX", "AXR", "AY", "B", "BR", "CH", "D", "DH", "DX", "EH"],
    *["ER", "EY", "F", "G", "HH", "IH", "IX", "IY", "JH", "K", "L", "M", "N", "NG", "OW", "OY"],
    *["P", "R", "S", "SH", "SIL", "T", "TH", "UH", "UW", "V", "W", "Y", "Z", "ZH"],
}


class Segment(NamedTuple):
    label: str
    start: float
    end: float


def say(labels, *, seed=5, length=0.2, fps=25.0, rng=0):
    phones = [Segment(p, i * length, (i + 1) * length) for i, p in enumerate(labels.split())]
    n = round(len(phones) * length * fps)
    return articulate(performer(seed), phones, n, fps, np.random.default_rng(rng))


def peak(motion, name, labels, phone, length=0.2):
    """Largest value of the articulator during the phone's only occurrence."""
    i = labels.split().index(phone)
    spans = slice(int(i * length * motion.fps), int((i + 1) * length * motion.fps))
    return motion.column(name)[spans].max()


def test_the_promised_phones_are_there():
    assert set(PHONES) == ARPABET


def test_values_are_normalised_and_smooth():
    motion = say("SIL M AA IY UW F AA P AY OW SIL", fps=100.0)
    assert motion.values.shape == (220, len(ARTICULATORS))
    assert motion.values.min() >= 0
    assert motion.values.max() <= 1
    assert np.abs(np.diff(motion.values, axis=0)).max() < 0.25


def test_the_mouth_depends_on_the_phones_only():
    a, b = say("SIL AA SIL", rng=0), say("SIL AA SIL", rng=1)
    np.testing.assert_array_equal(a.values, b.values)
    assert np.abs(a.pose - b.pose).max() > 1e-3
    again = say("SIL AA SIL", rng=0)
    np.testing.assert_array_equal(a.pose, again.pose)
    np.testing.assert_array_equal(a.blink, again.blink)


def test_speakers_have_their_own_style():
    a, b = say("SIL AA IY UW SIL", seed=1), say("SIL AA IY UW SIL", seed=2)
    assert np.abs(a.values - b.values).max() > 0.05


@pytest.mark.parametrize(
    ("phone", "name", "at_least"),
    [
        ("M", "press", 0.8),
        ("F", "bite", 0.75),
        ("UW", "round", 0.6),
        ("AA", "jaw", 0.55),
        ("DH", "tongue_advance", 0.8),
        ("L", "tongue_height", 0.65),
        ("IY", "width", 0.7),
    ],
)
@pytest.mark.parametrize("seed", range(4))
def test_every_phone_reaches_what_makes_it(phone, name, at_least, seed):
    labels = f"SIL AH {phone} AX SIL"
    assert peak(say(labels, seed=seed), name, labels, phone) > at_least


def test_diphthongs_move():
    labels = "SIL OW SIL"
    rounding = say(labels, length=0.3, fps=100.0).column("round")[30:60]
    assert rounding[24] > rounding[8] + 0.15


def test_neighbours_colour_a_phone():
    before_round = say("SIL S UW SIL", fps=100.0).column("round")[35]
    before_spread = say("SIL S IY SIL", fps=100.0).column("round")[35]
    assert before_round > before_spread + 0.1


def test_silence_and_gaps_rest():
    motion = articulate(performer(5), [Segment("AA", 0.5, 0.7)], 50, 25.0, np.random.default_rng(0))
    np.testing.assert_allclose(motion.values[-1], REST, rtol=0, atol=1e-2)
    nothing = articulate(performer(5), [], 5, 25.0, np.random.default_rng(0))
    np.testing.assert_allclose(nothing.values, np.tile(REST, (5, 1)), rtol=0, atol=1e-12)


def test_eyes_blink_and_the_head_sways_a_little():
    motion = say("SIL " * 60)
    shut = motion.blink > 0.95
    assert 2 <= np.count_nonzero(np.diff(shut.astype(int)) == 1) <= 9
    assert 0.005 < np.abs(motion.pose).max() < 0.08


BAD_PHONES = {
    "QQ": (Segment("QQ", 0.0, 1.0), "phone 1 is 'QQ'"),
    "reversed": (Segment("AA", 0.5, 0.2), "phone 1 .* end must be later"),
    "nan": (Segment("AA", 0.5, float("nan")), "phone 1 .* end must be later"),
}


@pytest.mark.parametrize("case", BAD_PHONES)
def test_bad_phones_are_named(case):
    phone, message = BAD_PHONES[case]
    with pytest.raises(InputError, match=message):
        articulate(performer(5), [Segment("SIL", 0, 0.2), phone], 9, 25.0, np.random.default_rng())


@pytest.mark.parametrize(("n", "fps"), [(0, 25.0), (5, 0.0), (5, float("nan"))])
def test_bad_lengths_are_named(n, fps):
    with pytest.raises(InputError, match="n_frames and fps must be positive"):
        articulate(performer(5), [], n, fps, np.random.default_rng(0))


def test_an_articulation_checks_its_arrays():
    good = say("SIL AA")
    with pytest.raises(InputError, match=r"leave \[0, 1\]"):
        Articulation(good.values + 1, good.pose, good.blink, good.gaze, 25.0)
    with pytest.raises(InputError, match="pose of the articulation holds NaN"):
        Articulation(good.values, good.pose * np.nan, good.blink, good.gaze, 25.0)
    with pytest.raises(InputError, match="needs arrays"):
        Articulation(good.values[:, 1:], good.pose, good.blink, good.gaze, 25.0)
