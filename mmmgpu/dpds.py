"""Deterministic process dynamical system (DPDS): a trajectory without noise, seen through noise.

    x_1 = mu_pi1,   x_t = A_pit x_{t-1} + nu_pit,   y_t = x_t + v_t,   v_t ~ N(0, R)

with A diagonal and R diagonal and shared by all labels, the first frame's too (Sigma = R). The
labels alone determine x: it is what is generated. Every dimension is apart.

mu and nu are exact for given A, by `mmmgpu.dpds_equations`; what is left is a function of A alone,
whose gradient drives L-BFGS within |A| <= `LARGEST_A`: beyond 1 a long phone overflows. A label
that starts no sequence takes its mean for mu; one that is never entered relaxes to its mean, as
fast as all do.

Source: Englebienne, Cootes & Rattray (NIPS 2007), section 3 and Appendix A.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from mmmgpu.dpds_equations import Parameters, profile, trajectories
from mmmgpu.errors import UnsettledWarning
from mmmgpu.flat_records import tensor
from mmmgpu.labelled import (
    LARGEST_A,
    Batch,
    Floats,
    Labelled,
    batches,
    check_labelled,
    check_sequence,
    entered_rows,
    gaussians,
    log_normal,
    recursion,
    row_finder,
    starting_rows,
)
from mmmgpu.phonemes import positive

NOISE_FLOOR = 1e-6  # of the variance of all frames: the least that R may be
FIRST_A = 0.7  # where the descent starts
SPAN = 10  # iterations: one may gain little, and the next one much
TOLERANCE = 1e-4  # the descent ends where a span gains less [nats a frame and dimension]
MEMORY = 30  # steps that L-BFGS learns the curvature from: all dimensions share them
NO_OTHER_END = {"ftol": 0.0, "gtol": 0.0}  # or where nothing at all is gained
BATCH_FRAMES = 50_000


@dataclass(frozen=True)
class Dpds:
    """A recursion for every label, and last one for all frames.

    Attributes:
        labels: The P labels, sorted.
        mu, nu: Start and bias [features], shape (P + 1, d).
        A: Transition, diagonal, all |A| < 1, shape (P + 1, d).
        R: Output noise, diagonal [features squared], shape (d,).
    """

    labels: tuple[str, ...]
    mu: Annotated[Floats, tensor("Qd")]
    A: Annotated[Floats, tensor("Qd", rule="stable")]
    nu: Annotated[Floats, tensor("Qd")]
    R: Annotated[Floats, tensor("d", rule="above zero")]
    comparable: ClassVar[bool] = True

    @classmethod
    def fit(cls, sequences: Sequence[ArrayLike], labels: Sequence[Sequence[str]]) -> Dpds:
        """Maximum likelihood; arguments and errors are those of `labelled.check_labelled`."""
        return descend(check_labelled(sequences, labels))[0]

    def generate(self, labels: Iterable[str]) -> Iterator[Floats]:
        """The frame x_t (d,) for each label, as they come."""
        rows = map(row_finder(self.labels), labels)
        return recursion(rows, list(self.mu), list(self.A), list(self.nu))

    def sample(self, labels: Sequence[str], rng: np.random.Generator) -> Floats:
        """A sequence drawn from the model, shape (T, d)."""
        x = np.array(list(self.generate(labels))).reshape(-1, len(self.R))
        return np.asarray(x + np.sqrt(self.R) * rng.standard_normal(x.shape))

    def log_likelihood(self, sequence: ArrayLike, labels: Sequence[str]) -> float:
        """log p(y | pi) of a sequence (T, d) [nats]; errors are those of `check_sequence`."""
        y = check_sequence(sequence, labels, d=len(self.R))
        return log_normal(y - np.array(list(self.generate(labels))), self.R)


def descend(data: Labelled, *, iterations: int = 1000) -> tuple[Dpds, list[float]]:
    """Fit a DPDS: L-BFGS over A, with mu and nu exact at each step.

    Args:
        data: What to fit.
        iterations: Of L-BFGS, at most; an `UnsettledWarning` says that they were too few.

    Returns:
        The model, and -log p(y) [nats a frame and dimension] at the best R, up to a constant, at
        the start and after each iteration.
    """
    from scipy.optimize import OptimizeResult, minimize

    P, d, n = len(data.labels), data.y[0].shape[1], len(data.frames)
    parts = batches(data, frames=BATCH_FRAMES)
    variance = positive(data.frames.var(axis=0))

    def objective(flat: Floats) -> tuple[float, Floats]:
        error, slope, _ = profile(flat.reshape(P, d), parts)
        share = error / (n * variance) + NOISE_FLOOR  # without unit, as A is
        return float(0.5 * np.log(share).mean()), (0.5 / (n * d * variance) * slope / share).ravel()

    start = np.full(P * d, FIRST_A)
    history = [objective(start)[0]]

    def settle(intermediate_result: OptimizeResult) -> None:
        history.append(float(intermediate_result.fun))
        if len(history) > SPAN and history[-1 - SPAN] - history[-1] < TOLERANCE:
            raise StopIteration

    found = minimize(
        objective,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=[(-LARGEST_A, LARGEST_A)] * (P * d),
        callback=settle,
        options={"maxiter": iterations, "maxfun": 20 * iterations, "maxcor": MEMORY} | NO_OTHER_END,
    )
    if found.nit >= iterations:
        warnings.warn(
            UnsettledWarning(f"dpds: still gaining after {iterations} iterations"), stacklevel=2
        )
    A = found.x.reshape(P, d)
    return _completed(data, profile(A, parts)[2], parts, NOISE_FLOOR * variance), history


def _completed(data: Labelled, best: Parameters, parts: Sequence[Batch], floor: Floats) -> Dpds:
    """The model: undetermined parameters filled in, the pooled row, and R."""
    mean, _ = gaussians(data)
    count = np.bincount(np.concatenate(data.rows), minlength=len(data.labels))
    A = np.concatenate([best.A, np.average(best.A, axis=0, weights=count)[None]])
    entered = entered_rows(data)
    never = np.setdiff1d(np.arange(len(A)), entered)
    A[never] = A[-1]
    nu, mu = (1 - A) * mean, mean.copy()
    nu[entered] = best.nu[entered]
    starts = starting_rows(data)
    mu[starts] = best.mu[starts]
    R = np.maximum(_noise(best, parts), floor)
    return Dpds(data.labels, mu, A, nu, R)


def _noise(best: Parameters, parts: Sequence[Batch]) -> Floats:
    """R = sum over s and t >= 2 of (y - x)^2 / sum over s of (T_s - 1)."""
    total, frames = np.zeros(best.A.shape[1]), 0
    for batch in parts:
        later = batch.real[:, 1:]
        residual = (batch.y - trajectories(best, batch))[:, 1:][later]
        total += (residual**2).sum(axis=0)
        frames += len(residual)
    return total / max(frames, 1)
