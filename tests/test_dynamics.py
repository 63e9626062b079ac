import itertools
import json
import pickle
import struct
import tracemalloc
from dataclasses import fields

import numpy as np
import pytest
from oracles_dynamics import drawn_labels
from safetensors.numpy import load_file, save_file

from mmmgpu.dynamics import (
    KIND,
    MODELS,
    Generative,
    load_dynamics,
    save_dynamics,
    trajectory,
)
from mmmgpu.errors import InputError
from mmmgpu.slds import FullSlds

EVERY = pytest.mark.parametrize("name", MODELS)
STREAMING = pytest.mark.parametrize("name", ["hmm", "slds", "dpds", "slds-full"])


def corpus(seed=0, number=4, d=2):
    rng = np.random.default_rng(seed)
    labels = drawn_labels(rng, number, labels=["AA", "M", "S"], length=(10, 14))
    return [rng.normal(size=(len(own), d)).cumsum(axis=0) for own in labels], labels


@pytest.fixture(scope="module")
def fitted():
    """Each model, fitted once."""
    return {name: kind.fit(*corpus()) for name, kind in MODELS.items()}


@EVERY
def test_one_frame_comes_for_each_label(fitted, name):
    assert type(fitted[name]) is MODELS[name]
    y = trajectory(fitted[name], ["AA", "M", "M", "S"])
    assert y.shape == (4, 2)
    assert y.dtype == np.float64
    assert list(fitted[name].generate([])) == []


@EVERY
def test_the_same_twice_is_the_same_bits_and_the_data_stay(fitted, name):
    y, labels = corpus()
    before = [one.copy() for one in y]
    a, b = fitted[name], MODELS[name].fit(y, labels)
    for field in fields(a):
        np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name))
    np.testing.assert_array_equal(np.concatenate(y), np.concatenate(before))


@EVERY
def test_features_in_other_units_make_the_same_movement(fitted, name):
    y, labels = corpus()
    said, unit = ["SIL", "AA", "M", "M", "S"], 1000.0
    other = MODELS[name].fit([unit * one for one in y], labels)
    made = trajectory(fitted[name], said)
    np.testing.assert_allclose(trajectory(other, said), unit * made, rtol=1e-5, atol=1e-5 * unit)
    if isinstance(other, Generative):
        value = fitted[name].log_likelihood(y[0], labels[0]) - np.log(unit) * y[0].size
        np.testing.assert_allclose(other.log_likelihood(unit * y[0], labels[0]), value, rtol=1e-5)


def test_comparable_models_are_distributions_and_the_others_say_so(fitted):
    comparable = {name for name, model in fitted.items() if model.comparable}
    assert comparable == {"hmm", "slds", "dpds", "slds-full"}
    assert {name for name, model in fitted.items() if isinstance(model, Generative)} == comparable


@STREAMING
def test_a_sample_is_as_likely_as_the_model_expects(fitted, name):
    model, labels = fitted[name], ["AA", "M", "M", "S"]
    rng = np.random.default_rng(0)
    a, b = model.sample(labels, np.random.default_rng(3)), model.sample(labels, rng)
    assert a.shape == b.shape == (4, 2)
    assert (a != b).all()
    np.testing.assert_array_equal(a, model.sample(labels, np.random.default_rng(3)))
    values = [model.log_likelihood(model.sample(labels, rng), labels) for _ in range(300)]
    best = model.log_likelihood(trajectory(model, labels), labels)
    assert best - 4.4 < np.mean(values) < best - 3.6  # half a nat for each of 8 numbers


@EVERY
def test_unseen_labels_are_spoken_by_what_looks_alike_or_by_all(fitted, name):
    alike = trajectory(fitted[name], ["AA", "B", "Z"])
    np.testing.assert_array_equal(alike, trajectory(fitted[name], ["AA", "M", "S"]))
    strange = trajectory(fitted[name], ["no phone"] * 300)
    assert np.isfinite(strange).all()
    if name in ("hmm", "brand", "egp02", "dpds"):
        mean = np.concatenate(corpus()[0]).mean(axis=0)
        np.testing.assert_allclose(strange[150], mean, rtol=0.05)


