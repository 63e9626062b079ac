"""What moves: articulators, head and eyes. From phones to trajectories with coarticulation.

Every phone has a target and a strength per articulator. At a time, the wanted position is the mean
of the targets weighted by strength times a dominance that falls off exponentially outside the
phone's span (Cohen & Massaro 1993, "Modeling coarticulation in synthetic visual speech"); two
critically damped followers, run in both directions, then give the muscles' inertia. A closed mouth
(M, B, P), a bitten lip (F, V) and silence are strong, the tongue is free in most phones.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mmmgpu.errors import InputError
from mmmgpu.performer_traits import Field, Performer, Style

Array = Field

ARTICULATORS = (
    "jaw",
    "width",
    "round",
    "upper_lip",
    "lower_lip",
    "press",
    "bite",
    "tongue_height",
    "tongue_advance",
)
REST = (0.0, 0.5, 0.0, 0.0, 0.0, 0.35, 0.0, 0.3, 0.4)
_FADE = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 5.0, 5.0, 1.5, 1.5])  # closures are brief
_FLOOR = 1e-6  # dominance of silence everywhere, so that the mean is defined


class Timed(Protocol):
    """A phone with its time span: `label`, `start` and `end` [s]."""

    @property
    def label(self) -> str: ...
    @property
    def start(self) -> float: ...
    @property
    def end(self) -> float: ...


@dataclass(frozen=True)
class Articulation:
    """Everything that moves, frame by frame, in units that do not depend on the performer.

    `values` (T, 9) in [0, 1], columns `ARTICULATORS`: jaw opening; width of the mouth (0.5 is rest,
    1 is spread); rounding with protrusion; raised upper lip; lowered lower lip; lips pressed
    together (1 closes them whatever the jaw does); lower lip bitten to the upper teeth; height and
    advance of the tongue. `pose` (T, 4) is the head's (x, y) shift [face units], roll [rad] and log
    scale; `blink` (T,) in [0, 1]; `gaze` (T, 2) the irises' shift [face units]; `fps` [Hz].
    """

    values: Array
    pose: Array
    blink: Array
    gaze: Array
    fps: float

    def __post_init__(self) -> None:
        shapes = self.values.shape, self.pose.shape, self.blink.shape, self.gaze.shape
        n = len(self.values)
        if shapes != ((n, len(ARTICULATORS)), (n, 4), (n,), (n, 2)):
            raise InputError(
                f"an articulation needs arrays (T, {len(ARTICULATORS)}), (T, 4), (T,), (T, 2); "
                f"got {shapes}; take the columns from ARTICULATORS"
            )
        for name in ("values", "pose", "blink", "gaze"):
            if not np.isfinite(getattr(self, name)).all():
                raise InputError(f"{name} of the articulation holds NaN or infinity; remove them")
        if n and (self.values.min() < 0 or self.values.max() > 1):
            raise InputError("values of the articulation leave [0, 1]; clip them")

    def __len__(self) -> int:
        return len(self.values)

    def column(self, name: str) -> Array:
        """Trajectory (T,) of the articulator `name`."""
        return np.asarray(self.values[:, ARTICULATORS.index(name)])

    def at(self, t: int) -> dict[str, float]:
        """The articulators of frame `t` by name."""
        return dict(zip(ARTICULATORS, map(float, self.values[t]), strict=True))


# jaw, width, round, upper, lower, press, bite, tongue height, tongue advance
_TARGETS: dict[str, tuple[float, ...]] = {
    "AA": (0.82, 0.50, 0.06, 0.28, 0.30, 0.0, 0.0, 0.22, 0.20),
    "AE": (0.68, 0.68, 0.00, 0.42, 0.42, 0.0, 0.0, 0.30, 0.60),
    "AH": (0.48, 0.50, 0.05, 0.25, 0.28, 0.0, 0.0, 0.32, 0.40),
    "AO": (0.64, 0.36, 0.48, 0.22, 0.25, 0.0, 0.0, 0.25, 0.15),
    "AX": (0.32, 0.50, 0.08, 0.20, 0.24, 0.0, 0.0, 0.38, 0.40),
    "AXR": (0.28, 0.40, 0.35, 0.28, 0.28, 0.0, 0.0, 0.50, 0.35),
    "B": (0.10, 0.48, 0.05, 0.00, 0.00, 1.0, 0.0, 0.30, 0.40),
    "BR": (0.20, 0.50, 0.05, 0.10, 0.16, 0.0, 0.0, 0.28, 0.35),
    "CH": (0.14, 0.34, 0.55, 0.46, 0.52, 0.0, 0.0, 0.60, 0.50),
    "D": (0.20, 0.55, 0.02, 0.30, 0.36, 0.0, 0.0, 0.80, 0.66),
    "DH": (0.24, 0.54, 0.00, 0.28, 0.32, 0.0, 0.0, 0.55, 1.00),
    "EH": (0.52, 0.62, 0.00, 0.36, 0.38, 0.0, 0.0, 0.42, 0.60),
    "ER": (0.28, 0.36, 0.42, 0.30, 0.30, 0.0, 0.0, 0.55, 0.35),
    "F": (0.14, 0.53, 0.00, 0.32, 0.00, 0.0, 1.0, 0.30, 0.40),
    "G": (0.24, 0.54, 0.04, 0.26, 0.32, 0.0, 0.0, 0.60, 0.10),
    "HH": (0.34, 0.52, 0.04, 0.24, 0.28, 0.0, 0.0, 0.32, 0.40),
    "IH": (0.34, 0.66, 0.00, 0.36, 0.40, 0.0, 0.0, 0.58, 0.60),
    "IY": (0.18, 0.88, 0.00, 0.44, 0.52, 0.0, 0.0, 0.70, 0.66),
    "L": (0.36, 0.54, 0.00, 0.30, 0.34, 0.0, 0.0, 0.86, 0.70),
    "NG": (0.26, 0.54, 0.02, 0.26, 0.30, 0.0, 0.0, 0.60, 0.10),
    "R": (0.22, 0.34, 0.52, 0.34, 0.34, 0.0, 0.0, 0.52, 0.35),
    "S": (0.06, 0.64, 0.00, 0.38, 0.54, 0.0, 0.0, 0.52, 0.60),
    "SH": (0.10, 0.30, 0.62, 0.48, 0.56, 0.0, 0.0, 0.56, 0.50),
    "UH": (0.28, 0.30, 0.60, 0.20, 0.24, 0.0, 0.0, 0.45, 0.20),
    "UW": (0.16, 0.18, 0.95, 0.12, 0.14, 0.0, 0.0, 0.56, 0.15),
    "W": (0.10, 0.12, 1.00, 0.06, 0.06, 0.2, 0.0, 0.50, 0.10),
    "Y": (0.16, 0.76, 0.02, 0.38, 0.46, 0.0, 0.0, 0.74, 0.66),
}
_SAME = {
    "DX": "D", "IX": "IH", "JH": "CH", "K": "G", "M": "B", "N": "D", "P": "B",
    "T": "D", "TH": "DH", "V": "F", "Z": "S", "ZH": "SH",
}  # fmt: skip
_GLIDES = {
    "AW": ("AA", "UH"), "AY": ("AA", "IH"), "EY": ("EH", "IY"), "OW": ("AO", "UW"),
    "OY": ("AO", "IH"),
}  # fmt: skip
_WEAK = (0.45, 0.35, 0.35, 0.5, 0.5, 1.2, 1.2, 0.3, 0.3)
_STRENGTH: dict[str, tuple[float, ...]] = {
    "B": (0.6, 0.3, 0.3, 0.9, 0.9, 14.0, 6.0, 0.1, 0.1),
    "F": (1.2, 0.5, 0.6, 2.0, 2.0, 3.0, 14.0, 0.1, 0.1),
    "D": (0.6, 0.3, 0.3, 0.5, 0.5, 1.2, 1.2, 3.0, 3.0),
    "L": (0.6, 0.3, 0.3, 0.5, 0.5, 1.2, 1.2, 4.0, 4.0),
    "DH": (0.7, 0.4, 0.4, 0.6, 0.6, 1.2, 1.2, 5.0, 5.0),
    "S": (1.6, 0.6, 0.5, 1.0, 1.2, 1.5, 1.5, 2.0, 2.0),
    "SH": (1.3, 1.6, 2.0, 1.2, 1.2, 1.5, 1.5, 2.0, 2.0),
    "CH": (1.3, 1.4, 1.7, 1.2, 1.2, 1.5, 1.5, 2.0, 2.0),
    "R": (0.8, 1.2, 1.4, 0.8, 0.8, 1.5, 1.5, 1.5, 1.5),
    "W": (1.2, 3.0, 4.0, 1.5, 1.5, 1.5, 1.5, 1.0, 1.0),
    "UW": (1.0, 2.2, 3.0, 1.0, 1.0, 1.5, 1.5, 1.0, 1.0),
    "SIL": (2.2, 1.0, 1.6, 2.0, 2.0, 1.6, 1.5, 0.5, 0.5),
    "BR": _WEAK, "G": _WEAK, "HH": _WEAK, "NG": _WEAK, "AX": _WEAK,
}  # fmt: skip
_VOWEL = (1.0,) * len(ARTICULATORS)
PHONES = tuple(sorted({*_TARGETS, *_SAME, *_GLIDES, "SIL"}))


@dataclass(frozen=True)
class _Pull:
    """One target with its strengths over a span of time [s]."""

    start: float
    end: float
    target: Array
    strength: Array


def make_articulation(
    performer: Performer,
    phones: Sequence[Timed],
    n_frames: int,
    fps: float,
    rng: np.random.Generator,
) -> Articulation:
    """Trajectories of `n_frames` frames; see `mmmgpu.performer.articulate`."""
    _check(phones, n_frames, fps)
    times = (np.arange(n_frames) + 0.5) / fps
    step = 1 / 200
    fine = np.arange(0, n_frames / fps + step, step)
    pulls = [p for phone in phones for p in _pulls(performer.style, phone)]
    wanted = _dominance_mean(performer.style, pulls, fine)
    smooth = _inertia(wanted, performer.style.smoothness / step)
    values = np.stack([np.interp(times, fine, c) for c in smooth.T], axis=1)
    return Articulation(
        values=np.clip(values.reshape(n_frames, -1), 0, 1),
        pose=_head_motion(performer.style, times, rng),
        blink=_blinks(performer.style, times, rng),
        gaze=_gaze(times, rng),
        fps=float(fps),
    )


def _check(phones: Sequence[Timed], n_frames: int, fps: float) -> None:
    if n_frames < 1 or not (np.isfinite(fps) and fps > 0):
        raise InputError(f"n_frames and fps must be positive, got {n_frames} and {fps}")
    for i, phone in enumerate(phones):
        if phone.label not in PHONES:
            raise InputError(
                f"phone {i} is {phone.label!r}, which the performer cannot say; "
                f"use one of {' '.join(PHONES)}"
            )
        if not (np.isfinite([phone.start, phone.end]).all() and phone.start < phone.end):
            raise InputError(
                f"phone {i} ({phone.label}) lasts from {phone.start} s to {phone.end} s; "
                "its end must be later than its start"
            )


def _pulls(style: Style, phone: Timed) -> list[_Pull]:
    """The targets of a phone: one, or two that share the time of a diphthong."""
    if phone.label in _GLIDES:
        first, second = _GLIDES[phone.label]
        turn = phone.start + 0.55 * (phone.end - phone.start)
        return [
            _Pull(phone.start, turn, personal_target(style, first), _strength(first)),
            _Pull(turn, phone.end, personal_target(style, second), _strength(second)),
        ]
    return [
        _Pull(phone.start, phone.end, personal_target(style, phone.label), _strength(phone.label))
    ]


def _strength(label: str) -> Array:
    return np.asarray(_STRENGTH.get(_SAME.get(label, label), _VOWEL))


def personal_target(style: Style, label: str) -> Array:
    """A performer's own target of a phone that is no diphthong, shape (9,).

    The closures stay what they are; everything else is scaled about rest and shifted a little.
    """
    if label == "SIL":
        return np.asarray(REST)
    name = _SAME.get(label, label)
    index = sorted(_TARGETS).index(name)
    habit = np.random.default_rng((style.targets_seed, index)).normal(0, 0.035, len(ARTICULATORS))
    common, rest = np.asarray(_TARGETS[name]), np.asarray(REST)
    target = rest + style.amplitude * (common - rest) + habit
    target[1] += style.spread
    target[2] *= style.rounding
    target[5:7] = common[5:7]
    return np.asarray(np.clip(target, 0, 1))


def _dominance_mean(style: Style, pulls: Sequence[_Pull], times: Array) -> Array:
    """Weighted mean of the targets, (T, 9)."""
    total = np.full((len(times), len(ARTICULATORS)), _FLOOR)
    mean = total * np.asarray(REST)
    for pull in pulls:
        before = np.maximum(pull.start - times, 0) / style.anticipation
        after = np.maximum(times - pull.end, 0) / (0.75 * style.anticipation)
        weight = np.exp(-(before + after)[:, None] * _FADE) * pull.strength
        total += weight
        mean += weight * pull.target
    return np.asarray(mean / total)


def _inertia(wanted: Array, steps: float) -> Array:
    """Exponential smoothing forwards and backwards: no delay, rounded corners."""
    from scipy.signal import lfilter

    keep = np.exp(-2 / steps)
    b, a = [1 - keep], [1, -keep]
    ahead = lfilter(b, a, wanted, axis=0, zi=keep * wanted[:1])[0]
    back = lfilter(b, a, ahead[::-1], axis=0, zi=keep * ahead[-1:])[0]
    return np.asarray(back[::-1])


def _drift(times: Array, rng: np.random.Generator, periods: tuple[float, ...]) -> Array:
    """Slow smooth noise about 0 with amplitude near 1."""
    out = np.zeros_like(times)
    for period in periods:
        hertz = rng.uniform(0.8, 1.25) / period
        out += np.sin(2 * np.pi * (hertz * times + rng.uniform()))
    return out / len(periods)


def _head_motion(style: Style, times: Array, rng: np.random.Generator) -> Array:
    scale = style.head_motion * np.array([0.016, 0.010, 0.022, 0.008])
    return np.stack([_drift(times, rng, (2.1, 4.5, 9.0)) for _ in scale], axis=1) * scale


def _blinks(style: Style, times: Array, rng: np.random.Generator) -> Array:
    """Lids close in 80 ms and open in 150 ms, at random intervals."""
    out = np.zeros_like(times)
    at = rng.uniform(0.3, style.blink_interval)
    while at < times[-1] + 0.5:
        phase = np.where(times < at, (times - at) / 0.08, (times - at) / 0.15)
        out = np.maximum(out, np.clip(1.15 - np.abs(phase) * 1.15, 0, 1))
        at += style.blink_interval * rng.uniform(0.5, 1.6)
    return np.asarray(out)


def _gaze(times: Array, rng: np.random.Generator) -> Array:
    """Fixations with quick jumps between them."""
    out = np.zeros((len(times), 2))
    at = 0.0
    while at < times[-1]:
        after = times >= at
        out[after] = rng.normal(0, 1, 2) * (0.004, 0.002)
        at += rng.uniform(0.5, 2.0)
    return out
