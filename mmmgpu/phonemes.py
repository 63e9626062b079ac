"""Phoneme models: one Gaussian N(mu_p, Sigma_p), Sigma_p diagonal, for each phone of a stream.

A stream is the sequence of one kind of model coordinates: alpha (movement) or beta (texture). The
two are modelled apart by this same code. What is here is the statistics of the frames of each
phone; how the models become a trajectory is `mmmgpu.trajectories`, how they are refined against
real trajectories is `mmmgpu.trajectory_training`.

Source: Chang & Ezzat, "Transferable Videorealistic Speech Animation" (SCA 2005), section 3.2.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mmmgpu.errors import InputError

StandIn = Callable[
    [str, AbstractSet[str]], str
]  # (phone, phones with a model) -> one of the latter

TINY_SHARE = 1e-6  # of the mean variance of all dimensions: what a dimension that never moves gets


@dataclass(frozen=True)
class Utterance:
    """One clip: z [model coordinates], shape (T, d), with the phone of every frame.

    Attributes:
        z: The analysed trajectory of one stream, float64, shape (T, d).
        labels: The phone of each frame, length T.
        segments: Segment number of each frame, shape (T,); frames of one segment are neighbours.
            None: a segment is a run of equal labels.
    """

    z: NDArray[np.float64]
    labels: Sequence[str]
    segments: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        if self.z.ndim != 2 or len(self.z) != len(self.labels):
            raise InputError(
                f"utterance: z must have shape (T, d) with one label a frame, got z {self.z.shape} "
                f"and {len(self.labels)} labels; give the labels of exactly these frames"
            )
        if not np.isfinite(self.z).all():
            raise InputError("utterance: z holds NaN or infinity; leave such frames out")


@dataclass(frozen=True)
class PhonemeModels:
    """N(mu_p, diag sigma2_p) for every phone p of one stream.

    Attributes:
        labels: The P phones, sorted.
        mean: mu_p [model coordinates], shape (P, d).
        variance: sigma2_p [model coordinates squared], shape (P, d), all above zero.
        count: Frames of each phone, shape (P,).
    """

    labels: tuple[str, ...]
    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    count: NDArray[np.int64]

    def index(self, labels: Sequence[str], *, stand_in: StandIn | None = None) -> NDArray[np.int64]:
        """Row of each label, shape (T,).

        Args:
            labels: Phones, length T.
            stand_in: Gives, for a phone that has no model, one that has; `mmmgpu.phones.stand_in`.

        Raises:
            InputError: A phone has no model, nor has its stand-in.
        """
        row = {label: p for p, label in enumerate(self.labels)}
        modelled = frozenset(self.labels)
        for label in sorted(set(labels) - row.keys()):
            known = stand_in(label, modelled) if stand_in else label
            if known not in modelled:
                raise InputError(
                    f"labels: phone {label!r} has no model; "
                    f"train with speech that has it, or use one of {', '.join(self.labels)}"
                )
            row[label] = row[known]
        return np.array([row[label] for label in labels], dtype=np.int64)

    @property
    def typical_variance(self) -> NDArray[np.float64]:
        """Variance within a phone, averaged over the frames: sum_p n_p sigma2_p / n, shape (d,)."""
        return np.average(self.variance, axis=0, weights=self.count)


def pool(
    utterances: Sequence[Utterance], *, floor_share: float = 0.05, labels: Sequence[str] = ()
) -> PhonemeModels:
    """Estimate each phone's Gaussian from all of its frames.

        mu_p = mean of z_t over t in p,    sigma2_p = max(var of z_t over t in p, floor)

    with floor = `floor_share` of the variance of all frames, per dimension. A dimension that
    never moves (the beta of a prototype that no frame uses) has no variance of its own: it gets
    `TINY_SHARE` of the mean over the dimensions.

    Args:
        utterances: The training clips.
        floor_share: Least share of the stream's variance that a phone may have, in (0, 1].
        labels: Phones that get a model even if no frame has them: mean and variance of the stream,
            so that their frames are led by their neighbours.

    Raises:
        InputError: There is no frame, or the dimensions of the clips differ.
    """
    z, spoken = _stack(utterances)
    names, row = np.unique([*spoken, *labels], return_inverse=True)
    phone = row[: len(spoken)]
    count = np.bincount(phone, minlength=len(names))
    frames = np.maximum(count, 1)[:, None]
    mean = np.where(count[:, None], _sum_by(phone, z, len(names)) / frames, z.mean(axis=0))
    spread = _sum_by(phone, (z - mean[phone]) ** 2, len(names)) / frames
    whole = _positive(z.var(axis=0))
    variance = np.where(count[:, None], np.maximum(spread, floor_share * whole), whole)
    return PhonemeModels(tuple(names.tolist()), mean, variance, count)


def _stack(utterances: Sequence[Utterance]) -> tuple[NDArray[np.float64], list[str]]:
    """All frames, shape (N, d), and their phones, length N."""
    if sum(len(u.z) for u in utterances) == 0:
        raise InputError("utterances: no frame to learn from; give at least one labelled clip")
    if len({u.z.shape[1] for u in utterances}) > 1:
        raise InputError("utterances: clips differ in dimension; analyse all with one model")
    z = np.concatenate([np.asarray(u.z, dtype=np.float64) for u in utterances])
    return z, [label for u in utterances for label in u.labels]


def _sum_by(group: NDArray[np.int64], x: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    """Sum of the rows of x (N, d) in each of n groups, shape (n, d)."""
    total = np.zeros((n, x.shape[1]))
    np.add.at(total, group, x)
    return total


def _positive(variance: NDArray[np.float64]) -> NDArray[np.float64]:
    """`variance` (d,) with `TINY_SHARE` of its mean as the least; 1 where nothing moves at all."""
    least = TINY_SHARE * variance.mean()
    return np.maximum(variance, least) if least > 0 else np.ones_like(variance)


def segment_starts(labels: Sequence[str], segments: ArrayLike | None = None) -> NDArray[np.int64]:
    """First frame of every segment, in order, shape (S,).

    Args:
        labels: Phones, length T.
        segments: Segment number of each frame, shape (T,). None: runs of equal labels.

    Raises:
        InputError: `segments` and `labels` differ in length.
    """
    mark = np.asarray(labels if segments is None else segments)
    if len(mark) != len(labels):
        raise InputError(
            f"segments: must have one number a frame, got {len(mark)} for {len(labels)} labels"
        )
    return np.flatnonzero(np.r_[len(mark) > 0, mark[1:] != mark[:-1]])


def segment_durations(
    labels: Sequence[str], segments: ArrayLike | None = None
) -> NDArray[np.int64]:
    """Length in frames of the segment that each frame is in, shape (T,).

    Arguments and errors are those of `segment_starts`.
    """
    lengths = np.diff(np.r_[segment_starts(labels, segments), len(labels)])
    return np.repeat(lengths, lengths)
