import numpy as np
import pytest
from scipy.stats import ttest_rel, wilcoxon

from mmmgpu.comparison_scores import METRICS, paired_tests, score, summarise


def sequences(seed, lengths=(5, 9), d=3):
    rng = np.random.default_rng(seed)
    return [rng.normal(size=(n, d)) * [1, 2, 3] for n in lengths]


def test_the_numbers_are_those_of_their_definitions():
    made, real = sequences(0), sequences(1)
    got = score(made, real, log_likelihood=-42.0)
    assert tuple(got) == METRICS
    x, y = np.concatenate(made), np.concatenate(real)
    e = [[abs(a - b) for a, b in zip(p, q, strict=True)] for p, q in zip(x, y, strict=True)]
    np.testing.assert_allclose(got["l1"], np.mean([sum(one) for one in e]), rtol=1e-12)
    squares = [sum(v**2 for v in one) for one in e]
    np.testing.assert_allclose(got["rms"], np.sqrt(np.mean(squares)), rtol=1e-12)
    np.testing.assert_allclose(got["l_infinity"], np.mean([max(one) for one in e]), rtol=1e-12)
    assert got["log_likelihood"] == -42 / 14
    each = [np.corrcoef(x[:, j], y[:, j])[0, 1] for j in range(3)]
    weight = y.var(axis=0)
    np.testing.assert_allclose(got["correlation"], each @ weight / weight.sum(), rtol=1e-12)
    np.testing.assert_allclose(
        got["variance_ratio"], x.var(axis=0).sum() / weight.sum(), rtol=1e-12
    )


def test_smoothness_is_of_second_differences_within_each_sequence():
    ramps = [np.arange(6.0)[:, None], 100 - np.arange(4.0)[:, None]]
    bends = [np.arange(6.0)[:, None] ** 2, np.arange(4.0)[:, None] ** 2]
    assert score(ramps, bends, None)["smoothness"] == 0
    np.testing.assert_allclose(score(bends, [3 * b for b in bends], None)["smoothness"], 1 / 3)


def test_the_same_again_is_perfect_and_what_stands_still_has_no_ratio():
    real = sequences(2)
    same = score(real, real, None)
    assert (same["l1"], same["rms"], same["l_infinity"]) == (0, 0, 0)
    assert same["log_likelihood"] is None
    for name in ("correlation", "variance_ratio", "smoothness"):
        np.testing.assert_allclose(same[name], 1, rtol=1e-12)
    still = [np.ones_like(one) for one in real]
    assert score(still, real, None)["correlation"] is None
    assert score(still, real, None)["variance_ratio"] == 0
    assert score(real, still, None)["variance_ratio"] is None
    assert score([real[0][:1]], [real[0][:1]], None)["smoothness"] is None


def folds(seed=3):
    rng = np.random.default_rng(seed)
    return [
        {
            name: {metric: float(rng.normal(i)) for metric in METRICS}
            | ({"log_likelihood": None} if name == "b" else {})
            for i, name in enumerate("abc")
        }
        for _ in range(6)
    ]


def test_intervals_are_over_folds():
    found = summarise(folds())
    values = [fold["a"]["rms"] for fold in folds()]
    assert found["a"]["rms"]["mean"] == pytest.approx(np.mean(values), rel=1e-12)
    half = 2.5706 * np.std(values, ddof=1) / np.sqrt(6)  # t of 5 degrees of freedom
    assert found["a"]["rms"]["half_width_95"] == pytest.approx(half, rel=1e-4)
    assert found["b"]["log_likelihood"] is None
    assert summarise(folds()[:1])["a"]["rms"]["half_width_95"] is None


def test_models_are_tested_in_pairs_where_both_have_the_number():
    tests = paired_tests(folds())
    assert len(tests) == 6 * 3 + 1
    one = next(t for t in tests if (t["metric"], t["first"], t["second"]) == ("rms", "a", "c"))
    a, c = ([fold[name]["rms"] for fold in folds()] for name in "ac")
    assert one["p_t"] == pytest.approx(ttest_rel(a, c).pvalue)
    assert one["p_wilcoxon"] == pytest.approx(wilcoxon(a, c).pvalue)
    assert one["difference"]["mean"] == pytest.approx(np.mean(a) - np.mean(c))
    assert {(t["first"], t["second"]) for t in tests if t["metric"] == "log_likelihood"} == {
        ("a", "c")
    }


def test_what_does_not_differ_is_not_significant():
    same = [{"a": fold["a"], "b": fold["a"]} for fold in folds()]
    assert {(t["p_t"], t["p_wilcoxon"]) for t in paired_tests(same)} == {(1.0, 1.0)}


def test_a_difference_that_is_the_same_in_every_fold_is_no_chance():
    rows = [{"a": dict.fromkeys(METRICS, v), "b": dict.fromkeys(METRICS, v + 1)} for v in (1, 2, 4)]
    assert [one["p_t"] for one in paired_tests(rows)] == [0] * len(METRICS)
    same = [{name: dict.fromkeys(METRICS, v) for name in "ab"} for v in (1, 2, 4)]
    assert [one["p_t"] for one in paired_tests(same)] == [1] * len(METRICS)
    assert paired_tests(rows[:1]) == []
