"""EGP02's regularised trajectories as one of the models of `mmmgpu.dynamics`.

It is what `train` fits and `speak` uses (`mmmgpu.trajectories`, `mmmgpu.trajectory_training`), in
the form that lets it be compared with the others. The whole sentence must be known before its first
frame. It is no distribution of y that could be sampled, and has no likelihood to be compared.

Sources: Ezzat, Geiger & Poggio (SIGGRAPH 2002) as summarised by Chang & Ezzat (SCA 2005), section
3.2.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mmmgpu.flat_records import tensor
from mmmgpu.labelled import (
    POOLED,
    Floats,
    check_labelled,
    find_rows,
    gaussians,
)
from mmmgpu.phonemes import PhonemeModels
from mmmgpu.trajectories import synthesize_trajectory
from mmmgpu.trajectory_training import fit_stream


@dataclass(frozen=True)
class Regularised:
    """Gaussians of the labels, and last of all frames, with what Eq. 3 needs beside them.

    Attributes:
        labels: The P labels, sorted.
        mean, variance: mu, sigma2 [features, squared], shape (P + 1, d).
        smoothness: lambda [1/features squared], shape (d,).
        order: k, shape (1,).
    """

    labels: tuple[str, ...]
    mean: Annotated[Floats, tensor("Qd")]
    variance: Annotated[Floats, tensor("Qd", rule="above zero")]
    smoothness: Annotated[Floats, tensor("d", rule="above zero")]
    order: Annotated[NDArray[np.int64], tensor("1", rule="above zero", dtype="i8")]
    comparable: ClassVar[bool] = False

    @classmethod
    def fit(
        cls,
        sequences: Sequence[ArrayLike],
        labels: Sequence[Sequence[str]],
        *,
        seed: int = 0,
        folds: int = 2,
    ) -> Regularised:
        """Pool, choose the constants by folds inside the sequences, and train.

        Args:
            sequences, labels: As for `labelled.check_labelled`, whose errors these are.
            seed, folds: Of the choice of constants. `train` has more folds: here many models are
                fitted, and the constants are a choice among few.

        Raises:
            InputError: Also if a single sequence of a single label is given: it has no folds.
        """
        data = check_labelled(sequences, labels)
        rng = np.random.default_rng(seed)
        stream = fit_stream(data.utterances, rng=rng, folds=folds)
        mean, variance = gaussians(data)
        return cls(
            data.labels,
            np.concatenate([stream.trained.mean, mean[-1:]]),
            np.concatenate([stream.trained.variance, variance[-1:]]),
            stream.smoothness,
            np.array([stream.constants.order]),
        )

    def generate(self, labels: Iterable[str]) -> Iterator[Floats]:
        """The frames (d,) of Eq. 3; the first comes after the last label."""
        names = (*self.labels, POOLED)
        models = PhonemeModels(names, self.mean, self.variance, np.ones(len(names), np.int64))
        said = [names[p] for p in find_rows(self.labels, labels)]
        yield from synthesize_trajectory(
            models, said, smoothness=self.smoothness, order=int(self.order[0])
        )
