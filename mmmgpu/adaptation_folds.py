"""Adaptation of phoneme models to another person, its constants chosen inside the clips given.

Five methods by one rule. Each makes a row of candidates: GDLR after 0, 1, 2, ... iterations at each
of a few rates, MAP and the regressions with less and less held back. Candidates fitted on some of
the clips are judged on the others by the squared distance of their trajectories y from the real
ones z, in units of what is seen:

    (z - y)' W (z - y),

where Eq. 4 has I. The best one, summed over the folds, is taken; of those that cannot be told from
it, the one whose training error on all clips is least. So GDLR stops early, and every method has
its constants from the same evidence.

Only means are adapted; Sigma, lambda and k stay.

Source: CE05 = Chang & Ezzat, "Transferable Videorealistic Speech Animation" (SCA 2005), 5.2-5.3.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mmmgpu.errors import InputError
from mmmgpu.gdlr import DESCENT, RULES, Descent, descend_means
from mmmgpu.linear_adaptation import map_means, regress_means
from mmmgpu.phonemes import PhonemeModels, Utterance, cut_utterance
from mmmgpu.phones import stand_in
from mmmgpu.regression_classes import Classes, class_rows
from mmmgpu.statistics import speech_frames
from mmmgpu.trajectories import System, checked_smoothness, factor_system, lay_out_utterances

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Progress = Callable[[int, int], None]  # called with (steps done, steps in all)
Candidate = tuple[dict[str, Any], Array]  # constants as JSON values, means (P, d)

ALIKE = 0.01  # validation errors that differ by less cannot be told apart by a few clips
RIDGES: Final = (1000.0, 300.0, 100.0, 30.0, 10.0, 3.0, 1.0)  # frames; also tau of MAP


@dataclass(frozen=True)
class Adapted:
    """Adapted models of one stream, and why these.

    Attributes:
        models: The adapted models.
        method: One of `METHODS`.
        constants: The chosen candidate's, plain JSON values.
        candidates: The constants of all C candidates.
        training: Mean squared error (Eq. 4 over frames and dimensions) of each candidate on the
            clips it was fitted on, all of them, shape (C,).
        validation: Mean over the frames of (z - y)' W (z - y) on clips left out, fitted on the
            others, shape (C,).
        values: N d: how many squares are in `training`, which times this is E of Eq. 4.
    """

    models: PhonemeModels
    method: str
    constants: dict[str, Any]
    candidates: tuple[dict[str, Any], ...]
    training: Array
    validation: Array
    values: int

    @property
    def iterations(self) -> int:
        """How many iterations of GDLR were taken; 0 with other methods."""
        return int(self.constants.get("iterations", 0))

    @property
    def path(self) -> NDArray[np.int64]:
        """Numbers of the candidates that are the iterations of the GDLR that was chosen, in order.

        `training[path]` and `validation[path]` are its curves. Of other methods, the candidate
        that was chosen.
        """
        wanted = self.constants | {"iterations": None}
        return np.flatnonzero([own | {"iterations": None} == wanted for own in self.candidates])


@dataclass(frozen=True)
class _Part:
    """Some of the clips: Eq. 3 ready for their labels, and their real trajectories (N, d)."""

    system: System
    z: Array

    def error(self, mean: Array, weights: Array) -> float:
        """The sum over frames of (z - y)' W (z - y), W (d, d); with I, E of Eq. 4."""
        off = self.z - self.system.follow(mean)
        return float(np.sum(off @ weights * off))


Method = Callable[[PhonemeModels, Rows, _Part, Descent], list[Candidate]]


def _none(models: PhonemeModels, *_: object) -> list[Candidate]:
    return [({}, models.mean)]


def _shift(models: PhonemeModels, class_of: Rows, part: _Part, _: Descent) -> list[Candidate]:
    fit = partial(regress_means, models, part.system.line.phone, part.z, class_of, shape="shift")
    return [({"ridge": r}, fit(ridge=r)) for r in (*RIDGES, 0.0)]


def _map(models: PhonemeModels, _: Rows, part: _Part, __: Descent) -> list[Candidate]:
    fit = partial(map_means, models, part.system.line.phone, part.z)
    return [({"tau": tau}, fit(tau=tau)) for tau in RIDGES]


def _mllr(models: PhonemeModels, class_of: Rows, part: _Part, _: Descent) -> list[Candidate]:
    fit = partial(regress_means, models, part.system.line.phone, part.z, class_of)
    return [
        ({"shape": shape, "ridge": r}, fit(shape=shape, ridge=r))
        for shape in ("diagonal", "full")
        for r in RIDGES
    ]


def _gdlr(models: PhonemeModels, class_of: Rows, part: _Part, descent: Descent) -> list[Candidate]:
    rule = RULES[descent.rule]
    m, s = rule.units(models)
    mean, z = (models.mean - m) / s, (part.z - m) / s
    descend = partial(descend_means, part.system, mean, z, class_of, iterations=descent.iterations)
    return [
        ({"rule": descent.rule, **constants, "rate": rate, "iterations": i}, m + s * moved)
        for constants, metric in rule.metrics(part.system, mean, class_of)
        for rate in descent.rates or rule.rates
        for i, moved in enumerate(descend(metric=rate * metric))
    ]


_CANDIDATES: Final[MappingProxyType[str, Method]] = MappingProxyType(
    {"none": _none, "shift": _shift, "map": _map, "mllr": _mllr, "gdlr": _gdlr}
)
METHODS: Final = tuple(_CANDIDATES)