@STREAMING
def test_a_stream_without_end_is_answered_at_once(fitted, name):
    asked = []

    def said():
        for label in itertools.cycle(["M", "AA"]):
            asked.append(label)
            yield label

    frames = fitted[name].generate(said())
    got = [next(frames) for _ in range(5)]
    assert len(asked) == 5
    np.testing.assert_array_equal(got, trajectory(fitted[name], asked))


@STREAMING
def test_memory_does_not_grow_with_the_stream(fitted, name):
    frames = fitted[name].generate(itertools.cycle(["M", "AA", "S", "S"]))
    next(frames)
    tracemalloc.start()
    for _ in itertools.islice(frames, 1000):
        pass
    early = tracemalloc.get_traced_memory()[1]
    tracemalloc.reset_peak()
    for _ in itertools.islice(frames, 90_000):  # an hour at 25 frames/s
        pass
    late = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.isfinite(next(frames)).all()
    assert late < early + 5000  # bytes; the hour itself is 1.4 MB


BAD = {
    "nothing": ([], []),
    "one label too few": ([np.ones((3, 2))], [["M", "M"]]),
    "one label too many": ([np.ones((2, 2))], [["M", "M", "M"]]),
    "NaN": ([np.full((2, 2), np.nan)], [["M", "AA"]]),
}


@EVERY
@pytest.mark.parametrize("fault", BAD)
def test_bad_data_are_refused_by_every_model(name, fault):
    with pytest.raises(InputError, match=r"^(sequences|labels).*; (give|leave)") as error:
        MODELS[name].fit(*BAD[fault])
    assert "\n" not in str(error.value)


@STREAMING
def test_a_bad_sequence_has_no_likelihood(fitted, name):
    for y, labels in ((np.ones((3, 2)), ["M"] * 2), (np.ones((2, 3)), ["M"] * 2)):
        with pytest.raises(InputError, match="sequence: "):
            fitted[name].log_likelihood(y, labels)


@EVERY
def test_a_phone_of_one_frame_and_features_that_do_not_move_can_be_fitted(name):
    y, labels = corpus()
    labels[0][5] = "ZH"
    y = [one[:, [0, 0, 0]] * [1, 0, 1] + [0, 0.25, 0] for one in y]  # singular, too
    made = trajectory(MODELS[name].fit(y, labels), ["ZH", "AA", "ZH", "ZH"])
    assert np.isfinite(made).all()
    np.testing.assert_allclose(made[:, 1], 0.25, rtol=1e-6)
    np.testing.assert_allclose(made[:, 2], made[:, 0], rtol=1e-6, atol=1e-9)


def test_full_covariances_of_singular_features_are_kept_regular():
    y, labels = corpus()
    y = [np.column_stack([one, np.zeros(len(one)), one[:, 0]]) for one in y]
    model = FullSlds.fit(y, labels)
    for covariance in (model.Sigma, model.Q, model.R):
        assert (np.linalg.eigvalsh(covariance) > 0).all()
    assert np.isfinite(trajectory(model, labels[0])).all()


@EVERY
def test_sequences_of_one_frame_are_enough_where_there_are_two(name):
    rng = np.random.default_rng(0)
    model = MODELS[name].fit(rng.normal(size=(4, 1, 2)), [["M"], ["AA"], ["M"], ["AA"]])
    assert np.isfinite(trajectory(model, ["M", "AA", "M"])).all()


# ---- files


@EVERY
def test_a_model_comes_back_bit_for_bit(fitted, tmp_path, name):
    save_dynamics(fitted[name], tmp_path / "a ü.model")
    again = load_dynamics(tmp_path / "a ü.model")
    assert type(again) is type(fitted[name])
    for field in fields(again):
        got, want = getattr(again, field.name), getattr(fitted[name], field.name)
        np.testing.assert_array_equal(got, want)
        assert np.asarray(got).dtype == np.asarray(want).dtype
    save_dynamics(again, tmp_path / "b.model")
    assert (tmp_path / "b.model").read_bytes() == (tmp_path / "a ü.model").read_bytes()


