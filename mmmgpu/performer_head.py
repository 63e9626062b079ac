"""The neutral head as surfaces: skull, brow, nose, cheeks, lips, chin, ears; then its colours.

Everything is evaluated on the supersampled grid, eyes and mouth closed: eyes and the inside of the
mouth are drawn under the openings (`performer_eyes`, `performer_mouth`).
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator

from mmmgpu.performer_geometry import seam, vermilion
from mmmgpu.performer_shading import Image, blur, cast_shadow, noise, occlusion, smoothstep
from mmmgpu.performer_traits import SUPERSAMPLING, Performer, Shape


@dataclass(frozen=True)
class Grid:
    """Supersampled sampling points (x, y) [face units], each (H, W), and pixels per unit."""

    x: Image
    y: Image
    px: float

    def window(self, rows: slice, cols: slice) -> "Grid":
        """The part of the grid inside `rows` and `cols`."""
        return Grid(self.x[rows, cols], self.y[rows, cols], self.px)


def make_grid(performer: Performer) -> Grid:
    """Grid of the performer's whole picture."""
    height, width = performer.size
    ox, oy = performer.origin
    k = SUPERSAMPLING
    x = ((np.arange(width * k) + 0.5) / k - 0.5 - ox) / performer.scale
    y = ((np.arange(height * k) + 0.5) / k - 0.5 - oy) / performer.scale
    gx, gy = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    return Grid(gx, gy, performer.scale * k)


@dataclass(frozen=True)
class Surface:
    """A painted layer: albedo (H, W, 3) and (H, W) fields.

    `fold` is a further relief that the nasolabial folds add when the mouth spreads; `lip` is 1 on
    the vermilion.
    """

    albedo: Image
    alpha: Image
    height: Image
    fold: Image
    lit: Image
    gloss: Image
    lip: Image


def outline(shape: Shape, y: Image) -> Image:
    """Half the width of the head at height y; 0 above the crown and below the chin."""
    c, j = shape.chin, shape.jaw_width
    t = shape.skull
    knots = [-t, -t + 0.03, -t + 0.14, -0.45, -0.20, 0.05, 0.22, 0.52 * c, 0.69 * c]
    widths = [0.0, 0.20, 0.345, 0.452, 0.492, 0.500, 0.485, 0.436 * j, 0.372 * j]
    knots += [c - 0.16, c - 0.075, c - 0.025, c]
    widths += [0.288 * j, 0.205 * j, 0.124 * j, 0.0]
    spline = PchipInterpolator(knots, np.square(widths), extrapolate=False)
    return np.asarray(np.sqrt(np.maximum(np.nan_to_num(spline(y)), 0)), dtype=np.float32)


def _bump(grid: Grid, x: float, y: float, rx: float, ry: float) -> Image:
    """A smooth hill of height 1, mirrored to both sides unless x is 0."""
    dx = (np.abs(grid.x) - x) / rx
    dy = (grid.y - y) / ry
    return np.exp(-(dx * dx + dy * dy))


def head_relief(shape: Shape, grid: Grid) -> Image:
    """Height of the closed-eyed, closed-mouthed face [face units]."""
    width = np.maximum(outline(shape, grid.y), 1e-3)
    t = np.minimum(np.abs(grid.x) / width, 1)
    depth = np.minimum(0.62 * np.sqrt(width / 0.5), 0.62) * (1 - 0.10 * grid.y * grid.y)
    h = depth * (1 - t**2.5) ** 0.55
    h += 0.030 * _bump(grid, 0.13, -0.125, 0.16, 0.055)  # brow ridge
    h += 0.020 * _bump(grid, 0.0, -0.40, 0.30, 0.20)  # forehead
    h -= 0.070 * _bump(grid, shape.eye_x - 0.015, -0.005, 0.135, 0.075)  # sockets
    h -= 0.028 * _bump(grid, 0.105, -0.02, 0.04, 0.06)
    h += 0.044 * _bump(grid, shape.eye_x, 0.006, 0.088, 0.058)  # eyeballs
    h += 0.045 * shape.cheek * _bump(grid, 0.285, 0.175, 0.13, 0.10)  # cheekbones
    h -= 0.022 * _bump(grid, 0.33, 0.42, 0.09, 0.16)
    h += 0.062 * _bump(grid, 0.0, shape.mouth + 0.01, 0.23, 0.18)  # teeth behind the lips
    h += 0.036 * _bump(grid, 0.0, shape.chin - 0.085, 0.115, 0.072)  # chin
    h -= 0.012 * _bump(grid, 0.0, shape.mouth + shape.lower_lip + 0.038, 0.12, 0.026)
    return np.asarray(h + _nose(shape, grid) + _lips(shape, grid), dtype=np.float32)