def adapt_models(
    models: PhonemeModels,
    utterances: Sequence[Utterance],
    *,
    smoothness: ArrayLike,
    order: int,
    method: str,
    classes: Classes,
    rng: np.random.Generator,
    weights: Array | None = None,
    folds: int = 5,
    descent: Descent = DESCENT,
    progress: Progress | None = None,
) -> Adapted:
    """Adapt the means of one stream to the trajectories of another person.

    Call it within `mmmgpu.parallel.one_thread_each`: the systems are too small for more threads of
    BLAS, and with full models several are many times slower.

    Args:
        models: Phoneme models in the coordinates of `utterances`.
        utterances: The adaptation clips, and no others. A phone without a model counts as the one
            that stands in for it; see `mmmgpu.phones.stand_in`.
        smoothness: lambda [1/model coordinates squared], one number or shape (d,).
        order: k.
        method: One of `METHODS`.
        classes: Every phone of `models` in exactly one class.
        rng: Deals the clips into folds.
        weights: W, shape (d, d), positive semidefinite: what errors count on clips left out; see
            `mmmgpu.picture_errors`. None: I/d, the mean square.
        folds: At most so many; no more than clips, and a single clip is cut between segments.
        descent: How GDLR descends.
        progress: Called with (steps done, steps in all); what it raises ends the job.

    Raises:
        InputError: The clips have no speech, a single phone, or other dimensions than the models,
            or an argument is out of its range.
    """
    if method not in METHODS:
        raise InputError(f"method: must be one of {', '.join(METHODS)}, got {method!r}")
    if folds < 2:
        raise InputError(f"folds: must be at least 2, got {folds}")
    _check_speech(models, utterances)
    d = models.mean.shape[1]
    lam = checked_smoothness(smoothness, order, d)
    weights = np.eye(d) / d if weights is None else weights
    if weights.shape != (d, d):
        raise InputError(f"weights: must have shape {(d, d)}, got {weights.shape}")
    clips = [_modelled(models, u) for u in utterances]
    fit = partial(_CANDIDATES[method], models, class_rows(models, classes))
    dealt = _deal(clips, rng, folds)
    trials: list[list[tuple[dict[str, Any], float]]] = []
    for done, (train, left_out) in enumerate(dealt, start=1):
        judge = _prepare(models, left_out, lam, order)
        candidates = fit(_prepare(models, train, lam, order), descent)
        trials.append([(constants, judge.error(mean, weights)) for constants, mean in candidates])
        if progress:
            progress(done, len(dealt) + 1)
    whole = _prepare(models, clips, lam, order)
    adapted = _choose(models, method, fit(whole, descent), whole, trials)
    if progress:
        progress(len(dealt) + 1, len(dealt) + 1)
    return adapted


def _choose(
    models: PhonemeModels,
    method: str,
    candidates: list[Candidate],
    whole: _Part,
    trials: list[list[tuple[dict[str, Any], float]]],
) -> Adapted:
    """The best candidate, of those that exist in every fold and on all clips.

    A descent that diverges makes fewer. Of candidates whose validation errors cannot be told from
    the least one, that of least training error is the best.
    """
    errors = [{json.dumps(constants): error for constants, error in trial} for trial in trials]
    shared = [
        (constants, mean, sum(fold[json.dumps(constants)] for fold in errors))
        for constants, mean in candidates
        if all(json.dumps(constants) in fold for fold in errors)
    ]
    size, d = whole.z.size, whole.z.shape[1]
    training = np.array([whole.error(mean, np.eye(d)) for _, mean, _ in shared])
    validation = np.array([error for _, _, error in shared])
    alike = validation <= (1 + ALIKE) * validation.min()
    best = int(np.where(alike, training, np.inf).argmin())
    return Adapted(
        models=replace(models, mean=shared[best][1]),
        method=method,
        constants=shared[best][0],
        candidates=tuple(own for own, _, _ in shared),
        training=training / size,
        validation=validation / len(whole.z),
        values=size,
    )


def _check_speech(models: PhonemeModels, utterances: Sequence[Utterance]) -> None:
    labels = [label for u in utterances for label in u.labels]
    spoken = {p for p, heard in zip(labels, speech_frames(labels), strict=True) if heard}
    if len(spoken) < 2:
        what = f"one phone only, {spoken.pop()!r}" if spoken else "no speech"
        raise InputError(
            f"utterances: the adaptation clips hold {what}; give clips in which the person speaks, "
            "with their phone alignments"
        )
    d = models.mean.shape[1]
    if any(u.z.shape[1] != d for u in utterances):
        raise InputError(
            f"utterances: the models have {d} dimensions, a clip has another number; "
            "analyse the clips with the transferred model"
        )


def _modelled(models: PhonemeModels, u: Utterance) -> Utterance:
    """`u` with phones that have models, in the segments that it had."""
    known = frozenset(models.labels)
    labels = [stand_in(label, known) for label in u.labels]
    if u.segments is not None:
        return replace(u, labels=labels)
    changes = [a != b for a, b in zip(u.labels[1:], u.labels[:-1], strict=True)]
    return replace(u, labels=labels, segments=np.cumsum([0, *changes]))


def _deal(
    clips: list[Utterance], rng: np.random.Generator, folds: int
) -> list[tuple[list[Utterance], list[Utterance]]]:
    """Pairs of clips to fit on and clips left out."""
    if len(clips) == 1:
        clips = cut_utterance(clips[0], folds)
    folds = min(folds, len(clips))
    fold = (rng.permutation(len(clips)) % folds).tolist()
    return [
        (
            [u for u, f in zip(clips, fold, strict=True) if f != left_out],
            [u for u, f in zip(clips, fold, strict=True) if f == left_out],
        )
        for left_out in range(folds)
    ]


def _prepare(
    models: PhonemeModels, clips: Sequence[Utterance], smoothness: Array, order: int
) -> _Part:
    line = lay_out_utterances(models, clips, order=order)
    return _Part(factor_system(line, models, smoothness), np.concatenate([u.z for u in clips]))
