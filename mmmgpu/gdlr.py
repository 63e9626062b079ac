"""Gradient descent linear regression (GDLR): the means of each regression class moved together.

One matrix R_g, d x (d + 1), for each class g of a stream, from [0 | I], moves the means of its
phones,

    mu_p^adapt = R_g xi_p,    xi_p = [1, mu_p]',

so that the trajectories y of Eq. 15 (Eq. 3 with these means) meet the real ones z. Eq. 17 descends
E = |z - y|^2, summed over all frames, utterances and dimensions:

    R_g <- R_g - eta_g dE/dR_g,    dE/dR_g = sum over p in g of (dE/dmu_p) xi_p'.

Eq. 16 solves a system for every entry of R_g; the adjoint gives them all by one more solve (see
`trajectories.System`), and as Sigma does not move, A is factored once for all iterations, and where
it couples no dimensions dE/dmu is linear with one matrix for all of them.

The paper's eta is one small number, which suits neither the length of the corpus nor the scale of
the coordinates. Were y as free as mu, E would curve along row j of R_g by

    H_g = 2 sum over t in g of xi_t xi_t',

and R_gj <- R_gj - eta' H_g^-1 dE/dR_gj with eta' in (0, 1] never ascends (eta'/L_g with L_g the
largest eigenvalue would not either, but hardly moves along the smaller ones). xi has at most as
many values as the class has phones, so H_g is damped by 2 r I, as if by r frames more; and one may
hold all of R_g but the bias and the diagonal, as in MLLR. But y is not free: where phones of small
and large variance meet, smoothing passes more on than it gets, and E curves by up to c_j H_g in
dimension j. So the step is eta' H_g^-1 / max(c_j, 1), with c_j from a few power iterations.

xi mixes the pure number 1 with coordinates of some scale. With these steps the coordinates are
measured in the stream's own units, (mu - m)/s (`standard_units`), in which Eq. 15 is the same.

Source: CE05 = Chang & Ezzat, "Transferable Videorealistic Speech Animation" (SCA 2005), 5.3.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mmmgpu.errors import InputError
from mmmgpu.phonemes import PhonemeModels
from mmmgpu.trajectories import System

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

POWER_ITERATIONS = 10  # find c_j to a quarter; descent would bear half
DIVERGED = 1e100  # [model coordinates] no mean is that large
SHAPES: Final = ("diagonal", "full")  # what is free in R_g
DAMPING = 3.0  # r, in frames

Metric = tuple[dict[str, Any], Array]  # constants as JSON values, (G, d, d + 1, d + 1)


def bounded_metrics(system: System, mean: Array, class_of: Rows) -> Iterator[Metric]:
    """H_g^-1 / max(c_j, 1), for either shape; 0 for a class without frames."""
    for shape in SHAPES:
        roots = curvature_roots(system.line.phone, mean, class_of, shape=shape)
        c = np.broadcast_to(gain(system, mean, class_of, roots), mean.shape[1])
        yield {"shape": shape}, roots @ roots / np.maximum(c, 1)[:, None, None]


def paper_metrics(_: System, mean: Array, class_of: Rows) -> Iterator[Metric]:
    """I: eta is the rate, as in Eq. 17."""
    size = class_of.max() + 1, mean.shape[1]
    yield {}, np.broadcast_to(np.eye(size[1] + 1), (*size, size[1] + 1, size[1] + 1))


def standard_units(models: PhonemeModels) -> tuple[Array, float]:
    """m (d,), the mean of all frames, and s, the RMS distance of a frame from its phone's mean."""
    centre = np.average(models.mean, axis=0, weights=models.count)
    return centre, float(np.sqrt(models.typical_variance.mean()))


def paper_units(models: PhonemeModels) -> tuple[Array, float]:
    """0 and 1: the coordinates as they are, as in the paper."""
    return np.zeros(models.mean.shape[1]), 1.0


@dataclass(frozen=True)
class Rule:
    """How steps are taken: R_gj <- R_gj - rate metric_gj dE/dR_gj.

    Attributes:
        metrics: to choose from, before the rate; given a system, the means in these units, (P, d),
            and the class of each phone.
        units: (m, s) of the coordinates (mu - m)/s that are descended in.
        rates: to choose from where none are given.
    """

    metrics: Callable[[System, Array, Rows], Iterator[Metric]]
    units: Callable[[PhonemeModels], tuple[Array, float]]
    rates: tuple[float, ...]


RULES: Final = MappingProxyType(
    {
        "bounded": Rule(bounded_metrics, standard_units, (0.3,)),
        "paper": Rule(paper_metrics, paper_units, (0.005,)),
    }
)


@dataclass(frozen=True)
class Descent:
    """What GDLR may try.

    Attributes:
        rule: "bounded": steps by the curvature of each class. "paper": one eta for all.
        rates: eta' in (0, 1], or the paper's eta > 0, to choose from. Empty: those of the rule.
        iterations: The most to take.
    """

    rule: str = "bounded"
    rates: tuple[float, ...] = ()
    iterations: int = 30

    def __post_init__(self) -> None:
        if self.rule not in RULES:
            raise InputError(f"rule: must be one of {', '.join(RULES)}, got {self.rule!r}")
        if self.iterations < 0:
            raise InputError(f"iterations: must not be negative, got {self.iterations}")
        most = 1 if self.rule == "bounded" else np.inf
        if not all(0 < rate <= most for rate in self.rates):
            raise InputError(
                f"rates: must be above 0 and at most {most:g} with the rule {self.rule}, "
                f"got {self.rates}"
            )


DESCENT: Final = Descent()


