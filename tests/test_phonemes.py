import numpy as np
import pytest

from mmmgpu.errors import InputError
from mmmgpu.phonemes import (
    TINY_SHARE,
    PhonemeModels,
    Utterance,
    coverage,
    cut_utterance,
    pool,
    segment_durations,
)
from mmmgpu.phones import CE05_CLASSES


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


def test_precision_is_the_inverse_of_the_variances():
    rng = np.random.default_rng(6)
    variance = rng.uniform(0.1, 3, size=(2, 3))
    models = PhonemeModels(("a", "b"), np.zeros((2, 3)), variance, np.array([3, 1]))
    np.testing.assert_allclose(models.precision, 1 / variance, rtol=1e-15)
    root = rng.normal(size=(2, 3, 3))
    covariance = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(3)
    own = np.diagonal(covariance, axis1=1, axis2=2)
    full = PhonemeModels(("a", "b"), np.zeros((2, 3)), own, np.array([3, 1]), covariance)
    product = full.precision @ covariance
    np.testing.assert_allclose(product, [np.eye(3)] * 2, atol=1e-10)


@pytest.mark.parametrize(
    ("labels", "segments", "want"),
    [
        ("abccccba", None, ["ab", "cccc", "ba"]),
        ("abccbcba", None, ["ab", "ccb", "cba"]),
        ("aaaaaaab", None, ["aaaaaaa", "b"]),
        ("aaaaaaaa", [0, 0, 0, 1, 1, 1, 2, 2], ["aaa", "aaa", "aa"]),
    ],
)
def test_an_utterance_is_cut_between_segments(labels, segments, want):
    segments = None if segments is None else np.array(segments)
    clip = Utterance(np.arange(8.0)[:, None], list(labels), segments)
    parts = cut_utterance(clip, 3)
    assert ["".join(part.labels) for part in parts] == want
    np.testing.assert_array_equal(np.concatenate([part.z for part in parts]), clip.z)
    if segments is not None:
        np.testing.assert_array_equal(np.concatenate([part.segments for part in parts]), segments)


def test_one_segment_cannot_be_cut():
    with pytest.raises(InputError, match=r"single segment cannot be divided.*give more speech"):
        cut_utterance(Utterance(np.zeros((5, 1)), ["SIL"] * 5), 3)


def test_coverage_counts_as_the_paper_does():
    phones = [phone for phones in CE05_CLASSES for phone in phones]
    seen = [phone for phone in phones if phone != "SIL"][:18]
    labels = ["SIL"] * 299 + [seen[i % 18] for i in range(151)]
    found = coverage(labels, phones)
    assert round(found.per_phone, 2) == 11.25
    assert round(found.per_phone_without_silence, 2) == 3.87
    assert len(found.unseen) == 21
    assert set(found.unseen) == set(phones) - set(seen) - {"SIL"}
    assert found.frames["SIL"] == 299
    assert sum(found.frames.values()) == 450
    assert found.others == {}


def test_coverage_keeps_phones_of_other_inventories_apart():
    found = coverage(["AY", "B", "AY", "SIL"], ["SIL", "B"])
    assert found.others == {"AY": 2}
    assert found.frames == {"SIL": 1, "B": 1}
    assert found.per_phone == 1
