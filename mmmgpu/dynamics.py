"""Models of how features move with labels, all behind one interface: fit, generate, save, load.

    hmm    `mmmgpu.hmm_mean`     the label's mean in every frame
    brand  `mmmgpu.brand`        static and delta features, the most likely trajectory
    slds   `mmmgpu.slds`         linear system a label, process and output noise
    dpds   `mmmgpu.dpds`         the same without process noise
    egp02  `mmmgpu.regularised`  regularised trajectories

and, much slower, slds-full: slds with matrices in place of diagonals.

All are fitted to sequences (T_s, d) with one label a frame: AAM parameters, alpha or beta alike.
What they are, what they do with labels they have not seen, and what was measured: docs/dynamics.md.

Source: Englebienne, Cootes & Rattray (NIPS 2007).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from mmmgpu.brand import Brand
from mmmgpu.dpds import Dpds
from mmmgpu.errors import InputError
from mmmgpu.flat_records import record_of, tensors_of
from mmmgpu.hmm_mean import HmmMean
from mmmgpu.labelled import Floats
from mmmgpu.regularised import Regularised
from mmmgpu.slds import FullSlds, Slds
from mmmgpu.tensor_files import Facts, FileKind, Tensors, read_tensors, write_tensors

KIND = FileKind("mmmgpu-dynamics", 1, "model of movement", "save_dynamics", "fit the model again")


class Dynamics(Protocol):
    """A model of features in R^d that move with labels; a frozen record of arrays.

    Attributes:
        labels: The labels it was fitted to, sorted.
        comparable: Whether it is a distribution of the features: then it is `Generative`. If not,
            it cannot be sampled and no likelihood of it can be compared with others.
    """

    comparable: ClassVar[bool]

    @property
    def labels(self) -> tuple[str, ...]: ...

    @classmethod
    def fit(cls, sequences: Sequence[ArrayLike], labels: Sequence[Sequence[str]]) -> Dynamics:
        """Fit to S sequences (T_s, d) with T_s labels each.

        Raises:
            InputError: As `mmmgpu.labelled.check_labelled`.
        """
        ...

    def generate(self, labels: Iterable[str]) -> Iterator[Floats]:
        """One frame (d,) for every label.

        Of comparable models each comes as soon as its label does, and memory does not grow: labels
        may have no end. The others need the last label before the first frame. A label that was not
        fitted has a stand-in: see `mmmgpu.labelled.stand_ins`.
        """
        ...


@runtime_checkable
class Generative(Dynamics, Protocol):
    """A model that is a distribution of the features."""

    def sample(self, labels: Sequence[str], rng: np.random.Generator) -> Floats:
        """A sequence drawn from the model, shape (T, d)."""
        ...

    def log_likelihood(self, sequence: ArrayLike, labels: Sequence[str]) -> float:
        """log p(y | labels) of a sequence (T, d) [nats]."""
        ...


MODELS: dict[str, type[Dynamics]] = {
    "hmm": HmmMean,
    "brand": Brand,
    "slds": Slds,
    "dpds": Dpds,
    "egp02": Regularised,
    "slds-full": FullSlds,
}
FIVE = ("hmm", "brand", "slds", "dpds", "egp02")  # what is fitted where nothing else is asked for


def trajectory(model: Dynamics, labels: Sequence[str]) -> Floats:
    """All frames that `model` generates for `labels`, shape (T, d) with T >= 1."""
    return np.stack(list(model.generate(labels)))


def save_dynamics(model: Dynamics, path: str | os.PathLike[str]) -> None:
    """Write `model` to one safetensors file, whole or not at all."""
    write_tensors(path, KIND, facts_of(model), tensors_of(model))


def load_dynamics(path: str | os.PathLike[str]) -> Dynamics:
    """Read the model at `path`.

    Raises:
        InputError: No such file, not such a model, truncated, of a newer version, or with tensors
            that are missing, misshapen, not finite, or not what the model needs.
    """
    return read_tensors(path, KIND, _checked)


def _checked(path: Path, tensors: Tensors, facts: Facts) -> Dynamics:
    try:
        return model_of(facts, tensors)
    except InputError as e:
        raise InputError(f"{path}: {e}; {KIND.remedy}") from e


def facts_of(model: Dynamics) -> dict[str, Any]:
    """What of `model` is no array: its name in `MODELS` and its labels."""
    (name,) = (name for name, kind in MODELS.items() if type(model) is kind)
    return {"model": name, "labels": list(model.labels)}


def model_of(facts: Mapping[str, Any], tensors: Mapping[str, Any]) -> Dynamics:
    """The model that `facts_of` and `flat_records.tensors_of` were taken from.

    Raises:
        InputError: They are not those of a model.
    """
    name = facts.get("model")
    if not isinstance(name, str) or name not in MODELS:
        raise InputError(f"model is {name!r}, not one of {', '.join(MODELS)}")
    return record_of(MODELS[name], facts.get("labels"), tensors)
