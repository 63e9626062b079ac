"""Switching linear dynamical system with known labels: process noise and output noise.

    x_1 ~ N(mu, Sigma),   x_t = A x_{t-1} + nu + w_t,   y_t = x_t + v_t,  w ~ N(0, Q),  v ~ N(0, R)

where mu, Sigma, A, nu, Q and R are those of the label pi_t. B = I fixes the scale of x; nu is
explicit, so that A can be diagonal. As the labels are known, this is one linear system for each
sequence: exact EM with `mmmgpu.kalman`. What is generated is the most likely y, which is x without
noise.

Three things are ours. Sigma, Q and R are at least a small share of the features' variance; A has no
eigenvalue beyond `LARGEST_A`, without which a long phone overflows (both are constraints within the
maximum that EM climbs to, so the likelihood never goes down); and a label that starts no sequence,
or is never entered, takes mu, or A and Q, from what is known of all frames.

Source: Englebienne, Cootes & Rattray (NIPS 2007), section 3.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mmmgpu.errors import UnsettledWarning
from mmmgpu.flat_records import tensor
from mmmgpu.kalman import Posterior, System, inverse, multiply, smooth, symmetric, transpose
from mmmgpu.labelled import (
    LARGEST_A,
    Batch,
    Floats,
    Labelled,
    Rows,
    batches,
    check_labelled,
    check_labels,
    check_sequence,
    find_rows,
    gaussians,
    recursion,
    row_finder,
)
from mmmgpu.phonemes import positive, sum_by

NOISE_FLOOR = 1e-3  # of the variance of all frames: the least that Q and R may be
BATCH_NUMBERS = 4_000_000  # in the covariances of one batch


@dataclass(frozen=True)
class Slds:
    """A linear system for every label, and last one for all frames.

    Attributes:
        labels: The P labels, sorted.
        mu, nu: Start and bias [features], shape (P + 1, d).
        Sigma, Q, R: Covariance of the start, the process noise and the output noise [features
            squared]: diagonals, shape (P + 1, d), or full, (P + 1, d, d).
        A: Transition, of the same shape; no eigenvalue reaches 1.
    """

    labels: tuple[str, ...]
    mu: Annotated[Floats, tensor("Qd")]
    Sigma: Annotated[Floats, tensor("Qd", "Qdd", rule="definite")]
    A: Annotated[Floats, tensor("Qd", "Qdd", rule="stable")]
    nu: Annotated[Floats, tensor("Qd")]
    Q: Annotated[Floats, tensor("Qd", "Qdd", rule="definite")]
    R: Annotated[Floats, tensor("Qd", "Qdd", rule="definite")]
    comparable: ClassVar[bool] = True

    @classmethod
    def fit(cls, sequences: Sequence[ArrayLike], labels: Sequence[Sequence[str]]) -> Slds:
        """Maximum likelihood by EM; arguments and errors are those of `labelled.check_labelled`."""
        return climb(check_labelled(sequences, labels))[0]

    def generate(self, labels: Iterable[str]) -> Iterator[Floats]:
        """The most likely frame (d,) for each label, as they come."""
        rows = map(row_finder(self.labels), labels)
        return recursion(rows, list(self.mu), list(self.A), list(self.nu))

    def sample(self, labels: Sequence[str], rng: np.random.Generator) -> Floats:
        """A sequence drawn from the model, shape (T, d)."""
        rows, s = find_rows(self.labels, check_labels(labels)), self.system
        roots = {name: np.linalg.cholesky(getattr(s, name)) for name in ("Sigma", "Q", "R")}
        noise = rng.standard_normal((2, len(rows), *s.mu.shape[1:]))
        x = s.mu[rows[0]] + roots["Sigma"][rows[0]] @ noise[0, 0]
        states = [x]
        for t in range(1, len(rows)):
            p = rows[t]
            x = s.A[p] @ x + s.nu[p] + roots["Q"][p] @ noise[0, t]
            states.append(x)
        y = np.stack(states) + roots["R"][rows] @ noise[1]
        return np.asarray(y.reshape(len(rows), -1))

    def log_likelihood(self, sequence: ArrayLike, labels: Sequence[str]) -> float:
        """log p(y | pi) of a sequence (T, d) [nats]; errors are those of `check_sequence`."""
        return float(self._posterior(sequence, labels).log_likelihood[0])

    def smoothed(self, sequence: ArrayLike, labels: Sequence[str]) -> tuple[Floats, Floats]:
        """E x_t given all of y, shape (T, d), and its covariance, (T, d) or (T, d, d)."""
        posterior = self._posterior(sequence, labels)
        T = len(labels)
        return posterior.mean.reshape(T, -1), posterior.covariance.reshape(T, *self.A.shape[1:])

    def _posterior(self, sequence: ArrayLike, labels: Sequence[str]) -> Posterior:
        y = check_sequence(sequence, labels, d=self.mu.shape[1])
        one = Labelled((y,), self.labels, (find_rows(self.labels, labels),))
        (batch,) = batches(one, frames=len(y))
        return smooth(self.system, batch)

    @property
    def system(self) -> System:
        """The parameters in blocks: one of size d if they are full, else d of size 1."""
        names = ("mu", "Sigma", "A", "nu", "Q", "R")
        return System(*(in_blocks(getattr(self, n), full=self.A.ndim == 3) for n in names))


class FullSlds(Slds):
    """A linear system with matrices in place of diagonals: (d / 3)^2 times as slow, or worse."""

    @classmethod
    def fit(cls, sequences: Sequence[ArrayLike], labels: Sequence[Sequence[str]]) -> Slds:
        """As `Slds.fit`."""
        return climb(check_labelled(sequences, labels), full=True)[0]


def in_blocks(parameter: Floats, *, full: bool) -> Floats:
    """(Q, d) or (Q, d, d) as (Q, G, b, 1) or (Q, G, b, b)."""
    if parameter.ndim == 3:
        return parameter[:, None]
    return parameter[:, None, :, None] if full else parameter[:, :, None, None]


def climb(
    data: Labelled, *, full: bool = False, iterations: int = 1000, tolerance: float = 1e-4
) -> tuple[Slds, list[float]]:
    """EM from a start that the pooled Gaussians give.

    Args:
        data: What to fit.
        full: Fit a `FullSlds`.
        iterations: At most so many; an `UnsettledWarning` says that they were too few.
        tolerance: The climb ends when an iteration gains less [nats a frame and dimension].

    Returns:
        The model, and log p(y) [nats] before each iteration and at the end; it never goes down.
    """
    model = _start(data, full=full)
    d = data.y[0].shape[1]
    floor = NOISE_FLOOR * positive(data.frames.var(axis=0))
    least = in_blocks(np.diag(floor)[None] if full else floor[None], full=full)
    parts = batches(data, frames=max(1, BATCH_NUMBERS // (d * (d if full else 1))))
    history: list[float] = []
    for _ in range(iterations):
        found, value = _expect(model.system, parts, len(data.labels))
        history.append(value)
        if len(history) > 1 and value - history[-2] < tolerance * data.frames.size:
            return model, history
        model = _maximise(model, found, least)
    history.append(_expect(model.system, parts, len(data.labels))[1])
    warnings.warn(
        UnsettledWarning(f"slds: still gaining after {iterations} iterations"), stacklevel=2
    )
    return model, history


def _start(data: Labelled, *, full: bool) -> Slds:
    """Each label's mean, met by half in every frame."""
    mean, variance = gaussians(data)
    spread = variance[:, :, None] * np.eye(mean.shape[1]) if full else variance
    half = np.zeros_like(spread) + (np.eye(mean.shape[1]) if full else 1) / 2
    kind = FullSlds if full else Slds
    return kind(data.labels, mean, spread, half, mean / 2, spread / 4, spread / 4)


