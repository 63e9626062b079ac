import itertools

import numpy as np
import pytest

from mmmgpu.errors import InputError
from mmmgpu.labelled import (
    POOLED,
    Labelled,
    batches,
    check_labelled,
    check_sequence,
    entered_rows,
    find_rows,
    gaussians,
    log_normal,
    recursion,
    stand_ins,
    starting_rows,
)


def test_labels_become_rows_and_nothing_is_shared():
    y = [np.arange(6.0).reshape(3, 2), np.ones((1, 2))]
    data = check_labelled(y, [["b", "a", "b"], ["c"]])
    assert data.labels == ("a", "b", "c")
    np.testing.assert_array_equal(np.concatenate(data.rows), [1, 0, 1, 2])
    y[0][:] = 7
    assert data.y[0][0, 1] == 1
    assert data.frames.shape == (4, 2)
    assert [u.labels for u in data.utterances] == [["b", "a", "b"], ["c"]]


def test_any_real_numbers_are_taken():
    data = check_labelled([[[1, 2], [3, 4]]], [("a", "b")])
    assert data.y[0].dtype == np.float64


BAD = {
    "none": ([], [], "sequences: none"),
    "one row of labels too few": ([np.zeros((2, 1))], [], "0 rows of labels for 1 sequences"),
    "labels short": ([np.zeros((3, 1))], ["ab"], r"sequences\[0\]: has 3 frames but 2 labels"),
    "labels long": ([np.zeros((1, 1))], ["ab"], r"sequences\[0\]: has 1 frames but 2 labels"),
    "an empty one": ([np.ones((2, 1)), np.ones((0, 1))], ["ab", ""], r"sequences\[1\].*\(0, 1\)"),
    "no features": ([np.ones((2, 0))], ["ab"], r"sequences\[0\].*\(2, 0\)"),
    "a flat one": ([np.ones(2)], ["ab"], r"sequences\[0\].*\(2,\)"),
    "ragged": ([[[1, 2], [3]]], ["ab"], r"sequences\[0\]: must be an array"),
    "text": ([[["x"], ["y"]]], ["ab"], r"sequences\[0\]: must be an array"),
    "another d": ([np.ones((1, 2)), np.ones((1, 3))], ["a", "b"], r"\[1\]: has 3 features"),
    "NaN": ([[[0.0], [np.nan]]], ["ab"], r"sequences\[0\]: frame 1 holds NaN"),
    "infinite": ([[[np.inf], [0.0]]], ["ab"], r"sequences\[0\]: frame 0 holds NaN or inf"),
    "numbers for labels": ([np.ones((2, 1))], [[1, 2]], "labels must be strings"),
}


@pytest.mark.parametrize("fault", BAD)
def test_bad_sequences_are_said_on_one_line(fault):
    sequences, labels, message = BAD[fault]
    with pytest.raises(InputError, match=message) as error:
        check_labelled(sequences, labels)
    assert "\n" not in str(error.value)


def test_a_sequence_of_another_size_than_the_model_is_refused():
    with pytest.raises(InputError, match=r"sequence: must have shape \(T, 3\).*got \(2, 2\)"):
        check_sequence(np.ones((2, 2)), ["a", "b"], d=3)


def test_a_label_that_was_not_seen_has_what_looks_like_it_or_the_pooled_row():
    known = ("AA", "M", "S", "zzz")
    assert find_rows(known, ["M", "B", "zzz", "no phone"]).tolist() == [1, 1, 3, 4]
    assert stand_ins(known, ["B", "M", "no phone", "B"]) == {"B": "M", "no phone": POOLED}
    assert stand_ins(("state 1", "state 2"), ["B", "state 1"]) == {"B": POOLED}
    assert stand_ins(known, known) == {}


def test_gaussians_are_those_of_each_label_and_of_all():
    rng = np.random.default_rng(0)
    y = rng.normal(size=(40, 2)) * [1, 5]
    labels = list("aabb" * 10)
    mean, variance = gaussians(check_labelled([y[:30], y[30:]], [labels[:30], labels[30:]]))
    a = y[np.array(labels) == "a"]
    np.testing.assert_allclose(mean[0], a.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(variance[0], a.var(axis=0), rtol=1e-12)
    np.testing.assert_allclose(mean[-1], y.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(variance[-1], y.var(axis=0), rtol=1e-12)


@pytest.mark.parametrize("full", [False, True])
def test_the_recursion_is_that_of_the_paper_and_takes_an_endless_stream(full):
    rng = np.random.default_rng(1)
    mu, nu = rng.normal(size=(2, 2, 3))
    A = rng.uniform(-0.9, 0.9, (2, 3, 3) if full else (2, 3))
    rows = [1, 0, 0, 1]
    want = [mu[1]]
    for p in rows[1:]:
        step = A[p] @ want[-1] if full else A[p] * want[-1]
        want.append(step + nu[p])
    endless = itertools.chain(rows, itertools.repeat(0))
    got = list(itertools.islice(recursion(endless, mu, A, nu), 4))
    np.testing.assert_allclose(got, want, rtol=1e-13)
    got[0][:] = 0  # what a caller does to a frame changes neither the model nor the next frame
    np.testing.assert_array_equal(mu[1], want[0])
    assert list(recursion(iter(()), mu, A, nu)) == []


def test_a_frame_that_was_changed_does_not_change_the_next():
    A, mu, nu = np.full((1, 2), 0.5), np.ones((1, 2)), np.zeros((1, 2))
    frames = recursion([0, 0], mu, A, nu)
    next(frames)[:] = 100
    np.testing.assert_array_equal(next(frames), [0.5, 0.5])


def test_log_normal_is_scipys():
    from scipy.stats import norm

    rng = np.random.default_rng(2)
    residual, variance = rng.normal(size=(4, 3)), rng.uniform(0.1, 2, 3)
    want = norm(scale=np.sqrt(variance)).logpdf(residual).sum()
    np.testing.assert_allclose(log_normal(residual, variance), want, rtol=1e-13)


def test_batches_hold_every_frame_once_longest_first():
    rng = np.random.default_rng(3)
    lengths = [3, 9, 1, 9, 4]
    data = check_labelled(
        [rng.normal(size=(n, 2)) for n in lengths], [["a", "b", "a", "c"][:1] * n for n in lengths]
    )
    parts = batches(data, frames=18)
    assert [part.y.shape[:2] for part in parts] == [(2, 9), (3, 4)]
    for part in parts:
        for i, s in enumerate(part.order):
            np.testing.assert_array_equal(part.y[i][part.real[i]], data.y[s])
            np.testing.assert_array_equal(part.rows[i][part.real[i]], data.rows[s])
        np.testing.assert_array_equal(part.active, part.real.sum(axis=0))
    assert sorted(np.concatenate([part.order for part in parts])) == list(range(5))
    assert len(batches(data, frames=1)) == 5


def test_rows_that_start_and_that_are_entered():
    data = check_labelled([np.zeros((3, 1)), np.zeros((1, 1))], ["abc", "d"])
    assert starting_rows(data).tolist() == [0, 3]
    assert entered_rows(data).tolist() == [1, 2]
    alone = Labelled(data.y[1:], data.labels, data.rows[1:])
    assert entered_rows(alone).tolist() == []
