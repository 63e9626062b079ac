"""Gradient descent linear regression (GDLR): the means of each regression class moved together.

One matrix R_g, d x (d + 1), for each class g of a stream, from [0 | I], moves the means of its
phones,

    mu_p^adapt = R_g xi_p,    xi_p = [1, mu_p]',

so that the trajectories y of Eq. 15 (Eq. 3 with these means) meet the real ones z. Eq. 17 descends
E = |z - y|^2, summed over all frames, utterances and dimensions:

    R_g <- R_g - eta_g dE/dR_g,    dE/dR_g = sum over p in g of (dE/dmu_p) xi_p'.

Eq. 16 solves a system for every entry of R_g; the adjoint gives them all by one more solve (see
`trajectories.System`), and as Sigma does not move, A is factored once for all iterations.

The paper's eta is one small number, which suits neither the length of the corpus nor the scale of
the coordinates. Were y as free as mu, E would curve along R_g by up to

    L_g = 2 lambda_max(sum over t in g of xi_t xi_t'),

and eta_g = eta'/L_g with eta' in (0, 1] never ascends. But y is not: where phones of small and
large variance meet, smoothing passes more on than it gets, and E curves by up to c_j L_g in
dimension j. So the step is eta'/(max(c_j, 1) L_g), with c_j from a few power iterations.

xi mixes the pure number 1 with coordinates of some scale: where they are small against 1, descent
moves the bias and hardly anything else. With these steps the coordinates are measured in the
stream's own units, (mu - m)/s (`standard_units`), in which Eq. 15 is the same.

Source: CE05 = Chang & Ezzat, "Transferable Videorealistic Speech Animation" (SCA 2005), 5.3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mmmgpu.errors import InputError
from mmmgpu.phonemes import PhonemeModels
from mmmgpu.trajectories import System

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

POWER_ITERATIONS = 10  # find c_j to a quarter; descent would bear half
DIVERGED = 1e100  # [model coordinates] no mean is that large


def bounded_steps(system: System, mean: Array, class_of: Rows) -> Array:
    """1 / (max(c_j, 1) L_g), shape (G, d); 0 for a class without frames, which stays."""
    L = class_curvature(system.line.phone, mean, class_of)
    inverse = np.where(L > 0, 1 / np.where(L > 0, L, 1), 0)
    c = np.broadcast_to(gain(system, mean, class_of, inverse), mean.shape[1])
    return np.asarray(inverse[:, None] / np.maximum(c, 1))


def paper_steps(_: System, mean: Array, class_of: Rows) -> Array:
    """1 everywhere: eta is the rate, as in Eq. 17; shape (G, d)."""
    return np.ones((class_of.max() + 1, mean.shape[1]))


def standard_units(models: PhonemeModels) -> tuple[Array, float]:
    """m (d,), the mean of all frames, and s, the RMS distance of a frame from its phone's mean."""
    centre = np.average(models.mean, axis=0, weights=models.count)
    return centre, float(np.sqrt(models.typical_variance.mean()))


def paper_units(models: PhonemeModels) -> tuple[Array, float]:
    """0 and 1: the coordinates as they are, as in the paper."""
    return np.zeros(models.mean.shape[1]), 1.0


@dataclass(frozen=True)
class Rule:
    """How steps are taken.

    Attributes:
        steps: of each class and dimension, (G, d), before the rate; given a system, the means in
            these units, (P, d), and the class of each phone.
        units: (m, s) of the coordinates (mu - m)/s that are descended in.
        rates: to choose from where none are given.
    """

    steps: Callable[[System, Array, Rows], Array]
    units: Callable[[PhonemeModels], tuple[Array, float]]
    rates: tuple[float, ...]


RULES: Final = MappingProxyType(
    {
        "bounded": Rule(bounded_steps, standard_units, (0.1, 0.3, 1.0)),
        "paper": Rule(paper_steps, paper_units, (0.005,)),
    }
)


@dataclass(frozen=True)
class Descent:
    """What GDLR may try.

    Attributes:
        rule: "bounded": steps by the curvature. "paper": one eta for all.
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
    system: System, mean: Array, z: Array, class_of: Rows, *, steps: Array, iterations: int = 30
) -> Array:
    """Eq. 17 from R_g = [0 | I]: the adapted means after each iteration.

    Args:
        system: Eq. 3 of the adaptation clips, N frames.
        mean: mu_p before, shape (P, d).
        z: Real trajectories, shape (N, d).
        class_of: Class of each phone, shape (P,).
        steps: eta of each class and dimension, shape (G, d): a rate times those of a rule.
        iterations: The most to take.

    Returns:
        Means, shape (iterations + 1, P, d), the first those before. Fewer where the descent
        diverged.
    """
    R = identity_regressions(len(steps), mean.shape[1])
    path = [mean]
    for _ in range(iterations):
        R = R - steps[:, :, None] * error_and_slope(system, R, mean, z, class_of)[1]
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
    return np.asarray(np.einsum("pij,pj->pi", R[class_of], extended(mean)))


def error_and_slope(
    system: System, R: Array, mean: Array, z: Array, class_of: Rows
) -> tuple[float, Array]:
    """Eq. 4 with the means R_g xi_p, and dE/dR_g, shape (G, d, d + 1)."""
    E, by_mean = system.error_and_slope(regressed(R, mean, class_of), z)
    slope = np.zeros_like(R)
    np.add.at(slope, class_of, by_mean[:, :, None] * extended(mean)[:, None, :])
    return E, slope


def class_curvature(phone: Rows, mean: Array, class_of: Rows) -> Array:
    """L_g = 2 lambda_max(sum over t in g of xi_t xi_t'), shape (G,); 0 for a class without frames.

    Args:
        phone: Row of the phone of each frame, shape (N,).
        mean: mu_p, shape (P, d).
        class_of: Class of each phone, shape (P,).
    """
    frames = np.bincount(phone, minlength=len(mean))
    xi = extended(mean) * np.sqrt(frames)[:, None]
    return np.array(
        [2 * np.linalg.norm(xi[class_of == g], ord=2) ** 2 for g in range(class_of.max() + 1)]
    )


def gain(system: System, mean: Array, class_of: Rows, inverse: Array) -> Array:
    """c_j: how many times L_g E curves at most, all classes together, by power iteration.

    The Hessian H of E in the rows j of all R_g, taken in units in which each L_g is 1. Full
    covariances couple the dimensions: one c for all.

    Args:
        system, mean, class_of: As in `descend_means`.
        inverse: 1/L_g, shape (G,).

    Returns:
        c_j, shape (d,), or (1,) of full models.
    """
    unit = np.sqrt(inverse)[:, None, None]
    of_dimension = (0, 2) if system.precision.ndim == 2 else (0, 1, 2)
    at_rest = np.zeros((len(system.line.phone), mean.shape[1]))
    shape = len(inverse), mean.shape[1], mean.shape[1] + 1
    V = np.random.default_rng(0).normal(size=shape)
    for _ in range(POWER_ITERATIONS):
        V /= np.sqrt(np.sum(V**2, axis=of_dimension, keepdims=True))
        V = unit * error_and_slope(system, unit * V, mean, at_rest, class_of)[1]  # H V
    return np.asarray(np.sqrt(np.sum(V**2, axis=of_dimension, keepdims=True)).reshape(-1))
