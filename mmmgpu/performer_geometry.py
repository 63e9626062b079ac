"""How the face moves: lip contours, the deformation of the lower face, and the head's pose.

The *neutral* face is painted once. At a frame, the point (x, y) of the head shows the neutral point
(u, v), found in two one-dimensional monotone steps, so that both directions are exact:

    v = V(x, y)    per column x, a monotone cubic through knots, torn open along the lips
    u = x + g(v) (m - m') q exp((1 - |q|^2.5) / 2.5),  q = x / m'

where m and m' are half the mouth's width at rest and now, and g is 1 about the lips and fades out
at the nose and the chin. All lengths in face units (see `performer_traits`).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mmmgpu.performer_traits import Field, Shape

Array = Field
_LOWER_FACE = 0.468  # from the base of the nose to the chin: of the face the lengths below are for
_JAW_DROP = 0.125  # of the chin, jaw wide open
_SOFT = 0.005  # how far soft lips part before a slit shows
_FIXED = -0.125  # upper end of the moving skin, from the lips' seam


def seam(shape: Shape, u: Array) -> Array:
    """Line v where the closed lips meet, at the neutral abscissa u."""
    s = u / shape.mouth_width
    line = (
        shape.mouth
        + 0.006 * np.exp(-((s / 0.22) ** 2))
        - 0.0025 * np.exp(-(((np.abs(s) - 0.5) / 0.3) ** 2))
        + shape.seam_curve * np.minimum(s * s, 1.5)
    )
    return np.asarray(line)


def vermilion(shape: Shape, u: Array) -> tuple[Array, Array]:
    """Thickness of the upper and of the lower lip at rest; 0 outside the mouth."""
    s = np.minimum(np.abs(u) / shape.mouth_width, 1.0)
    body = np.maximum(1 - s**1.8, 0)
    bow = 1 + shape.cupid * (np.exp(-(((s - 0.22) / 0.16) ** 2)) - 1.1 * np.exp(-((s / 0.11) ** 2)))
    return shape.upper_lip * body**0.85 * bow, shape.lower_lip * np.maximum(1 - s**2.5, 0) ** 0.8


@dataclass(frozen=True)
class Pucker:
    """The articulation of one frame as the mouth's geometry [face units].

    `half_width` is m'; `upper`, `lower` and `corner` are the displacements of the inner lips at the
    middle and of the mouth's corners; `drop` that of the chin; `thin_upper` and `thin_lower` scale
    the lips' height; `roundness` in [0, 1] shapes the opening from slit to ellipse.
    """

    half_width: float
    upper: float
    lower: float
    corner: float
    drop: float
    thin_upper: float
    thin_lower: float
    roundness: float


def pucker(shape: Shape, a: dict[str, float]) -> Pucker:
    """Mouth geometry of one frame from its articulators (see `performer_articulation`).

    Movements are in proportion: sideways to the mouth's width, up and down to the lower face.
    """
    size = (shape.chin - shape.nose_base) / _LOWER_FACE
    drop = _JAW_DROP * size * a["jaw"]
    spread = 2 * a["width"] - 1
    upper = size * (0.010 * a["round"] - 0.030 * a["upper_lip"]) + 0.06 * drop
    gap = 0.90 * drop + size * (0.042 * a["lower_lip"] + 0.030 * a["upper_lip"])
    closed = float(np.clip((a["press"] - 0.35) / 0.45, 0, 1))
    closed *= closed * (3 - 2 * closed)
    upper += (0.22 * drop - upper) * closed
    gap *= 1 - closed
    gap = max(gap - _SOFT, 0.0)
    upper += (-0.016 * size - upper) * a["bite"]
    gap += (0.029 * size - gap) * a["bite"]
    return Pucker(
        half_width=shape.mouth_width * (1 + 0.19 * spread) * (1 - 0.27 * a["round"]),
        upper=upper,
        lower=upper + gap,
        corner=0.30 * drop - 0.016 * size * spread,
        drop=drop,
        thin_upper=1 - 0.38 * a["press"] - 0.10 * max(spread, 0) + 0.12 * a["round"],
        thin_lower=(1 - 0.34 * a["press"] - 0.14 * max(spread, 0) + 0.10 * a["round"])
        * (1 - 0.30 * a["bite"]),
        roundness=float(np.clip(0.25 + a["round"] + 0.3 * a["jaw"] - 0.3 * max(spread, 0), 0, 1)),
    )


def squeeze(shape: Shape, p: Pucker, x: Array, v: Array) -> Array:
    """Neutral abscissa u of the points (x, v); strictly increasing in x."""
    q = x / p.half_width
    change = _reach(shape, v) * (shape.mouth_width - p.half_width)
    return np.asarray(x + change * q * np.exp((1 - np.abs(q) ** 2.5) / 2.5))


def unsqueeze(shape: Shape, p: Pucker, u: Array, v: Array) -> Array:
    """Inverse of `squeeze` in x, to machine precision (Newton; the slope is never below 0.3)."""
    x = u.astype(np.float64)
    amplitude = _reach(shape, v) * (shape.mouth_width - p.half_width)
    for _ in range(20):
        q = x / p.half_width
        power = np.abs(q) ** 2.5
        bump = amplitude * np.exp((1 - power) / 2.5)
        slope = 1 + bump * (1 - power) / p.half_width
        x = x - (x + bump * q - u) / np.maximum(slope, 0.3)
    return x


def _reach(shape: Shape, v: Array) -> Array:
    """Share g(v) of the mouth's change of width that is felt at height v."""
    d = v - shape.mouth
    fade = np.where(d < 0, (-d - 0.062) / 0.095, (d - 0.078) / 0.105)
    t = np.clip(fade, 0, 1)
    return np.asarray(1 - t * t * (3 - 2 * t))