def _nose(shape: Shape, grid: Grid) -> Image:
    base, wing = shape.nose_base, shape.nose_width
    x, y = np.abs(grid.x), grid.y
    along = np.clip((y + 0.05) / (base + 0.03), 0, 1.3)
    rim = base + 0.012 - 0.022 * np.exp(-(((x - wing * 0.45) / 0.030) ** 2))
    end = 1 - smoothstep(-0.034, 0.010, y - rim)
    rise = (0.032 + (shape.nose_depth - 0.070) * along**1.3) * end * smoothstep(-0.20, 0.05, y)
    half = 0.040 + 0.026 * along
    bridge = rise * np.exp(-((x / half) ** 2))
    flank = 0.040 * np.exp(-((x / (wing * 1.1)) ** 2)) * end * smoothstep(-0.02, 0.24, y)
    tip = 0.046 * _bump(grid, 0.0, base - 0.046, 0.048, 0.044) * end
    round_wing = np.hypot((x - wing * 0.76) / 0.034, (y - base + 0.032) / 0.040)
    wings = 0.046 * np.exp(-(round_wing**2.4))
    crease = -0.010 * np.exp(-(((round_wing - 1.45) / 0.30) ** 2)) * smoothstep(0.5, 0.8, x / wing)
    holes = -0.018 * _bump(grid, wing * 0.42, base - 0.004, 0.021, 0.010)
    septum = 0.012 * _bump(grid, 0.0, base + 0.002, 0.018, 0.018)
    return np.asarray(bridge + flank + tip + wings + crease + holes + septum)


def _lips(shape: Shape, grid: Grid) -> Image:
    line = seam(shape, grid.x)
    upper, lower = vermilion(shape, grid.x)
    d = grid.y - line
    side = np.abs(grid.x) / shape.mouth_width
    inside = smoothstep(1.10, 0.70, side)
    tu = -d / np.maximum(upper, 0.012)
    tl = d / np.maximum(lower, 0.012)
    top = 0.016 * _swelling(tu, 0.62, 0.42) + 0.007 * _bump(
        grid, 0.0, shape.mouth - 0.016, 0.03, 0.02
    )
    low = 0.026 * _swelling(tl, 0.48, 0.40)
    relief = np.where(d < 0, top, low) * inside - 0.009 * np.exp(-((d / 0.008) ** 2)) * inside
    corner = 0.014 * np.exp(-(((side - 1.05) / 0.11) ** 2) - (d / 0.026) ** 2)
    ridge = np.exp(-(((np.abs(grid.x) - 0.042) / 0.018) ** 2))
    groove = np.exp(-((grid.x / 0.022) ** 2)) - 0.8 * ridge
    philtrum = 0.005 * groove * smoothstep(0.13, 0.09, -d) * smoothstep(0.03, 0.06, -d)
    return np.asarray(relief - corner - philtrum)


def _swelling(t: Image, peak: float, spread: float) -> Image:
    """Profile across a lip: from the seam (t = 0) over its fullest part to the skin."""
    z = (t - peak) / np.where(t < peak, peak, spread * 1.5)
    return np.exp(-(z * z)) * (t > -0.2)


def fold_relief(shape: Shape, grid: Grid) -> Image:
    """Relief of the nasolabial folds: a crease with the cheek bulging beside it."""
    top, end = shape.nose_base - 0.045, shape.mouth + 0.075
    t = (grid.y - top) / (end - top)
    path = 0.128 + 0.118 * np.clip(t, -0.1, 1.1) ** 1 - 0.035 * np.clip(t, 0, 1.2) ** 3
    d = np.abs(grid.x) - path
    along = smoothstep(-0.12, 0.20, t) * smoothstep(1.15, 0.55, t)
    crease = -0.009 * np.exp(-((d / 0.020) ** 2))
    cheek = 0.020 * np.exp(-(((d - 0.065) / 0.055) ** 2))
    return np.asarray(shape.fold * along * (crease + cheek), dtype=np.float32)


def skin_albedo(performer: Performer, grid: Grid, rng: np.random.Generator) -> Image:
    """Colour of the skin, lips included: blood near the surface, pores, freckles, stubble."""
    shape, skin = performer.shape, performer.skin
    hw = grid.x.shape
    blush = 0.9 * _bump(grid, 0.27, 0.22, 0.15, 0.11)
    blush += 0.8 * _bump(grid, 0.0, shape.nose_base - 0.06, 0.10, 0.06)
    blush += 0.5 * _bump(grid, 0.0, shape.chin - 0.08, 0.12, 0.08) + 0.5 * _bump(
        grid, 0.5, 0.12, 0.07, 0.16
    )
    blush = skin.blush * (blush + 0.12 * noise(rng, hw, (0.05 * grid.px, 0.05 * grid.px)))
    tint = np.stack([1 + 0.04 * blush, 1 - 0.24 * blush, 1 - 0.24 * blush], axis=-1)
    out = np.asarray(skin.base, dtype=np.float32) * tint
    socket = _bump(grid, shape.eye_x - 0.01, 0.025, 0.12, 0.055)
    out *= 1 - socket[..., None] * np.array([0.13, 0.20, 0.17], dtype=np.float32)
    pores = noise(rng, hw, (0.007 * grid.px, 0.007 * grid.px))
    patches = noise(rng, hw, (0.022 * grid.px, 0.022 * grid.px))
    out *= (1 + skin.roughness * (0.022 * pores + 0.018 * patches))[..., None]
    return _stubble(_freckles(out, skin.freckles, grid, rng), performer, grid, rng)


