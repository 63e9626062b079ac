import numpy as np
import pytest

from mmmgpu.errors import InputError
from mmmgpu.phonemes import PhonemeModels
from mmmgpu.phones import CE05_CLASSES, CMU_PHONES, DIPHTHONGS
from mmmgpu.regression_classes import broad_classes, class_rows, kmeans_classes, paper_classes


def models(mean, labels=None, variance=None):
    mean = np.asarray(mean, dtype=float)
    labels = tuple("abcdefghijklmnop"[: len(mean)]) if labels is None else labels
    variance = np.ones_like(mean) if variance is None else variance
    return PhonemeModels(labels, mean, variance, np.ones(len(mean), int))


def test_the_papers_phones_fall_into_its_classes():
    phones = [phone for own in CE05_CLASSES for phone in own]
    assert paper_classes(phones) == tuple(tuple(sorted(own)) for own in CE05_CLASSES)


def test_diphthongs_go_with_their_nucleus_and_empty_classes_are_left_out():
    classes = paper_classes(CMU_PHONES)
    assert sorted(p for own in classes for p in own) == sorted(CMU_PHONES)
    for label, (nucleus, _) in DIPHTHONGS.items():
        assert next(own for own in classes if label in own).count(nucleus) == 1
    assert paper_classes(["SIL", "B", "ʒ", "M"]) == (("B", "M"), ("ʒ",), ("SIL",))


def test_broad_classes_are_silence_vowels_and_consonants():
    found = broad_classes(["SIL", "B", "AY", "AXR", "ʒ", "BR", "IY"])
    assert found == (("B", "BR", "ʒ"), ("SIL",), ("AXR", "AY", "IY"))
    assert broad_classes(["UW", "M"]) == (("M",), ("UW",))


def test_kmeans_finds_the_groups_of_both_streams():
    alpha = models([[0.0], [9], [0.3], [0.1], [9], [0.4]])  # tells b, e from the rest
    beta = models([[0.0], [0.3], [9], [0.4], [0.1], [9]])  # tells c, f from the rest
    assert kmeans_classes(alpha, beta, count=3) == (("a", "d"), ("b", "e"), ("c", "f"))
    assert kmeans_classes(alpha, count=2) == (("a", "c", "d", "f"), ("b", "e"))


def test_kmeans_measures_dimensions_by_their_typical_variance():
    mean = [[0, 0], [0, 1], [100, 0], [100, 1]]
    wide = np.tile([1e6, 1e-2], (4, 1))
    assert kmeans_classes(models(mean), count=2) == (("a", "b"), ("c", "d"))
    assert kmeans_classes(models(mean, variance=wide), count=2) == (("a", "c"), ("b", "d"))


def test_the_same_groups_have_the_same_names_with_every_seed():
    mean = np.repeat(np.arange(4), 3)[:, None] * 10.0 + np.tile([0, 0.1, 0.2], 4)[:, None]
    found = {kmeans_classes(models(mean), count=4, seed=seed) for seed in range(5)}
    assert found == {(("a", "b", "c"), ("d", "e", "f"), ("g", "h", "i"), ("j", "k", "l"))}


def test_there_are_no_more_classes_than_different_means():
    assert kmeans_classes(models([[0], [0], [5]]), count=9) == (("a", "b"), ("c",))


def test_rows_number_the_classes():
    rows = class_rows(models([[0], [1], [2]]), (("c", "x"), ("a", "b")))
    np.testing.assert_array_equal(rows, [1, 1, 0])


def test_bad_classes_are_named():
    three = models([[0], [1], [2]])
    with pytest.raises(InputError, match=r"phone 'b' of the model is in 0 regression classes"):
        class_rows(three, (("a",), ("c",)))
    with pytest.raises(InputError, match=r"phone 'a' of the model is in 2 regression classes"):
        class_rows(three, (("a", "b"), ("a", "c")))
    with pytest.raises(InputError, match="all of the same phones"):
        kmeans_classes(three, models([[0], [1]]))
    with pytest.raises(InputError, match="all of the same phones"):
        kmeans_classes()
    with pytest.raises(InputError, match="at least 1 class, got 0"):
        kmeans_classes(three, count=0)