def descend_means(
    system: System, mean: Array, z: Array, class_of: Rows, *, metric: Array, iterations: int = 30
) -> Array:
    """Eq. 17 from R_g = [0 | I]: the adapted means after each iteration.

    Args:
        system: Eq. 3 of the adaptation clips, N frames.
        mean: mu_p before, shape (P, d).
        z: Real trajectories, shape (N, d).
        class_of: Class of each phone, shape (P,).
        metric: What takes a slope to a step, of each class and dimension, shape
            (G, d, d + 1, d + 1): a rate times that of a rule.
        iterations: The most to take.

    Returns:
        Means, shape (iterations + 1, P, d), the first those before. Fewer where the descent
        diverged.
    """
    R = identity_regressions(len(metric), mean.shape[1])
    path = [mean]
    slope_of = system.slope_of(z)
    for _ in range(iterations):
        by_mean = slope_of(regressed(R, mean, class_of))
        R = R - _applied(metric, _by_class(by_mean, mean, class_of, len(R)))
        moved = regressed(R, mean, class_of)
        if np.abs(moved).max() > DIVERGED:
            break
        path.append(moved)
    return np.stack(path)


def identity_regressions(n_classes: int, n_dims: int) -> Array:
    """[0 | I] of each class, shape (G, d, d + 1)."""
    return np.tile(np.eye(n_dims, n_dims + 1, 1), (n_classes, 1, 1))


def extended(mean: Array) -> Array:
    """xi_p = [1, mu_p], shape (P, d + 1)."""
    return np.hstack([np.ones((len(mean), 1)), mean])


def regressed(R: Array, mean: Array, class_of: Rows) -> Array:
    """R_g xi_p with g the class of p, shape (P, d)."""
    xi, moved = extended(mean), np.empty_like(mean)
    for g, own in _members(class_of):
        moved[own] = xi[own] @ R[g].T
    return moved


def error_and_slope(
    system: System, R: Array, mean: Array, z: Array, class_of: Rows
) -> tuple[float, Array]:
    """Eq. 4 with the means R_g xi_p, and dE/dR_g, shape (G, d, d + 1)."""
    E, by_mean = system.error_and_slope(regressed(R, mean, class_of), z)
    return E, _by_class(by_mean, mean, class_of, len(R))


def _by_class(by_mean: Array, mean: Array, class_of: Rows, n_classes: int) -> Array:
    """dE/dR_g of each class, shape (G, d, d + 1), from dE/dmu_p (P, d)."""
    xi, d = extended(mean), mean.shape[1]
    slope = np.zeros((n_classes, d, d + 1))
    for g, own in _members(class_of):
        slope[g] = by_mean[own].T @ xi[own]
    return slope


def _members(class_of: Rows) -> list[tuple[int, Rows]]:
    """Every class that has phones, and these."""
    return [(int(g), np.flatnonzero(class_of == g)) for g in np.unique(class_of)]


def curvature_roots(
    phone: Rows, mean: Array, class_of: Rows, *, shape: str, damping: float = DAMPING
) -> Array:
    """H_g^-1/2 of each class, for each dimension, shape (G, d, d + 1, d + 1).

    0 for a class without frames, and for what is not free: with the shape "diagonal", row j of R_g
    but its bias and entry j.

    Args:
        phone: Row of the phone of each frame, shape (N,).
        mean: mu_p, shape (P, d).
        class_of: Class of each phone, shape (P,).
        shape: One of `SHAPES`.
        damping: r [frames].
    """
    d = mean.shape[1]
    frames = np.bincount(phone, minlength=len(mean))
    xi = extended(mean) * np.sqrt(frames)[:, None]
    roots = np.zeros((class_of.max() + 1, d, d + 1, d + 1))
    for g in np.unique(class_of[frames > 0]):
        H = 2 * (xi[class_of == g].T @ xi[class_of == g] + damping * np.eye(d + 1))
        if shape == "full":
            roots[g] = _inverse_root(H)
            continue
        free = np.stack([np.zeros(d, np.int64), np.arange(1, d + 1)], axis=1)  # (d, 2)
        entries = np.arange(d)[:, None, None], free[:, :, None], free[:, None, :]
        roots[g][entries] = _inverse_root(H[entries[1:]])
    return roots


def _inverse_root(H: Array) -> Array:
    """H^-1/2 of positive definite matrices, (..., n, n)."""
    value, vector = np.linalg.eigh(H)
    return np.asarray(vector / np.sqrt(value)[..., None, :] @ np.swapaxes(vector, -1, -2))


def _applied(metric: Array, slope: Array) -> Array:
    """Each row of each class by its own matrix: (G, d, n, n), (G, d, n) -> (G, d, n)."""
    return np.asarray((metric @ slope[..., None])[..., 0])


def gain(system: System, mean: Array, class_of: Rows, roots: Array) -> Array:
    """c_j: how many times H_g E curves at most, all classes together, by power iteration.

    The Hessian of E in the rows j of all R_g, taken in units in which each H_g is I. Full
    covariances couple the dimensions: one c for all.

    Args:
        system, mean, class_of: As in `descend_means`.
        roots: H_g^-1/2, shape (G, d, d + 1, d + 1).

    Returns:
        c_j, shape (d,), or (1,) of full models.
    """
    of_dimension = (0, 2) if system.precision.ndim == 2 else (0, 1, 2)
    slope_of = system.slope_of(np.zeros((len(system.line.phone), mean.shape[1])))
    V = np.random.default_rng(0).normal(size=roots.shape[:3])
    for _ in range(POWER_ITERATIONS):
        V /= np.sqrt(np.sum(V**2, axis=of_dimension, keepdims=True))
        by_mean = slope_of(regressed(_applied(roots, V), mean, class_of))
        V = _applied(roots, _by_class(by_mean, mean, class_of, len(roots)))
    return np.asarray(np.sqrt(np.sum(V**2, axis=of_dimension, keepdims=True)).reshape(-1))
