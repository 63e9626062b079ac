import numpy as np
import pytest
from scipy import stats

from mmmgpu.errors import InputError
from mmmgpu.statistics import (
    correlation,
    interval,
    paired_interval,
    rms_error,
    speech_frames,
    variance_ratio,
)


@pytest.fixture
def pair():
    rng = np.random.default_rng(0)
    real = rng.normal(size=(40, 3))
    return 0.5 * real + 0.3 * rng.normal(size=(40, 3)) + 7, real, rng.random(40) < 0.6


def test_figures_are_those_of_numpy_on_the_chosen_frames(pair):
    y, z, frames = pair
    for j in range(3):
        a, b = y[frames, j], z[frames, j]
        rms = np.sqrt(np.sum((a - b) ** 2) / len(a))
        np.testing.assert_allclose(rms_error(y, z, frames=frames)[j], rms, rtol=1e-12)
        np.testing.assert_allclose(
            correlation(y, z, frames=frames)[j], np.corrcoef(a, b)[0, 1], rtol=1e-12
        )
        np.testing.assert_allclose(
            variance_ratio(y, z, frames=frames)[j], a.var() / b.var(), rtol=1e-12
        )
    everywhere = np.ones(len(y), dtype=bool)
    np.testing.assert_array_equal(rms_error(y, z), rms_error(y, z, frames=everywhere))


def test_what_cannot_be_said_is_nan(pair):
    y, z, frames = pair
    z = z * [1, 0, 1]
    np.testing.assert_array_equal(np.isnan(correlation(y, z)), [False, True, False])
    np.testing.assert_array_equal(np.isnan(variance_ratio(y, z)), [False, True, False])
    nowhere = np.zeros_like(frames)
    for figure in (rms_error, correlation, variance_ratio):
        assert np.isnan(figure(y, z, frames=nowhere)).all()


def test_speech_is_what_is_not_silence():
    labels = ["SIL", "B", "IH", "SIL", "BR"]
    np.testing.assert_array_equal(speech_frames(labels), [False, True, True, False, True])
    np.testing.assert_array_equal(
        speech_frames(labels, silence=("SIL", "BR")), [False, True, True, False, False]
    )


def test_interval_is_that_of_the_t_test():
    rng = np.random.default_rng(1)
    before, after = rng.normal(1, 1, 15), rng.normal(0.5, 1, 15)
    got = paired_interval(before, after, confidence=0.9)
    want = stats.ttest_rel(before, after).confidence_interval(0.9)
    assert got.n == 15
    np.testing.assert_allclose(
        [got.mean - got.half_width, got.mean + got.half_width], [want.low, want.high], rtol=1e-10
    )
    assert interval([1.0, 1.1, 0.9]).excludes_zero
    assert not interval([1.0, -1.1, 0.9]).excludes_zero
    assert not interval([1.0]).excludes_zero  # one clip settles nothing


def test_bad_input_is_named(pair):
    y, z, _ = pair
    with pytest.raises(InputError, match="one shape"):
        rms_error(y[1:], z)
    with pytest.raises(InputError, match="must pair up"):
        paired_interval([1.0], [1.0, 2.0])
    with pytest.raises(InputError, match="n >= 1"):
        interval([])
