import numpy as np
import pytest

from mmmgpu.errors import InputError
from mmmgpu.phonemes import TINY_SHARE, PhonemeModels, Utterance, pool, segment_durations


def utterance(rng, labels, n_dims=3):
    return Utterance(rng.normal(size=(len(labels), n_dims)), list(labels))


def test_pooled_gaussians_are_those_of_each_phones_frames():
    rng = np.random.default_rng(0)
    clips = [utterance(rng, "aabbca"), utterance(rng, "bbbaacc")]
    models = pool(clips, floor_share=1e-9)
    assert models.labels == ("a", "b", "c")
    for p, label in enumerate(models.labels):
        frames = np.array(
            [z for u in clips for z, name in zip(u.z, u.labels, strict=True) if name == label]
        )
        np.testing.assert_allclose(models.mean[p], frames.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(models.variance[p], frames.var(axis=0), rtol=1e-12)
        assert models.count[p] == len(frames)


def test_variance_is_never_below_its_share_of_the_stream():
    rng = np.random.default_rng(1)
    clip = utterance(rng, "aaaab")  # one frame of b: no variance of its own
    models = pool([clip], floor_share=0.25)
    np.testing.assert_allclose(models.variance[1], 0.25 * clip.z.var(axis=0), rtol=1e-12)


def test_a_dimension_that_never_moves_gets_a_variance_above_zero():
    rng = np.random.default_rng(2)
    z = rng.normal(size=(6, 3))
    z[:, 1] = 0
    models = pool([Utterance(z, list("aabbcc"))], floor_share=0.5)
    want = 0.5 * TINY_SHARE * z.var(axis=0).mean()
    np.testing.assert_allclose(models.variance[:, 1], want, rtol=1e-12)
    still = pool([Utterance(np.zeros((6, 3)), list("aabbcc"))])
    assert (still.variance > 0).all()


def test_typical_variance_weighs_phones_by_their_frames():
    variance = np.array([[1.0, 10.0], [4.0, 20.0]])
    models = PhonemeModels(("a", "b"), np.zeros((2, 2)), variance, np.array([3, 1]))
    np.testing.assert_allclose(models.typical_variance, [1.75, 12.5], rtol=1e-12)


def test_index_gives_the_row_or_that_of_the_stand_in():
    models = pool([utterance(np.random.default_rng(3), "abc")])
    np.testing.assert_array_equal(models.index(list("cab")), [2, 0, 1])
    middle = models.index(["ZH", "a"], stand_in=lambda label, known: sorted(known)[1])
    np.testing.assert_array_equal(middle, [1, 0])
    with pytest.raises(InputError, match=r"phone 'ZH' has no model.*a, b, c"):
        models.index(["ZH"])
    with pytest.raises(InputError, match=r"phone 'ZH' has no model"):
        models.index(["ZH"], stand_in=lambda label, known: label.lower())


@pytest.mark.parametrize(
    ("labels", "segments", "want"),
    [
        ("aabccc", None, [2, 2, 1, 3, 3, 3]),
        ("aabaa", None, [2, 2, 1, 2, 2]),
        ("aaaa", [7, 7, 7, 9], [3, 3, 3, 1]),
        ("a", None, [1]),
        ("", None, []),
    ],
)
def test_segment_durations(labels, segments, want):
    np.testing.assert_array_equal(segment_durations(list(labels), segments), want)


def test_bad_input_is_named():
    rng = np.random.default_rng(4)
    with pytest.raises(InputError, match="no frame to learn from"):
        pool([])
    with pytest.raises(InputError, match="differ in dimension"):
        pool([utterance(rng, "ab", 2), utterance(rng, "ab", 3)])
    with pytest.raises(InputError, match="one label a frame"):
        Utterance(np.zeros((3, 2)), ["a", "b"])
    with pytest.raises(InputError, match="NaN or infinity"):
        Utterance(np.full((1, 2), np.nan), ["a"])
    with pytest.raises(InputError, match="got 2 for 3 labels"):
        segment_durations(list("aab"), [0, 1])


def test_a_phone_without_frames_gets_the_streams_gaussian_if_asked_for():
    rng = np.random.default_rng(5)
    clip = utterance(rng, "aacc")
    models = pool([clip], labels=["b", "a"])
    assert models.labels == ("a", "b", "c")
    np.testing.assert_array_equal(models.count, [2, 0, 2])
    np.testing.assert_allclose(models.mean[1], clip.z.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(models.variance[1], clip.z.var(axis=0), rtol=1e-12)
    without = pool([clip])
    np.testing.assert_array_equal(models.mean[[0, 2]], without.mean)
    np.testing.assert_array_equal(models.variance[[0, 2]], without.variance)
