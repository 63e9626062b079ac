"""Brand's model: Gaussians on features and their differences, and the most likely trajectory.

With delta y_t = y_t - y_{t-1}, one Gaussian a label for each of the two, all diagonal; y minimises

    sum_t (y_t - mu)' S^-1 (y_t - mu) + sum_{t>1} (delta y_t - m)' V^-1 (delta y_t - m)

with mu, S, m and V those of pi_t: a tridiagonal system for each dimension. The whole sentence must
be known before its first frame. It is no distribution of y: features and differences are counted
as if they were independent, so it cannot be sampled, and its likelihood is not comparable.

Sources: Brand, "Voice puppetry" (SIGGRAPH 1999), as told by Englebienne, Cootes & Rattray (NIPS
2007), section 3. In both papers each Gaussian is one of the 2 d numbers together.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solveh_banded

from mmmgpu.flat_records import tensor
from mmmgpu.labelled import Floats, Labelled, check_labelled, entered_rows, find_rows, gaussians


@dataclass(frozen=True)
class Brand:
    """Gaussians of features and of differences for every label, and last for all frames.

    Attributes:
        labels: The P labels, sorted.
        mean, variance: mu, diag S [features, squared], shape (P + 1, d).
        step_mean, step_variance: m, diag V [features a frame, squared], shape (P + 1, d).
    """

    labels: tuple[str, ...]
    mean: Annotated[Floats, tensor("Qd")]
    variance: Annotated[Floats, tensor("Qd", rule="above zero")]
    step_mean: Annotated[Floats, tensor("Qd")]
    step_variance: Annotated[Floats, tensor("Qd", rule="above zero")]
    comparable: ClassVar[bool] = False

    @classmethod
    def fit(cls, sequences: Sequence[ArrayLike], labels: Sequence[Sequence[str]]) -> Brand:
        """Pool the frames of each label; arguments and errors are those of `check_labelled`."""
        data = check_labelled(sequences, labels)
        return cls(data.labels, *gaussians(data), *_step_gaussians(data))

    def generate(self, labels: Iterable[str]) -> Iterator[Floats]:
        """The frames (d,) of the most likely trajectory; the first comes after the last label."""
        rows = find_rows(self.labels, labels)
        if len(rows) == 0:
            return
        pull, push = 1 / self.variance[rows], 1 / self.step_variance[rows]
        push[0] = 0  # there is no difference before the first frame
        force = push * self.step_mean[rows]
        later = np.concatenate([push[1:], np.zeros_like(push[:1])])
        band = np.stack([-push, pull + push + later])  # (2, T, d), upper form
        right = pull * self.mean[rows] + force
        right[:-1] -= force[1:]
        # dimensions laid end to end are one system: the first of each is coupled to none before
        y = solveh_banded(band.swapaxes(1, 2).reshape(2, -1), right.T.ravel(), check_finite=False)
        yield from y.reshape(right.T.shape).T.copy()


def _step_gaussians(data: Labelled) -> tuple[Floats, Floats]:
    """Mean and variance of the differences at each label's frames, shape (P + 1, d) each.

    A label without any (of first frames only) has those of all frames.
    """
    steps = tuple(np.diff(y, axis=0) for y in data.y)
    rows = tuple(r[1:] for r in data.rows)
    if sum(map(len, steps)) == 0:  # sequences of one frame: no step
        still = np.zeros((len(data.labels) + 1, data.y[0].shape[1]))
        return still, gaussians(data)[1]
    entered = entered_rows(data)
    own = tuple(data.labels[p] for p in entered)
    within = tuple(np.searchsorted(entered, r) for r in rows)
    moved = replace(data, y=steps, labels=own, rows=within)
    found = gaussians(moved)
    place = np.full(len(data.labels) + 1, len(entered))
    place[entered] = np.arange(len(entered))
    return found[0][place], found[1][place]