@pytest.fixture(scope="module")
def data(fitted, tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "a"
    save_dynamics(fitted["dpds"], path)
    return path.read_bytes()


BYTES = {
    "empty": lambda data: b"",
    "half": lambda data: data[: len(data) // 2],
    "one byte short": lambda data: data[:-1],
    "text": lambda data: b"I am a model.\n" * 50,
    "pickle": lambda data: pickle.dumps({"mu": [1, 2]}),
    "huge header": lambda data: struct.pack("<Q", 2**62) + data[8:],
}


@pytest.mark.parametrize("fault", BYTES)
def test_what_is_no_whole_file_is_said_on_one_line(data, tmp_path, fault):
    (tmp_path / "bad ü").write_bytes(BYTES[fault](data))
    with pytest.raises(InputError, match="bad ü: truncated, damaged or not a model") as error:
        load_dynamics(tmp_path / "bad ü")
    assert "\n" not in str(error.value)


class Bomb:
    def __reduce__(self):
        return (pytest.fail, ("the pickle was opened",))


def test_a_pickle_is_never_opened(tmp_path):
    (tmp_path / "bomb").write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(InputError, match="bomb: "):
        load_dynamics(tmp_path / "bomb")


CHANGES = {
    "newer": (
        {"version": 2},
        {},
        "format version 2.*update mmmgpu",
    ),
    "version no number": ({"version": "1"}, {}, "format version 1"),
    "another format": ({"format": "mmmgpu-model"}, {}, "not a mmmgpu model of movement"),
    "no such model": ({"model": "gpt"}, {}, "model is 'gpt', not one of hmm"),
    "model a list": ({"model": ["dpds"]}, {}, "not one of hmm"),
    "model of others": ({"model": "slds"}, {}, "tensor Sigma is missing"),
    "labels less": ({"labels": ["AA"]}, {}, r"tensor mu must be float64 \(2, d\)"),
    "labels no row": ({"labels": 3}, {}, "labels must be a row of strings"),
    "misshapen": ({}, {"A": np.zeros((4, 3))}, r"tensor A must be float64 \(4, 2\)"),
    "NaN": ({}, {"nu": np.full((4, 2), np.nan)}, "tensor nu holds NaN"),
    "unstable": ({}, {"A": np.full((4, 2), -1.0)}, "tensor A must be below 1"),
    "no noise": ({}, {"R": np.zeros(2)}, "tensor R must be above zero"),
}


@pytest.mark.parametrize("fault", CHANGES)
def test_a_bad_file_is_said_on_one_line(data, tmp_path, fault):
    facts, tensors, message = CHANGES[fault]
    path = tmp_path / "bad"
    path.write_bytes(data)
    (length,) = struct.unpack("<Q", data[:8])
    said = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["mmmgpu"])
    assert said["format"] == KIND.format
    save_file(load_file(path) | tensors, path, metadata={"mmmgpu": json.dumps(said | facts)})
    with pytest.raises(InputError, match=f"bad: .*{message}") as error:
        load_dynamics(path)
    assert "\n" not in str(error.value)


def test_a_singular_covariance_in_a_file_is_refused(tmp_path):
    model = FullSlds.fit(*corpus())
    model.Q[0] = 1
    save_dynamics(model, tmp_path / "bad")
    with pytest.raises(InputError, match="bad: tensor Q must be positive definite"):
        load_dynamics(tmp_path / "bad")


@pytest.mark.parametrize("said", ["", "[]", "3", "{"])
def test_another_safetensors_file_is_no_model(tmp_path, said):
    save_file({"x": np.zeros(2)}, tmp_path / "x", metadata={"mmmgpu": said})
    with pytest.raises(InputError, match="not a mmmgpu model of movement"):
        load_dynamics(tmp_path / "x")
    with pytest.raises(InputError, match="no such model of movement file"):
        load_dynamics(tmp_path / "y")
