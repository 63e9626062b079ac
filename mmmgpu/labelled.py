"""Labelled sequences: feature vectors y_t in R^d with the label pi_t of every frame.

What all models of `mmmgpu.dynamics` share: the check of what they are given, the row of parameters
that a label stands for, and the recursion that makes a trajectory from a row of labels. Each model
keeps P + 1 rows: one for every label of its training data, sorted, and last the pooled row, which
speaks for labels that were not among them and look like none.

Notation: Englebienne, Cootes & Rattray (NIPS 2007), section 3.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mmmgpu.errors import InputError
from mmmgpu.phonemes import Utterance, pool
from mmmgpu.phones import arpabet, stand_in

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]

POOLED = "all frames"  # what `stand_ins` says of a label that the pooled row speaks for
LARGEST_A = 0.999  # of |A|: above 1 a long phone overflows


@dataclass(frozen=True)
class Labelled:
    """S sequences that have been checked.

    Attributes:
        y: The features of each, float64, shape (T_s, d) with T_s >= 1.
        labels: The P labels that occur, sorted.
        rows: The number of each frame's label, shape (T_s,).
    """

    y: tuple[Floats, ...]
    labels: tuple[str, ...]
    rows: tuple[Rows, ...]

    @property
    def frames(self) -> Floats:
        """All frames one after another, shape (N, d)."""
        return np.concatenate(self.y)

    @property
    def utterances(self) -> list[Utterance]:
        """The same as phoneme models want it."""
        names = np.array(self.labels, dtype=object)
        return [Utterance(y, names[r].tolist()) for y, r in zip(self.y, self.rows, strict=True)]


def check_labelled(sequences: Sequence[ArrayLike], labels: Sequence[Sequence[str]]) -> Labelled:
    """Look at what a model is to be fitted to.

    Args:
        sequences: S arrays of shape (T_s, d).
        labels: The labels of each, T_s strings.

    Raises:
        InputError: There is none; one is empty, has another d, holds NaN, or has more or fewer
            labels than frames. It names the first such sequence by its number, from 0.
    """
    if len(sequences) == 0:
        raise InputError("sequences: none to learn from; give at least one with its labels")
    if len(sequences) != len(labels):
        raise InputError(
            f"labels: there are {len(labels)} rows of labels for {len(sequences)} sequences; "
            "give one for each"
        )
    y = tuple(
        check_sequence(one, own, f"sequences[{s}]")
        for s, (one, own) in enumerate(zip(sequences, labels, strict=True))
    )
    for s, one in enumerate(y):
        if one.shape[1] != y[0].shape[1]:
            raise InputError(
                f"sequences[{s}]: has {one.shape[1]} features a frame, sequences[0] has "
                f"{y[0].shape[1]}; give features of one kind"
            )
    known = tuple(sorted({str(label) for own in labels for label in own}))
    row = {label: p for p, label in enumerate(known)}
    rows = tuple(np.array([row[str(label)] for label in own], np.int64) for own in labels)
    return Labelled(y, known, rows)


def check_sequence(
    sequence: ArrayLike, labels: Sequence[str], name: str = "sequence", d: int | None = None
) -> Floats:
    """`sequence` as float64, shape (T, d).

    Raises:
        InputError: It is empty, has another shape, holds NaN or infinity, or T differs from the
            number of labels; `name` is what the error calls it.
    """
    try:
        y = np.array(sequence, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name}: must be an array of numbers, shape (T, d)") from None
    if y.ndim != 2 or 0 in y.shape or y.shape[1] != (d or y.shape[1]):
        wanted = f"(T, {'d' if d is None else d})"
        raise InputError(
            f"{name}: must have shape {wanted} with at least one frame, got {y.shape}; "
            "leave this one out"
        )
    if len(y) != len(labels):
        raise InputError(
            f"{name}: has {len(y)} frames but {len(labels)} labels; give one label a frame"
        )
    if not all(isinstance(label, str) for label in labels):
        raise InputError(f"{name}: labels must be strings, one a frame")
    if not np.isfinite(y).all():
        t = int(np.argmin(np.isfinite(y).all(axis=1)))
        raise InputError(f"{name}: frame {t} holds NaN or infinity; leave such frames out")
    return y


def row_finder(known: Sequence[str]) -> Callable[[str], int]:
    """A function that gives the row of a label; each label is looked up once.

    A label that is not `known` has the row of the phone that looks most like it
    (`mmmgpu.phones.stand_in`) if it is a phone and some known label is one, else the pooled row P.
    """
    row = {label: p for p, label in enumerate(known)}

    def find(label: str) -> int:
        if label not in row:
            phones = frozenset(other for other in known if arpabet(other) is not None)
            is_phone = bool(phones) and arpabet(label) is not None
            row[label] = row[stand_in(label, phones)] if is_phone else len(known)
        return row[label]

    return find


def find_rows(known: Sequence[str], labels: Iterable[str]) -> Rows:
    """The rows of a whole sequence of labels, shape (T,)."""
    return np.fromiter(map(row_finder(known), labels), np.int64)


def stand_ins(known: Sequence[str], labels: Iterable[str]) -> dict[str, str]:
    """For each of `labels` that is not `known`, whose parameters it is given; `POOLED`: all's."""
    find, names = row_finder(known), (*known, POOLED)
    return {label: names[find(label)] for label in sorted(set(labels) - set(known))}