@dataclass(frozen=True)
class Columns:
    """Vertical map of every column: knots y (screen) and v (neutral), each (knots, N).

    The first three knots are the upper lip's side, the others the lower lip's; rows 2 and 3 are the
    inner edges of the lips, equal outside the mouth.
    """

    y: Array
    v: Array

    def upper_lip(self) -> Array:
        """Inner edge of the upper lip, shape (N,)."""
        return np.asarray(self.y[2])

    def lower_lip(self) -> Array:
        """Inner edge of the lower lip, shape (N,)."""
        return np.asarray(self.y[3])


def columns(shape: Shape, p: Pucker, x: Array) -> Columns:
    """Vertical knots at the abscissas `x`, shape (N,)."""
    u = squeeze(shape, p, x, np.full_like(x, shape.mouth))
    s = np.abs(u) / shape.mouth_width
    line = seam(shape, u)
    upper, lower = vermilion(shape, u)
    upper, lower = np.hypot(upper, 0.030), np.hypot(lower, 0.034)
    q = np.abs(x) / p.half_width
    arch = np.maximum(1 - q ** (1.9 + 0.4 * p.roundness), 0) ** (0.85 - 0.35 * p.roundness)
    side = np.exp(-((np.maximum(s - 1, 0) / 0.9) ** 2))
    drop = p.drop * np.exp(-((x / 0.43) ** 4)) * (0.25 + 0.75 * np.exp(-((x / 0.36) ** 2)))
    corner = p.corner * side
    top = line + corner + (p.upper - corner) * arch
    bottom = line + corner + (p.lower - corner) * arch
    pad = shape.mouth + 0.56 * (shape.chin - shape.mouth) + 0 * x
    thin_upper = 1 + (p.thin_upper - 1) * side
    thin_lower = 1 + (p.thin_lower - 1) * side
    start, end = shape.mouth + _FIXED + 0 * x, shape.chin + 0.30 + 0 * x
    y_lower = bottom + lower * thin_lower
    y_pad = np.maximum(pad + drop, y_lower + 0.02)
    y = np.stack([start, top - upper * thin_upper, top, bottom, y_lower, y_pad, end + drop])
    v = np.stack([start, line - upper, line, line, line + lower, pad, end])
    return Columns(y, v)


def to_neutral(c: Columns, y: Array, upper: NDArray[np.bool_]) -> Array:
    """v of the points (x, y): `y` broadcasts against the columns, `upper` says which lip's side."""
    return np.where(upper, _monotone(y, c.y[:3], c.v[:3]), _monotone(y, c.y[3:], c.v[3:]))


def from_neutral(c: Columns, v: Array, upper: NDArray[np.bool_]) -> Array:
    """Inverse of `to_neutral`, by bisection to 1e-9; `v` has one value a column."""
    low = np.where(upper, c.y[0] - 1.0, c.y[3])
    high = np.where(upper, c.y[2], c.y[-1] + 1.0)
    for _ in range(34):
        middle = (low + high) / 2
        below = to_neutral(c, middle, upper) < v
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return np.asarray((low + high) / 2)


def _monotone(y: Array, knots: Array, values: Array) -> Array:
    """Monotone cubic through (knots, values), of slope 1 at both ends and shifted beyond them.

    Inner slopes are harmonic means (Fritsch & Butland 1984); the sum over intervals of clipped
    cubics is the spline itself.
    """
    width = np.diff(knots, axis=0)
    secant = np.diff(values, axis=0) / width
    inner = 2 * secant[1:] * secant[:-1] / (secant[1:] + secant[:-1])
    last = np.minimum(1.0, 3 * secant[-1:])
    first = np.minimum(1.0, 3 * secant[:1])
    slopes = np.concatenate([first, inner, last])
    out = values[0] + np.minimum(y - knots[0], 0) + np.maximum(y - knots[-1], 0)
    for k in range(len(width)):
        h, m = width[k], secant[k]
        c2 = (3 * m - 2 * slopes[k] - slopes[k + 1]) * h
        c3 = (slopes[k] + slopes[k + 1] - 2 * m) * h
        t = np.clip((y - knots[k]) / h, 0, 1)
        out = out + t * (slopes[k] * h + t * (c2 + t * c3))
    return np.asarray(out)


def pose_weight(x: Array, y: Array) -> Array:
    """How much a point follows the head, in [0, 1]: the shoulders stay, so does the wall."""
    neck = np.clip((y - 0.70) / 0.50, 0, 1)
    away = np.clip((np.hypot(x / 1.0, (y + 0.1) / 1.25) - 0.62) / 0.38, 0, 1)
    t = np.maximum(neck, away)
    return np.asarray(1 - t * t * (3 - 2 * t))


def undo_pose(pose: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Head point shown at the picture's point (x, y); `pose` is (dx, dy, roll [rad], log scale)."""
    dx, dy, roll, log_scale = pose
    c, s = np.cos(-roll) * np.exp(-log_scale), np.sin(-roll) * np.exp(-log_scale)
    px, py = x - dx, y - dy - 0.7  # the head turns about the neck
    w = pose_weight(x, y)
    return x + w * (c * px - s * py - x), y + w * (s * px + c * py + 0.7 - y)


def apply_pose(pose: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Inverse of `undo_pose` by fixed-point iteration; the movement is a contraction."""
    qx, qy = x, y
    for _ in range(40):
        hx, hy = undo_pose(pose, qx, qy)
        qx, qy = qx + x - hx, qy + y - hy
    return qx, qy
