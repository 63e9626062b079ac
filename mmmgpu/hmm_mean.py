"""The mean of a hidden Markov model whose states are known: every frame is its label's mean.

p(y_t | pi_t) = N(mu_pi, Sigma_pi), Sigma diagonal, each frame apart. The plainest of the models of
`mmmgpu.dynamics`: what is generated jumps where the label changes.

Source: Englebienne, Cootes & Rattray (NIPS 2007), sections 2 and 4.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from mmmgpu.flat_records import tensor
from mmmgpu.labelled import (
    Floats,
    check_labelled,
    check_sequence,
    find_rows,
    gaussians,
    log_normal,
    row_finder,
)


@dataclass(frozen=True)
class HmmMean:
    """N(mu_p, diag sigma2_p) for every label p, and last for all frames.

    Attributes:
        labels: The P labels, sorted.
        mean: mu [features], shape (P + 1, d).
        variance: sigma2 [features squared], shape (P + 1, d).
    """

    labels: tuple[str, ...]
    mean: Annotated[Floats, tensor("Qd")]
    variance: Annotated[Floats, tensor("Qd", rule="above zero")]
    comparable: ClassVar[bool] = True

    @classmethod
    def fit(cls, sequences: Sequence[ArrayLike], labels: Sequence[Sequence[str]]) -> HmmMean:
        """Maximum likelihood; arguments and errors are those of `labelled.check_labelled`."""
        data = check_labelled(sequences, labels)
        return cls(data.labels, *gaussians(data))

    def generate(self, labels: Iterable[str]) -> Iterator[Floats]:
        """The most likely frame (d,) for each label, as they come."""
        return (self.mean[p].copy() for p in map(row_finder(self.labels), labels))

    def sample(self, labels: Sequence[str], rng: np.random.Generator) -> Floats:
        """A sequence drawn from the model, shape (T, d)."""
        rows = find_rows(self.labels, labels)
        noise = rng.standard_normal((len(rows), self.mean.shape[1]))
        return np.asarray(self.mean[rows] + np.sqrt(self.variance[rows]) * noise)

    def log_likelihood(self, sequence: ArrayLike, labels: Sequence[str]) -> float:
        """log p(y | pi) of a sequence (T, d) [nats]; errors are those of `check_sequence`."""
        y, rows = (
            check_sequence(sequence, labels, d=self.mean.shape[1]),
            find_rows(self.labels, labels),
        )
        return log_normal(y - self.mean[rows], self.variance[rows])
