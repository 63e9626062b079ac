"""Phoneme models: one Gaussian N(mu_p, Sigma_p) for each phone of a stream.

Sigma_p is diagonal, or full where the models were carried to other prototypes (see
`mmmgpu.reselection`). A stream is the sequence of one kind of model coordinates: alpha (movement)
or beta (texture). The two are modelled apart by this same code. What is here is the statistics of
the frames of each phone; how the models become a trajectory is `mmmgpu.trajectories`, how they are
refined against real trajectories is `mmmgpu.trajectory_training`, how they are adapted to another
person is `mmmgpu.adaptation_folds`.

Source: Chang & Ezzat, "Transferable Videorealistic Speech Animation" (SCA 2005), section 3.2.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mmmgpu.errors import InputError
from mmmgpu.phones import SIL

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
    """N(mu_p, Sigma_p) for every phone p of one stream; Sigma_p = diag sigma2_p unless it is full.

    Attributes:
        labels: The P phones, sorted.
        mean: mu_p [model coordinates], shape (P, d).
        variance: sigma2_p [model coordinates squared], shape (P, d), all above zero.
        count: Frames of each phone, shape (P,).
        covariance: Full Sigma_p, shape (P, d, d), positive definite; `variance` is its diagonal.
            None: Sigma_p is diagonal.
    """

    labels: tuple[str, ...]
    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    count: NDArray[np.int64]
    covariance: NDArray[np.float64] | None = None

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

    @property
    def precision(self) -> NDArray[np.float64]:
        """Sigma_p^-1: its diagonal, shape (P, d), or if the models are full (P, d, d)."""
        if self.covariance is None:
            return np.asarray(1 / self.variance)
        inverse = np.linalg.inv(self.covariance)
        return np.asarray((inverse + inverse.transpose(0, 2, 1)) / 2)


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
    mean = np.where(count[:, None], sum_by(phone, z, len(names)) / frames, z.mean(axis=0))
    spread = sum_by(phone, (z - mean[phone]) ** 2, len(names)) / frames
    whole = positive(z.var(axis=0))
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


def sum_by(group: NDArray[np.int64], x: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    """Sum of the rows of x (N, d) in each of n groups, shape (n, d)."""
    from scipy.sparse import csc_array

    frames = len(group)
    member = csc_array((np.ones(frames), group, np.arange(frames + 1)), (n, frames))
    total: NDArray[np.float64] = member @ x  # np.add.at sums the same, eight times as slowly
    return total


def positive(variance: NDArray[np.float64]) -> NDArray[np.float64]:
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


def cut_utterance(utterance: Utterance, pieces: int) -> list[Utterance]:
    """At most `pieces` parts of about one length, cut between segments.

    Raises:
        InputError: The utterance is a single segment.
    """
    starts = segment_starts(utterance.labels, utterance.segments)[1:].tolist()
    n = len(utterance.z)
    if not starts:
        raise InputError(
            "utterances: a single clip of a single segment cannot be divided into one part to "
            "train on and one to judge by; give more speech"
        )
    wanted = [n * i / pieces for i in range(1, pieces)]
    cuts = sorted({min(starts, key=lambda t: abs(t - w)) for w in wanted})
    return [_frames(utterance, a, b) for a, b in zip([0, *cuts], [*cuts, n], strict=True)]


def _frames(u: Utterance, start: int, end: int) -> Utterance:
    segments = None if u.segments is None else u.segments[start:end]
    return Utterance(u.z[start:end], u.labels[start:end], segments)


@dataclass(frozen=True)
class Coverage:
    """How many frames there are of each phone, as CE05 section 6 counts them.

    Attributes:
        frames: Frames of each phone of the inventory.
        per_phone: Their mean, over all phones of the inventory.
        per_phone_without_silence: The mean over all of them but SIL.
        unseen: Phones of the inventory without a frame.
        others: Frames of the phones that are not of the inventory.
    """

    frames: dict[str, int]
    per_phone: float
    per_phone_without_silence: float
    unseen: tuple[str, ...]
    others: dict[str, int]


def coverage(labels: Iterable[str], phones: Sequence[str]) -> Coverage:
    """Count the frames of each of `phones` in `labels`, the phones of all frames of all clips."""
    count = Counter(labels)
    frames = {phone: count.pop(phone, 0) for phone in phones}
    speech = [n for phone, n in frames.items() if phone != SIL]
    return Coverage(
        frames=frames,
        per_phone=sum(frames.values()) / max(len(frames), 1),
        per_phone_without_silence=sum(speech) / max(len(speech), 1),
        unseen=tuple(phone for phone, n in frames.items() if n == 0),
        others=dict(sorted(count.items())),
    )
