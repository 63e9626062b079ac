"""Training of the phoneme models against real trajectories, and the choice of its constants.

Pooled Gaussians make trajectories that move too little. Training refines mu_p and sigma2_p so that
the synthetic y of Eq. 3 meets the real z: it lowers Eq. 4 of CE05, with a ridge to the pooled
estimates mu0, sigma0 that keeps a phone of few frames near them,

    E = |z - y|^2 / v + r sum_p (mu_p - mu0_p)^2 / v + (r/10) sum_p (log sigma2_p / sigma2_0p)^2

in each dimension apart, where v is the dimension's variance within a phone. Eq. 5 of CE05 is plain
gradient descent; here the same exact gradient (by the adjoint, see `mmmgpu.trajectories`) drives
L-BFGS, over mu and log sigma2 so that the variances stay above zero.

Whole clips sit higher or lower than others (posture, registration), which phones cannot predict:
such offsets are nuisances. `remove_offsets` takes them from the trajectories that are trained on,
never from those that are judged.

lambda, k, r and the number of iterations are chosen by cross-validation inside the training clips.

Source: CE05 = Chang & Ezzat, "Transferable Videorealistic Speech Animation" (SCA 2005), 3.2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mmmgpu.phonemes import PhonemeModels, Utterance, cut_utterance, pool
from mmmgpu.trajectories import (
    Timeline,
    error_and_gradient,
    follow,
    lay_out_utterances,
    scaled_smoothness,
)

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]  # called with (steps done, steps in all)

OFFSET_PRIOR = 10  # frames: an offset of a clip this long is trusted by half
SHARE_OF_LOG_VARIANCE = 0.1  # of the ridge: what pulls log sigma2 to the pooled one
MOST_LOG_VARIANCE = np.log(
    100
)  # sigma2 stays within this factor of the pooled one: A stays regular


@dataclass(frozen=True)
class Constants:
    """What training needs beside the data.

    Attributes:
        smoothness: lambda times the variance within a phone, without unit; see `scaled_smoothness`.
        order: k, the order of the difference in Eq. 3.
        ridge: r, the weight of the pooled estimates, in frames.
        iterations: L-BFGS iterations of each dimension, at most.
    """

    smoothness: float
    order: int
    ridge: float
    iterations: int


@dataclass(frozen=True)
class History:
    """Mean squared error of Eq. 4 after each iteration, starting with the pooled estimates.

    Attributes:
        training: (y - z)^2 of the clips trained on [model coordinates squared], shape (I + 1, d).
            A dimension that converged early keeps its last value.
    """

    training: Array


@dataclass(frozen=True)
class TrainedStream:
    """Phoneme models of one stream with all that `synthesize_trajectory` needs.

    Attributes:
        pooled: The Gaussians before training.
        trained: The Gaussians after training.
        smoothness: lambda of each dimension [1/model coordinates squared], shape (d,).
        constants: As chosen; `constants.order` is k.
        history: Of the training on all clips.
        validation: Mean squared error on clips left out, over the dimensions that vary most, after
            each iteration with the chosen constants, shape (iterations tried + 1,).
    """

    pooled: PhonemeModels
    trained: PhonemeModels
    smoothness: Array
    constants: Constants
    history: History
    validation: Array


def fit_stream(
    utterances: Sequence[Utterance],
    *,
    rng: np.random.Generator,
    folds: int = 4,
    progress: Progress | None = None,
) -> TrainedStream:
    """Pool, choose the constants inside `utterances`, and train: one stream from its clips.

    Args:
        utterances: The training clips, and no others.
        rng: Deals the clips into folds.
        folds: At most so many; no more than clips, and a single clip is cut.
        progress: Called with (steps done, steps in all), first while the constants are chosen, then
            from 1 again for each dimension trained; what it raises ends the job.

    Raises:
        InputError: There is no frame, or the dimensions of the clips differ.
    """
    pooled = pool(utterances)
    constants, validation = choose_constants(utterances, rng=rng, folds=folds, progress=progress)
    lam = scaled_smoothness(pooled, constants.smoothness)
    trained, history = train_phonemes(
        remove_offsets(utterances),
        pooled,
        smoothness=lam,
        order=constants.order,
        ridge=constants.ridge,
        iterations=constants.iterations,
        progress=progress,
    )
    return TrainedStream(pooled, trained, lam, constants, history, validation)


def remove_offsets(utterances: Sequence[Utterance], *, rounds: int = 5) -> list[Utterance]:
    """Take from every clip what it sits off the others, given its phones.

    The least squares fit of z_t = mu_p(t) + c_u, in turns: phone means from z - c, then

        c_u = sum over t in u of (z_t - mu_p(t)) / (T_u + OFFSET_PRIOR),

    less their mean over all frames. A single clip is left as it is.
    """
    level = list(utterances)
    for _ in range(rounds):
        models = pool(level)
        offsets = [
            (u.z - models.mean[models.index(u.labels)]).sum(axis=0) / (len(u.z) + OFFSET_PRIOR)
            for u in utterances
        ]
        middle = np.average(offsets, axis=0, weights=[len(u.z) for u in utterances])
        level = [replace(u, z=u.z - (c - middle)) for u, c in zip(utterances, offsets, strict=True)]
    return level


def train_phonemes(
    utterances: Sequence[Utterance],
    models: PhonemeModels,
    *,
    smoothness: Array,
    order: int = 4,
    ridge: float = 10.0,
    iterations: int = 60,
    progress: Progress | None = None,
) -> tuple[PhonemeModels, History]:
    """Refine mu_p and sigma2_p against real trajectories, each dimension apart.

    Args:
        utterances: Real trajectories; all of their phones have models.
        models: Where training starts, and what the ridge pulls to: the pooled estimates.
        smoothness: lambda of each dimension [1/model coordinates squared], shape (d,).
        order: k.
        ridge: r, in frames: how many frames of evidence the pooled estimates stand for.
        iterations: L-BFGS iterations of each dimension, at most.
        progress: Called with (dimensions done, d); what it raises ends the job.

    Returns:
        The trained models and how the error went down.
    """
    line = lay_out_utterances(models, utterances, order=order)
    z = np.concatenate([u.z for u in utterances])
    mean, variance = models.mean.copy(), models.variance.copy()
    errors = np.empty((iterations + 1, z.shape[1]))
    for j in range(z.shape[1]):
        path = _descend(line, z[:, j], models, j, smoothness[j], ridge, iterations)
        mean[:, j], variance[:, j], errors[:, j] = path.mean[-1], path.variance[-1], path.error
        if progress:
            progress(j + 1, z.shape[1])
    return replace(models, mean=mean, variance=variance), History(errors)


@dataclass(frozen=True)
class _Path:
    """One dimension on its way down, padded with the last iteration: I + 1 rows."""

    mean: Array  # (I + 1, P)
    variance: Array  # (I + 1, P)
    error: Array  # (I + 1,) mean squared error


def _descend(
    line: Timeline,
    z: Array,
    models: PhonemeModels,
    j: int,
    smoothness: float,
    ridge: float,
    iterations: int,
) -> _Path:
    """L-BFGS over x = ((mu - mu0)/sqrt(v), log sigma2/sigma2_0) of dimension j, from x = 0."""
    from scipy.optimize import OptimizeResult, minimize

    mu_0, variance_0, v = models.mean[:, j], models.variance[:, j], models.typical_variance[j]
    n = len(mu_0)
    weight = np.repeat([ridge, ridge * SHARE_OF_LOG_VARIANCE], n)

    def gaussians(x: Array) -> tuple[Array, Array]:
        return mu_0 + np.sqrt(v) * x[..., :n], variance_0 * np.exp(x[..., n:])

    def objective(x: Array) -> tuple[float, Array]:
        E, by_mean, by_log_variance = error_and_gradient(line, z, *gaussians(x), smoothness)
        slope = np.concatenate([by_mean * np.sqrt(v), by_log_variance]) / v
        return E / v + weight @ x**2, slope + 2 * weight * x

    start = np.zeros(2 * n)
    xs, values = [start], [objective(start)[0]]

    def keep(intermediate_result: OptimizeResult) -> None:
        xs.append(intermediate_result.x.copy())
        values.append(intermediate_result.fun)

    limits = {"maxiter": iterations, "maxfun": 4 * iterations, "maxcor": 20, "ftol": 1e-9}
    bounds = [(None, None)] * n + [(-MOST_LOG_VARIANCE, MOST_LOG_VARIANCE)] * n
    if iterations:
        minimize(
            objective,
            start,
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            callback=keep,
            options=limits,
        )
    x = np.stack(xs + xs[-1:] * (iterations + 1 - len(xs)))
    value = np.array(values + values[-1:] * (iterations + 1 - len(values)))
    return _Path(*gaussians(x), (value - x**2 @ weight) * v / len(z))


def choose_constants(
    utterances: Sequence[Utterance],
    *,
    rng: np.random.Generator,
    folds: int = 4,
    orders: Sequence[int] = (2, 3, 4),
    smoothness: Sequence[float] = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0),
    ridges: Sequence[float] = (1.0, 3.0, 10.0, 30.0),
    iterations: int = 60,
    dimensions: int = 8,
    progress: Progress | None = None,
) -> tuple[Constants, Array]:
    """Choose lambda, k, r and the number of iterations by cross-validation, clip by clip.

    Each is judged by the squared error on clips left out, over all frames and the `dimensions`
    that vary most. First lambda of each order, with the pooled estimates (training makes up for
    lambda: it acts as a common factor of all sigma2); then k, after a third of the iterations; then
    r and the number of iterations.

    Args:
        utterances: The training clips, and no others.
        rng: Deals the clips into folds.
        folds: At most so many; no more than clips, and a single clip is cut between segments.
        orders, smoothness, ridges: What to choose from.
        iterations: The most to try.
        dimensions: How many dimensions to judge by.
        progress: Called with (steps done, steps in all); what it raises ends the job.

    Returns:
        The constants, and their validation curve: mean squared error on clips left out after each
        iteration, shape (iterations + 1,).
    """
    parts = _deal(_leading(utterances, dimensions), rng, folds)
    steps = _steps(progress, len(orders) + len(ridges))
    best_lambda, screened = {}, {}
    for k in orders:
        splits = [_split(*part, k) for part in parts]
        best_lambda[k] = min(smoothness, key=partial(_pooled_error, splits))
        trial = Constants(best_lambda[k], k, ridges[len(ridges) // 2], iterations // 3)
        screened[k] = _validate(splits, trial).min()
        next(steps)
    order = min(orders, key=screened.__getitem__)
    splits = [_split(*part, order) for part in parts]
    curves = {}
    for ridge in ridges:
        trial = Constants(best_lambda[order], order, ridge, iterations)
        curves[ridge] = _validate(splits, trial)
        next(steps)
    ridge = min(ridges, key=lambda r: curves[r].min())
    stop = int(curves[ridge].argmin())
    return Constants(best_lambda[order], order, ridge, stop), curves[ridge]


def _steps(progress: Progress | None, total: int) -> Iterator[None]:
    """A counter that tells `progress` each time it is advanced."""
    for done in range(1, total + 1):
        if progress:
            progress(done, total)
        yield


def _leading(utterances: Sequence[Utterance], most: int) -> list[Utterance]:
    """The `most` dimensions of largest variance."""
    variance = np.concatenate([u.z for u in utterances]).var(axis=0)
    chosen = np.sort(np.argsort(-variance, kind="stable")[:most])
    return [replace(u, z=u.z[:, chosen]) for u in utterances]


@dataclass(frozen=True)
class _Split:
    """Clips to train on, without their offsets, and clips left out, as they are."""

    models: PhonemeModels
    line: Timeline
    z: Array  # (N, d)
    left_out_line: Timeline
    left_out_z: Array  # (N', d)


def _deal(
    utterances: Sequence[Utterance], rng: np.random.Generator, folds: int
) -> list[tuple[list[Utterance], list[Utterance]]]:
    """Pairs of clips to train on, without their offsets, and clips left out, as they are."""
    level, raw = remove_offsets(utterances), list(utterances)
    if len(raw) == 1:
        level, raw = cut_utterance(level[0], folds), cut_utterance(raw[0], folds)
    folds = min(folds, len(raw))
    fold = rng.permutation(len(raw)) % folds
    return [
        (
            [u for u, f in zip(level, fold, strict=True) if f != left_out],
            [u for u, f in zip(raw, fold, strict=True) if f == left_out],
        )
        for left_out in range(folds)
    ]


def _split(train: Sequence[Utterance], left_out: Sequence[Utterance], order: int) -> _Split:
    models = pool(train, labels=[label for u in left_out for label in u.labels])
    return _Split(
        models,
        lay_out_utterances(models, train, order=order),
        np.concatenate([u.z for u in train]),
        lay_out_utterances(models, left_out, order=order),
        np.concatenate([u.z for u in left_out]),
    )


def _pooled_error(splits: Sequence[_Split], smoothness: float) -> float:
    """Mean squared error on the clips left out, with the pooled estimates."""
    return float(_validate(splits, Constants(smoothness, 0, 0.0, 0))[0])


def _validate(splits: Sequence[_Split], constants: Constants) -> Array:
    """Mean squared error on the clips left out after each iteration, shape (iterations + 1,)."""
    total = np.zeros(constants.iterations + 1)
    for split in splits:
        lam = scaled_smoothness(split.models, constants.smoothness)
        for j, own in enumerate(lam):
            path = _descend(
                split.line,
                split.z[:, j],
                split.models,
                j,
                own,
                constants.ridge,
                constants.iterations,
            )
            z = split.left_out_z[:, j]
            for i, gaussians in enumerate(zip(path.mean, path.variance, strict=True)):
                total[i] += np.sum((follow(split.left_out_line, *gaussians, own)[0] - z) ** 2)
    return total / sum(split.left_out_z.size for split in splits)
