"""How far synthetic trajectories are from real ones, and how sure one can be of a difference.

All functions take trajectories of shape (N, d), frames first, and give one number a dimension,
shape (d,). Several clips are laid end to end by the caller, or judged clip by clip and then
brought together by `interval` and `paired_interval`, whose unit is the clip: frames of one clip
are not independent of each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mmmgpu.errors import InputError

Array = NDArray[np.float64]


def speech_frames(labels: Sequence[str], *, silence: Sequence[str] = ("SIL",)) -> NDArray[np.bool_]:
    """Mask of the frames whose phone is not silence, shape (T,)."""
    return np.array([label not in silence for label in labels], dtype=bool)


def rms_error(synthetic: Array, real: Array, *, frames: NDArray[np.bool_] | None = None) -> Array:
    """Root of the mean squared difference over `frames` (all if None); NaN where there is none."""
    y, z = _chosen(synthetic, real, frames)
    if len(z) == 0:
        return np.full(z.shape[1], np.nan)
    error: Array = np.sqrt(np.mean((y - z) ** 2, axis=0))
    return error


def correlation(synthetic: Array, real: Array, *, frames: NDArray[np.bool_] | None = None) -> Array:
    """Pearson's correlation over `frames` (all if None); NaN where either does not move."""
    y, z = _chosen(synthetic, real, frames)
    dy, dz = _about_mean(y), _about_mean(z)
    return _ratio((dy * dz).sum(axis=0), np.sqrt((dy**2).sum(axis=0) * (dz**2).sum(axis=0)))


def variance_ratio(
    synthetic: Array, real: Array, *, frames: NDArray[np.bool_] | None = None
) -> Array:
    """Variance of the synthetic over that of the real trajectory; NaN where the real one is still.

    Below 1 the synthesis moves too little. The trajectory of least squared error has the squared
    correlation as its ratio, so a model that predicts poorly must move little or miss more.
    """
    y, z = _chosen(synthetic, real, frames)
    return _ratio((_about_mean(y) ** 2).sum(axis=0), (_about_mean(z) ** 2).sum(axis=0))


def _chosen(synthetic: Array, real: Array, frames: NDArray[np.bool_] | None) -> tuple[Array, Array]:
    if synthetic.shape != real.shape or real.ndim != 2:
        raise InputError(
            f"synthetic and real must have one shape (N, d), got {synthetic.shape} and {real.shape}"
        )
    return (synthetic, real) if frames is None else (synthetic[frames], real[frames])


def _about_mean(x: Array) -> Array:
    mean: Array = x.sum(axis=0) / max(len(x), 1)
    return x - mean


def _ratio(above: Array, below: Array) -> Array:
    """above / below, NaN where below is zero."""
    ratio: Array = np.divide(above, below, out=np.full(below.shape, np.nan), where=below > 0)
    return ratio


@dataclass(frozen=True)
class Interval:
    """Mean of n clips and the half width of its t interval: mean +- half_width.

    Attributes:
        mean: Mean over the clips.
        half_width: t quantile times the standard error; NaN for fewer than two clips.
        n: Clips.
    """

    mean: float
    half_width: float
    n: int

    @property
    def excludes_zero(self) -> bool:
        """Whether the sign of the mean is settled at the interval's confidence."""
        return abs(self.mean) > self.half_width


def interval(values: ArrayLike, *, confidence: float = 0.95) -> Interval:
    """Student's t interval of the mean of independent `values`, shape (n,).

    Raises:
        InputError: There is no value.
    """
    from scipy.stats import t

    x = np.asarray(values, dtype=np.float64)
    if x.ndim != 1 or len(x) == 0:
        raise InputError(f"values: must have shape (n,) with n >= 1, got {x.shape}")
    if len(x) == 1:
        return Interval(float(x[0]), float("nan"), 1)
    quantile = float(t.ppf((1 + confidence) / 2, len(x) - 1))
    return Interval(float(x.mean()), quantile * float(x.std(ddof=1)) / len(x) ** 0.5, len(x))


def paired_interval(before: ArrayLike, after: ArrayLike, *, confidence: float = 0.95) -> Interval:
    """t interval of before - after, clip by clip: above zero where `after` is the lower.

    Args:
        before, after: One number a clip, shape (n,), the clips in the same order.
        confidence: Of the interval, in (0, 1).

    Raises:
        InputError: The two differ in length or are empty.
    """
    a, b = np.asarray(before, dtype=np.float64), np.asarray(after, dtype=np.float64)
    if a.shape != b.shape:
        raise InputError(f"before and after must pair up, got shapes {a.shape} and {b.shape}")
    return interval(a - b, confidence=confidence)
