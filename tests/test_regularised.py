import numpy as np
import pytest
from oracles_dynamics import drawn_labels
from oracles_trajectories import dense_trajectory

from mmmgpu.dynamics import trajectory
from mmmgpu.errors import InputError
from mmmgpu.phonemes import Utterance
from mmmgpu.regularised import Regularised
from mmmgpu.trajectories import synthesize_trajectory
from mmmgpu.trajectory_training import fit_stream


@pytest.fixture(scope="module")
def data():
    rng = np.random.default_rng(0)
    labels = drawn_labels(rng, 4, length=(10, 14))
    return [rng.normal(size=(len(own), 2)).cumsum(axis=0) for own in labels], labels


@pytest.fixture(scope="module")
def model(data):
    return Regularised.fit(*data)


def test_it_is_the_stream_that_train_fits(data, model):
    utterances = [Utterance(y, own) for y, own in zip(*data, strict=True)]
    stream = fit_stream(utterances, rng=np.random.default_rng(0), folds=2)
    labels = list("abca")
    want = synthesize_trajectory(
        stream.trained, labels, smoothness=stream.smoothness, order=stream.constants.order
    )
    np.testing.assert_array_equal(trajectory(model, labels), want)


def test_the_trajectory_is_that_of_a_dense_solve_and_unseen_labels_are_pooled(data, model):
    labels = ["a", "no phone", "no phone", "b"]
    rows = {"a": 0, "no phone": 3, "b": 1}
    for j in range(2):
        mean, variance = (
            {k: m[p, j] for k, p in rows.items()} for m in (model.mean, model.variance)
        )
        want = dense_trajectory(
            labels, [0, 1, 1, 2], mean, variance, model.smoothness[j], int(model.order[0])
        )
        np.testing.assert_allclose(trajectory(model, labels)[:, j], want, rtol=1e-9)
    np.testing.assert_allclose(model.mean[-1], np.concatenate(data[0]).mean(axis=0), rtol=1e-12)


def test_one_sequence_of_one_label_has_no_folds():
    with pytest.raises(InputError, match="single segment cannot be divided"):
        Regularised.fit([np.ones((5, 1))], [["a"] * 5])
