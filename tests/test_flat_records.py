from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pytest

from mmmgpu.errors import InputError
from mmmgpu.flat_records import record_of, tensor, tensors_of


@dataclass(frozen=True)
class Thing:
    """Something with every kind of field."""

    labels: tuple[str, ...]
    mean: Annotated[np.ndarray, tensor("Qd")]
    spread: Annotated[np.ndarray, tensor("Qd", "Qdd", rule="definite")]
    A: Annotated[np.ndarray, tensor("Qd", "Qdd", rule="stable")]
    scale: Annotated[np.ndarray, tensor("d", rule="above zero")]
    order: Annotated[np.ndarray, tensor("1", dtype="i8")]


def good(*, full=False):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 2, 2))
    return {
        "mean": rng.normal(size=(3, 2)),
        "spread": root @ root.swapaxes(1, 2) + np.eye(2) if full else np.ones((3, 2)),
        "A": np.full((3, 2, 2), 0.4) if full else np.full((3, 2), -0.9),
        "scale": np.ones(2),
        "order": np.array([4]),
    }


@pytest.mark.parametrize("full", [False, True])
def test_a_record_is_made_of_its_tensors_and_gives_them_back(full):
    tensors = good(full=full)
    thing = record_of(Thing, ["a", "b"], tensors)
    assert thing.labels == ("a", "b")
    assert tensors_of(thing).keys() == tensors.keys()
    for name, array in tensors_of(thing).items():
        np.testing.assert_array_equal(array, tensors[name])


FAULTS = {
    "missing": ({"A": None}, "tensor A is missing"),
    "a row less": ({"mean": np.zeros((2, 2))}, r"mean must be float64 \(3, d\), is .* \(2, 2\)"),
    "another d": ({"scale": np.ones(3)}, r"scale must be float64 \(2\), is"),
    "an axis more": ({"mean": np.zeros((3, 2, 2))}, "mean must be"),
    "no d": ({"mean": np.zeros((3, 0))}, "mean must be"),
    "float32": ({"mean": np.zeros((3, 2), np.float32)}, "is float32"),
    "NaN": ({"mean": np.full((3, 2), np.nan)}, "mean holds NaN"),
    "variance zero": ({"spread": np.zeros((3, 2))}, "spread must be positive definite"),
    "singular": ({"spread": np.ones((3, 2, 2))}, "spread must be positive definite"),
    "skew": ({"spread": np.eye(2) + [[0, 0.1], [0, 0]] * np.ones((3, 1, 1))}, "spread must be pos"),
    "A of 1": ({"A": np.ones((3, 2))}, "A must be below 1"),
    "eigenvalue of 1": ({"A": np.full((3, 2, 2), 0.5)}, "A must be below 1"),
    "zero": ({"scale": np.array([1.0, 0.0])}, "scale must be above zero"),
    "a number for a row": ({"order": np.array(4)}, r"order must be int64 \(1\)"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_bad_tensor_is_named(fault):
    change, message = FAULTS[fault]
    tensors = {n: a for n, a in (good() | change).items() if a is not None}
    with pytest.raises(InputError, match=message):
        record_of(Thing, ["a", "b"], tensors)


@pytest.mark.parametrize("labels", [None, "ab", [], ["a", "a"], ["a", 1], {"a": 1}])
def test_labels_are_different_strings(labels):
    with pytest.raises(InputError, match="labels must be"):
        record_of(Thing, labels, good())