def _freckles(albedo: Image, amount: float, grid: Grid, rng: np.random.Generator) -> Image:
    spots = noise(rng, grid.x.shape, (0.012 * grid.px, 0.012 * grid.px))
    where = _bump(grid, 0.19, 0.16, 0.20, 0.12) + _bump(grid, 0.0, 0.12, 0.12, 0.14)
    dots = amount * smoothstep(1.1, 2.0, spots) * np.minimum(where, 1)
    return np.asarray(albedo * (1 - dots[..., None] * np.array([0.22, 0.38, 0.45])), np.float32)


def _stubble(albedo: Image, performer: Performer, grid: Grid, rng: np.random.Generator) -> Image:
    shape, amount = performer.shape, performer.skin.stubble
    beard = smoothstep(0.30, 0.42, grid.y + 0.55 * (np.abs(grid.x) - 0.36))
    mouth = np.hypot(grid.x / (shape.mouth_width + 0.05), (grid.y - shape.mouth) / 0.10)
    moustache = smoothstep(0.20, 0.11, np.abs(grid.x)) * smoothstep(
        0.0, 0.03, grid.y - shape.nose_base
    )
    area = np.maximum(beard * smoothstep(0.9, 1.35, mouth), 0.9 * moustache)
    area = np.maximum(area, smoothstep(0.56, 0.62, grid.y) * beard)
    dots = 0.55 + 0.45 * noise(rng, grid.x.shape, (0.0045 * grid.px, 0.006 * grid.px))
    shadow = np.clip(amount * area * dots, 0, 1.5)[..., None]
    return np.asarray(albedo * (1 - shadow * np.array([0.36, 0.33, 0.26])), dtype=np.float32)


def _paint_lips(
    albedo: Image, lip: Image, performer: Performer, grid: Grid, rng: np.random.Generator
) -> Image:
    shape = performer.shape
    d = grid.y - seam(shape, grid.x)
    creases = noise(rng, grid.x.shape, (0.0085 * grid.px, 0.05 * grid.px))
    creases += 0.6 * noise(rng, grid.x.shape, (0.018 * grid.px, 0.07 * grid.px))
    inner = np.exp(-np.abs(d) / 0.0065)
    shade_ = 1 + 0.035 * creases - 0.58 * inner - 0.14 * (d < 0)
    colour = np.asarray(performer.skin.lip, dtype=np.float32) * shade_[..., None]
    return np.asarray(albedo + lip[..., None] * (colour - albedo), dtype=np.float32)


def lip_mask(shape: Shape, grid: Grid) -> Image:
    """1 on the vermilion, soft at its border."""
    upper, lower = vermilion(shape, grid.x)
    d = grid.y - seam(shape, grid.x)
    top = smoothstep(-0.005, 0.007, upper + d) * (d <= 0)
    low = smoothstep(-0.007, 0.008, lower - d) * (d > 0)
    return np.asarray((top + low) * (np.abs(grid.x) < shape.mouth_width), dtype=np.float32)


def paint_face(performer: Performer, grid: Grid, rng: np.random.Generator) -> Surface:
    """The face from hairline to chin, with everything that moves in its own field."""
    shape = performer.shape
    width = outline(shape, grid.y)
    alpha = np.clip((width - np.abs(grid.x)) * grid.px * 0.7 + 0.5, 0, 1)
    alpha *= width > 0.0
    alpha *= smoothstep(shape.chin + 0.002, shape.chin - 0.010, grid.y)
    height = blur(head_relief(shape, grid), 0.0045 * grid.px)
    fold = fold_relief(shape, grid)
    lip = blur(lip_mask(shape, grid), 0.003 * grid.px)
    albedo = _paint_lips(skin_albedo(performer, grid, rng), lip, performer, grid, rng)
    height = height + 0.00022 * performer.skin.roughness * noise(
        rng, grid.x.shape, (0.008 * grid.px, 0.008 * grid.px)
    )
    lit = occlusion(height + 0.35 * fold, grid.px)
    lit *= 1 - 0.38 * (1 - cast_shadow(height, performer.light, grid.px, 0.30))
    lit *= 1 - 0.80 * _bump(grid, shape.nose_width * 0.42, shape.nose_base - 0.006, 0.023, 0.010)
    zone = 0.55 + 0.5 * _bump(grid, 0.0, -0.3, 0.25, 0.2) + 0.6 * _bump(grid, 0.0, 0.15, 0.07, 0.2)
    gloss = performer.skin.gloss * (zone * (1 - lip) + 1.25 * lip)
    f = np.float32
    return Surface(
        albedo, f(1) * alpha, height, fold, blur(lit, 0.010 * grid.px), f(1) * gloss, lip
    )