def gaussians(data: Labelled) -> tuple[Floats, Floats]:
    """Mean and variance of the frames of each label, and of all frames: two of shape (P + 1, d).

    Variances have the floor of `mmmgpu.phonemes.pool`, so that a label of one frame has one too.
    """
    models = pool(data.utterances)
    whole = pool([Utterance(u.z, [POOLED] * len(u.z)) for u in data.utterances])
    mean = np.concatenate([models.mean, whole.mean])
    return mean, np.concatenate([models.variance, whole.variance])


def recursion(
    rows: Iterable[int], mu: Sequence[Floats], A: Sequence[Floats], nu: Sequence[Floats]
) -> Iterator[Floats]:
    """x_1 = mu_pi1, x_t = A_pit x_{t-1} + nu_pit: one frame (d,) out for every row in.

    The most likely trajectory of the labels under SLDS and DPDS alike. Rows may be any iterable,
    also one without end; nothing but x_{t-1} is kept. A_p is diagonal, (d,), or full, (d, d).
    """
    rows = iter(rows)
    first = next(rows, None)
    if first is None:
        return
    full = A[0].ndim == 2
    x = mu[first]
    yield x.copy()
    for p in rows:
        x = (A[p] @ x if full else A[p] * x) + nu[p]
        yield x.copy()


def log_normal(residual: Floats, variance: Floats) -> float:
    """Sum of log N(residual; 0, diag variance) over all entries of two arrays that broadcast."""
    terms = np.log(2 * np.pi * variance) + residual**2 / variance
    return float(-0.5 * np.broadcast_to(terms, residual.shape).sum())


def check_labels(labels: Sequence[str]) -> Sequence[str]:
    """`labels`, T >= 1 of them.

    Raises:
        InputError: There is none.
    """
    if len(labels) == 0:
        raise InputError("labels: none given; give the label of every frame")
    return labels


@dataclass(frozen=True)
class Batch:
    """Sequences side by side, the longest first, so that those with a frame t are the first n_t.

    Attributes:
        y: Features, shape (S, T, d); zero after a sequence's end.
        rows: Rows of parameters, shape (S, T); 0 after a sequence's end.
        lengths: T_s, shape (S,), not rising.
        active: n_t, how many sequences have a frame t, shape (T,).
        order: The number of each in the data, shape (S,).
    """

    y: Floats
    rows: Rows
    lengths: Rows
    active: Rows
    order: Rows

    @property
    def real(self) -> NDArray[np.bool_]:
        """Which frames exist, shape (S, T)."""
        return np.asarray(np.arange(self.y.shape[1]) < self.lengths[:, None])


def batches(data: Labelled, *, frames: int) -> list[Batch]:
    """All sequences of `data` in batches of about `frames` frames at most, padding counted."""
    order = sorted(range(len(data.y)), key=lambda s: (-len(data.y[s]), s))
    groups: list[list[int]] = []
    for s in order:
        if not groups or (len(groups[-1]) + 1) * len(data.y[groups[-1][0]]) > frames:
            groups.append([])
        groups[-1].append(s)
    return [_batch(data, group) for group in groups]


def _batch(data: Labelled, chosen: Sequence[int]) -> Batch:
    lengths = np.array([len(data.y[s]) for s in chosen])
    y = np.zeros((len(chosen), lengths[0], data.y[0].shape[1]))
    rows = np.zeros(y.shape[:2], np.int64)
    for i, s in enumerate(chosen):
        y[i, : lengths[i]], rows[i, : lengths[i]] = data.y[s], data.rows[s]
    active = (lengths[:, None] > np.arange(lengths[0])).sum(axis=0)
    return Batch(y, rows, lengths, active, np.array(chosen))


def starting_rows(data: Labelled) -> Rows:
    """The rows of the labels that begin a sequence, sorted."""
    return np.unique([rows[0] for rows in data.rows])


def entered_rows(data: Labelled) -> Rows:
    """The rows of the labels of the frames after the first of each sequence, sorted."""
    return np.unique(list(chain.from_iterable(rows[1:].tolist() for rows in data.rows))).astype(
        np.int64
    )
