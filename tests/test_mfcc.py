import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmmgpu.errors import InputError
from mmmgpu.mfcc import COEFFICIENTS, RATE, SHIFT, mfcc


def tones(rate, seconds=1.0):
    """A tone of 400 Hz, then one of 2500 Hz, with a pause between."""
    t = np.arange(round(seconds * rate)) / rate
    loud = np.where(t < 0.4 * seconds, 1, 0) + np.where(t > 0.6 * seconds, 2, 0)
    return 0.3 * np.select(
        [loud == 1, loud == 2], np.sin(2 * np.pi * np.outer([400, 2500], t)), 0.0
    )


def test_a_frame_is_about_its_time():
    samples = np.zeros(RATE)
    samples[round(0.4 * RATE)] = 1.0  # a click on the border of frames 39 and 40
    loudness = mfcc(samples, RATE, deltas=0)[:, 0]
    assert len(loudness) == round(1 / SHIFT)
    assert sorted(np.argsort(loudness)[-2:]) == [39, 40]
    assert loudness[39] == pytest.approx(loudness[40], abs=0.5)


def test_features_are_coefficients_and_their_derivatives_without_the_mean():
    x = mfcc(tones(RATE), RATE, deltas=2)
    c, first, second = np.split(x, 3, axis=1)
    assert c.shape == (100, COEFFICIENTS)
    assert_allclose(c, mfcc(tones(RATE), RATE, deltas=0), rtol=0, atol=0)
    assert_allclose(c.mean(axis=0), 0, atol=1e-3)
    padded = np.concatenate([c[:1], c[:1], c, c[-1:], c[-1:]])
    slope = sum(j * padded[2 + j : 2 + j + len(c)] for j in range(-2, 3)) / 10
    assert_allclose(first, slope, atol=1e-3)
    inner = sum(j * slope[4 + j : len(c) - 4 + j] for j in range(-2, 3)) / 10
    assert_allclose(second[4:-4], inner, atol=1e-3)


def test_sounds_are_told_apart():
    c = mfcc(tones(RATE), RATE, deltas=0)
    low, pause, high = c[10:30].mean(axis=0), c[45:55].mean(axis=0), c[70:90].mean(axis=0)
    assert min(low[0], high[0]) > pause[0] + 10
    assert np.abs(low - high).max() > 10


@pytest.mark.parametrize("rate", [8_000, 22_050, 48_000])
def test_loudness_and_rate_hardly_matter(rate):
    want, got = mfcc(tones(RATE), RATE), mfcc(0.01 * tones(rate), rate)
    assert got.shape == want.shape
    parts = [slice(5, 35), slice(65, 95)]
    difference = np.concatenate([np.abs(want[p, :3] - got[p, :3]) for p in parts])
    assert np.median(difference) < 1.5  # of tens between sounds


def test_bits_repeat_and_samples_stay():
    samples = tones(RATE)
    before = samples.copy()
    first, again = mfcc(samples, RATE), mfcc(samples, RATE)
    assert (samples == before).all()
    assert first.tobytes() == again.tobytes()
    assert first.dtype == np.float64


def test_digital_silence_is_no_abyss():
    samples = tones(RATE)
    samples[:4000] = 0
    assert np.ptp(mfcc(samples, RATE)[:, 0]) < 100  # without noise: 177


@pytest.mark.parametrize(
    ("samples", "rate", "message"),
    [
        (np.zeros(RATE), RATE, "the sound is silent"),
        (np.zeros((9, 2)), RATE, r"samples must be mono"),
        (np.full(9, np.inf), RATE, "NaN or infinity"),
        (np.ones(9), 0, "rate must be > 0"),
        (np.ones(60), RATE, "silent or too short"),
    ],
)
def test_what_has_no_features_is_an_input_error(samples, rate, message):
    with pytest.raises(InputError, match=message):
        mfcc(samples, rate)


def test_without_the_library_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "kaldi_native_fbank", None)
    with pytest.raises(InputError, match=r"pip install 'mmmgpu\[align\]'"):
        mfcc(tones(RATE), RATE)