@dataclass(frozen=True)
class _Moments:
    """Sums over the posterior by row, in blocks; the last row is the sum of the others.

    n, first: frames that are entered from another one; first ones. all: both.
    x, z, xx, zz, xz: of x_t and z = x_{t-1}, over the n. first_x, first_xx: of x_1.
    noise: of (y - x)(y - x)', over all frames.
    """

    n: Floats
    first: Floats
    all: Floats
    x: Floats
    z: Floats
    xx: Floats
    zz: Floats
    xz: Floats
    first_x: Floats
    first_xx: Floats
    noise: Floats


def _expect(system: System, parts: Sequence[Batch], P: int) -> tuple[_Moments, float]:
    """The E step: moments, and log p(y)."""
    total, value = None, 0.0
    for batch in parts:
        posterior = smooth(system, batch)
        value += float(posterior.log_likelihood.sum())
        found = _moments(posterior, batch, P)
        total = found if total is None else {k: total[k] + v for k, v in found.items()}
    assert total is not None
    return _Moments(
        **{k: np.concatenate([v, v.sum(axis=0)[None]]) for k, v in total.items()}
    ), value


def _moments(posterior: Posterior, batch: Batch, P: int) -> dict[str, Floats]:
    real, begins = batch.real, np.zeros_like(batch.real)
    begins[:, 0] = True
    goes_on = real & ~begins
    m, V = posterior.mean, posterior.covariance
    y = batch.y.reshape(m.shape)
    x, z = m[goes_on], m[:, :-1][goes_on[:, 1:]]
    rows, first_rows = batch.rows[goes_on], batch.rows[:, 0]
    e = (y - m)[real]
    ones = np.ones((1, 1, 1))

    def by(row: Rows, value: Floats) -> Floats:
        flat = value.reshape(len(row), math.prod(value.shape[1:]))
        return sum_by(row, flat, P).reshape(P, *value.shape[1:])

    def count(row: Rows) -> Floats:
        return by(row, np.broadcast_to(ones, (len(row), 1, 1, 1)))

    return {
        "n": count(rows),
        "first": count(first_rows),
        "all": count(batch.rows[real]),
        "x": by(rows, x),
        "z": by(rows, z),
        "xx": by(rows, multiply_outer(x, x) + V[goes_on]),
        "zz": by(rows, multiply_outer(z, z) + V[:, :-1][goes_on[:, 1:]]),
        "xz": by(rows, multiply_outer(x, z) + posterior.cross[goes_on]),
        "first_x": by(first_rows, m[:, 0]),
        "first_xx": by(first_rows, multiply_outer(m[:, 0], m[:, 0]) + V[:, 0]),
        "noise": by(batch.rows[real], multiply_outer(e, e) + V[real]),
    }


