"""Inside the mouth: a dark cavity, the upper teeth (fixed to the head), the lower teeth and the
tongue (fixed to the jaw), all seen through the opening between the lips."""

from dataclasses import dataclass

import numpy as np

from mmmgpu.performer_geometry import Pucker
from mmmgpu.performer_head import Grid
from mmmgpu.performer_shading import Image, smoothstep
from mmmgpu.performer_traits import Performer, Shape

_UPPER = (
    0.0,
    0.060,
    0.106,
    0.148,
    0.184,
    0.214,
    0.240,
    0.262,
)  # borders of the teeth, from the middle
_LOWER = (0.0, 0.039, 0.079, 0.121, 0.157, 0.190, 0.220, 0.246)


@dataclass(frozen=True)
class Opening:
    """Inner edges of the lips [face units] above every column of a window, shape (N,)."""

    upper: Image
    lower: Image


def upper_teeth_edge(shape: Shape) -> float:
    """Height y of the edges of the upper incisors."""
    return shape.mouth + 0.017


def lower_teeth_edge(shape: Shape, p: Pucker) -> float:
    """Height y of the edges of the lower incisors, which follow the jaw."""
    return shape.mouth + 0.006 + p.drop


def paint_inside(
    performer: Performer, grid: Grid, p: Pucker, gap: Opening, tongue: tuple[float, float]
) -> Image:
    """Radiance inside the mouth; `tongue` is (height, advance), both in [0, 1]."""
    shape = performer.shape
    out = _cavity(grid, gap)
    height, advance = tongue
    dim = min(p.half_width / shape.mouth_width, 1.0) ** 1.2
    teeth_top, teeth_low = upper_teeth_edge(shape), lower_teeth_edge(shape, p)
    if advance < 0.75:
        out = _tongue(performer, grid, out, teeth_low, height, advance)
    out = _teeth(performer, grid, out, teeth_low, _LOWER, -1, 0.80 * dim)
    if advance >= 0.75:
        out = _tongue(performer, grid, out, teeth_low, height, advance)
    out = _teeth(performer, grid, out, teeth_top, _UPPER, 1, dim)
    return out * _lip_shadow(grid, gap)[..., None]


def _cavity(grid: Grid, gap: Opening) -> Image:
    """Deep red-brown, darker towards the middle."""
    t = (grid.y - gap.upper) / np.maximum(gap.lower - gap.upper, 0.01)
    glow = 0.35 + 0.9 * np.clip(np.abs(t - 0.45) - 0.1, 0, 1)
    deep = np.array([0.050, 0.014, 0.012], np.float32)
    return np.asarray(glow[..., None] * deep, np.float32)


def _lip_shadow(grid: Grid, gap: Opening) -> Image:
    """The upper lip's shade on what lies behind it, and darkness towards the corners."""
    below_lip = np.clip((grid.y - gap.upper) / 0.040, 0, 1)
    above_lip = np.clip((gap.lower - grid.y) / 0.016, 0, 1)
    return np.asarray((0.50 + 0.50 * below_lip**0.8) * (0.62 + 0.38 * above_lip), np.float32)


def _teeth(
    performer: Performer,
    grid: Grid,
    below: Image,
    edge: float,
    borders: tuple[float, ...],
    side: int,
    brightness: float,
) -> Image:
    """A row of teeth; `side` is 1 for the upper row (crowns above `edge`), -1 for the lower."""
    x = np.abs(grid.x)
    index = np.clip(np.searchsorted(borders, x, side="right") - 1, 0, len(borders) - 2)
    left, right = np.take(borders, index), np.take(borders, index + 1)
    t = (x - left) / (right - left) * 2 - 1  # -1..1 across a tooth
    curve = 0.055 * (x / 0.2) ** 2 * 0.7 + (0.004 * (index == 1) if side > 0 else 0.0)
    rounded = 0.0035 * np.abs(t) ** 3.5
    up = side * (edge - curve * side * (1 if side > 0 else -0.25) - grid.y) - rounded
    crown = 0.075 - 0.012 * (index == 1) if side > 0 else 0.062
    cover = smoothstep(-0.0030, 0.0045, up) * (x < borders[-1])
    arch = np.clip(1 - (x / 0.265) ** 2, 0, 1)
    key = performer.light.key_direction[0] * np.sign(grid.x)
    lit = brightness * (0.34 + 0.66 * arch) * (1 + 0.18 * key * (x / 0.2))
    lit = lit * (1 - 0.10 * t * t) * (1 - 0.26 * smoothstep(0.80, 1.0, np.abs(t)))
    lit = lit * (0.93 + 0.12 * smoothstep(0.0, 0.03, up)) - 0.06 * smoothstep(0.010, 0.0, up)
    tooth = np.asarray(performer.skin.teeth, np.float32) * lit[..., None]
    gum_line = crown + 0.008 * (t * t - 1)
    gum = np.array([0.42, 0.155, 0.145], np.float32) * (0.75 * lit * arch)[..., None]
    tooth += smoothstep(-0.004, 0.004, up - gum_line)[..., None] * (gum - tooth)
    shine = 0.10 * np.exp(-((t / 0.35) ** 2) - ((up - 0.030) / 0.016) ** 2) * arch
    return np.asarray(below + cover[..., None] * (tooth + shine[..., None] - below), np.float32)


def _tongue(
    performer: Performer, grid: Grid, below: Image, floor: float, height: float, advance: float
) -> Image:
    """A rounded body with a groove, behind the lower teeth unless the tip comes forward."""
    reach = smoothstep(0.6, 1.0, np.asarray(advance, np.float32))
    top = floor - 0.004 - 0.105 * height - 0.012 * advance
    wide = 0.150 + 0.02 * advance - 0.050 * reach - 0.02 * height
    thick = 0.11 - 0.062 * reach
    q = np.abs(grid.x) / wide
    rim = top + thick * (1 - np.sqrt(np.maximum(1 - q * q, 0))) + 0.006 * np.exp(-((q / 0.22) ** 2))
    d = (grid.y - rim) / thick
    cover = smoothstep(-0.05, 0.09, d) * smoothstep(1.0, 0.75, q)
    if reach > 0:
        under = top + 2.2 * thick * np.sqrt(np.maximum(1 - q**2.2, 0))
        cover = cover * (1 - reach * smoothstep(-0.006, 0.006, grid.y - under))
    tilt = np.exp(-(((d - 0.42) / 0.42) ** 2)) * (1 - 0.45 * q * q)
    lit = (0.30 + 0.70 * tilt) * (0.48 + 0.30 * advance + 0.32 * reach)
    lit = lit * (1 - 0.22 * np.exp(-((grid.x / 0.010) ** 2)) * (1 - reach))
    lit = lit * smoothstep(1.05, 0.45, q)
    flesh = np.array([0.56, 0.215, 0.195], np.float32) * lit[..., None]
    side = 0.05 * np.sign(performer.light.key_direction[0])
    wet = 0.10 * np.exp(-(((grid.x - side) / 0.035) ** 2) - ((d - 0.30) / 0.12) ** 2)
    flesh += (wet * (0.4 + 0.6 * advance))[..., None]
    return np.asarray(below + cover[..., None] * (flesh - below), np.float32)