def multiply_outer(a: Floats, b: Floats) -> Floats:
    """a b' of block vectors (..., b, 1)."""
    return a * transpose(b)


def _maximise(model: Slds, s: _Moments, least: Floats) -> Slds:
    """The M step; rows of which nothing is known keep or borrow what the module says."""
    old = model.system
    first, n, everything = (np.maximum(c, 1) for c in (s.first, s.n, s.all))
    seen_first, seen, seen_any = s.first > 0, s.n > 0, s.all > 0
    seen_first[-1] = False  # of all frames mu and Sigma stay those of the start
    mu = np.where(seen_first, s.first_x / first, old.mu)
    start = s.first_xx / first - multiply_outer(mu, mu)
    Sigma = np.where(seen_first, at_least(start, least), old.Sigma)
    x, z = s.x / n, s.z / n
    xx, zz, xz = (
        s.xx / n - multiply_outer(x, x),
        s.zz / n - multiply_outer(z, z),
        s.xz / n - multiply_outer(x, z),
    )
    known = np.where(seen, zz, np.eye(zz.shape[-1]))
    A = np.where(seen, multiply(xz, inverse(known)), old.A)
    A = _kept_stable(A, old.A)
    bent = multiply(A, transpose(xz))
    Q = at_least(xx - bent - transpose(bent) + multiply(multiply(A, zz), transpose(A)), least)
    A, Q = np.where(seen, A, A[-1]), np.where(seen, Q, Q[-1])
    own = old.mu - multiply(A, old.mu)
    nu = np.where(seen, x - multiply(A, z), own)
    R = np.where(seen_any, at_least(s.noise / everything, least), old.R)
    shapes = (model.mu, model.Sigma, model.A, model.nu, model.Q, model.R)
    new = (mu, Sigma, A, nu, Q, R)
    return type(model)(
        model.labels, *(v.reshape(o.shape) for v, o in zip(new, shapes, strict=True))
    )


def at_least(covariance: Floats, least: Floats) -> Floats:
    """The covariance of most likelihood among those not below the diagonal `least`.

    Eigenvalues in the units of `least` are raised to 1.
    """
    if covariance.shape[-1] == 1:
        return np.maximum(covariance, least)
    unit = np.sqrt(np.diagonal(least, axis1=-2, axis2=-1))
    scale = unit[..., :, None] * unit[..., None, :]
    values, vectors = np.linalg.eigh(symmetric(covariance / scale))
    raised = (vectors * np.maximum(values, 1)[..., None, :]) @ transpose(vectors)
    return np.asarray(symmetric(raised) * scale)


def _kept_stable(A: Floats, old: Floats, halvings: int = 30) -> Floats:
    """`A`, or as far towards it from `old` as no eigenvalue is beyond `LARGEST_A`.

    The likelihood that the M step raises grows all the way, so it grows up to there too.
    """

    def beyond(a: Floats) -> NDArray[np.bool_]:
        values = a[..., 0] if a.shape[-1] == 1 else np.linalg.eigvals(a)
        return np.asarray(np.abs(values).max(axis=-1)[..., None, None] > LARGEST_A)

    share, step = np.ones((*A.shape[:2], 1, 1)), 1.0
    wild = beyond(A)
    if wild.any():
        low = np.zeros_like(share)
        share = np.where(wild, 0.0, 1.0)
        for _ in range(halvings):
            step /= 2
            tried = np.where(wild, low + step, 1.0)
            low = np.where(wild & ~beyond(old + tried * (A - old)), tried, low)
        share = np.where(wild, low, 1.0)
    return old + share * (A - old)
