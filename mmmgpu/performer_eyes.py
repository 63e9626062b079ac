"""Eyes and brows: an eyeball under an opening in the lids, lashes, and strokes of brow hair.

The neutral face has closed lids. An open eye moves the lids' edges apart and squeezes the skin of
the upper lid up towards its crease, as `performer_geometry` does for the lips.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from mmmgpu.performer_head import Grid
from mmmgpu.performer_shading import Image, noise, smoothstep
from mmmgpu.performer_traits import Performer, Shape

_IRIS = 0.0405


@dataclass(frozen=True)
class Lids:
    """Edges of both eyes' openings at every pixel of a window: y [face units], shape (H, W).

    `across` is the position in the eye, -1 at the inner and 1 at the outer corner.
    """

    across: Image
    upper: Image
    lower: Image
    closed: Image


def lids(shape: Shape, x: Image, blink: float) -> Lids:
    """Lid edges above the abscissas `x` for a blink in [0, 1]."""
    across = (np.abs(x) - shape.eye_x) / shape.eye_width
    s = np.clip(across, -1, 1)
    tilt = -shape.eye_tilt * s
    arch_up = np.maximum(1 - np.abs(s + 0.10 * (1 - s * s)) ** 2.1, 0) ** 0.75
    arch_low = np.maximum(1 - np.abs(s - 0.12 * (1 - s * s)) ** 2.2, 0) ** 0.85
    up = tilt + 0.006 - 0.60 * shape.eye_open * arch_up
    low = tilt + 0.006 + 0.40 * shape.eye_open * arch_low
    closed = tilt + 0.006 + (low - tilt - 0.006) * 0.75
    f = np.float32
    return Lids(
        across.astype(f),
        (up + (closed - up) * blink).astype(f),
        (low + (closed - low) * blink).astype(f),
        closed.astype(f),
    )


def lid_map(edge: Lids, y: Image) -> Image:
    """Neutral y of the skin shown at y: the upper lid's skin slides, the rest stays."""
    top = -0.105
    span_now = np.maximum(edge.upper - top, 1e-3)
    t = np.clip((y - top) / span_now, 0, 1)
    slide = edge.upper - edge.closed  # < 0 when open
    upper = y - slide * t * t * (3 - 2 * t) * (y > top)
    bottom = 0.12
    tl = np.clip((bottom - y) / np.maximum(bottom - edge.lower, 1e-3), 0, 1)
    lower = y - (edge.lower - edge.closed) * tl * tl * (3 - 2 * tl)
    middle = (edge.upper + edge.lower) / 2
    width = smoothstep(1.5, 1.0, np.abs(edge.across))
    moved = np.where(y < middle, np.minimum(upper, edge.closed), np.maximum(lower, edge.closed))
    return np.asarray(y + width * (moved - y), dtype=np.float32)


def opening(edge: Lids, y: Image, px: float) -> Image:
    """Coverage of the eyeball, antialiased."""
    above = np.clip((y - edge.upper) * px * 0.8 + 0.5, 0, 1)
    below = np.clip((edge.lower - y) * px * 0.8 + 0.5, 0, 1)
    return np.asarray(above * below * (np.abs(edge.across) < 1), dtype=np.float32)


def paint_eyeballs(
    performer: Performer, grid: Grid, edge: Lids, gaze: tuple[float, float], fibres: Image
) -> Image:
    """Radiance of both eyeballs; `gaze` is the offset of the irises [face units]."""
    shape, light = performer.shape, performer.light
    side = np.sign(grid.x)
    cx = side * (shape.eye_x - 0.004) + gaze[0]
    dx, dy = grid.x - cx, grid.y + 0.004 - gaze[1]
    ball = np.hypot(grid.x - side * shape.eye_x, (grid.y - 0.004) * 1.25) / 0.125
    facing = 0.80 + 0.35 * (grid.x - side * shape.eye_x) / 0.11 * light.key_direction[0]
    depth = np.clip((grid.y - edge.upper) / 0.030, 0, 1)
    lit = facing * (1 - 0.50 * ball**2.2) * (0.38 + 0.62 * depth)
    white = np.array([0.52, 0.46, 0.42], np.float32)
    red = smoothstep(0.55, 1.0, np.abs(edge.across))[..., None] * np.array([0.0, 0.16, 0.16])
    out = (white - red) * lit[..., None]
    out = _iris(performer, out, np.hypot(dx, dy), np.arctan2(dy, dx * side), depth, fibres)
    kx, ky, _ = light.key_direction
    glint = np.hypot(dx - 0.020 * np.sign(kx), dy - 0.026 * np.sign(ky))
    small = np.hypot(dx + 0.016 * np.sign(kx), dy - 0.018)
    out += (0.85 * smoothstep(0.0125, 0.006, glint))[..., None]
    out += (0.09 * smoothstep(0.014, 0.004, small))[..., None]
    caruncle = smoothstep(-0.80, -0.95, edge.across)[..., None]
    return np.asarray(out + caruncle * (np.array([0.36, 0.16, 0.13]) * 0.8 - out), np.float32)


def _iris(
    performer: Performer, eye: Image, r: Image, angle: Image, depth: Image, fibres: Image
) -> Image:
    q = np.clip(r / _IRIS, 0, 1)
    streak = fibres[(q * 7).astype(int), ((angle + np.pi) * 60 / np.pi).astype(int) % 120]
    tone = 1.15 - 0.55 * smoothstep(0.70, 1.0, q) + 0.55 * smoothstep(0.75, 0.35, q) + 0.22 * streak
    colour = np.asarray(performer.skin.iris, np.float32) * tone[..., None]
    warm = smoothstep(0.65, 0.35, q)[..., None] * np.array([0.035, 0.016, 0.0], np.float32)
    colour = (colour + warm) * (0.30 + 0.85 * depth)[..., None]
    colour *= smoothstep(0.0165, 0.0205, r)[..., None] * 0.97 + 0.03
    cover = smoothstep(_IRIS + 0.003, _IRIS - 0.004, r)[..., None]
    return np.asarray(eye + cover * (colour - eye), np.float32)


def lash_shadow(shape: Shape, edge: Lids, y: Image, blink: float) -> Image:
    """Transmission (0 is black) of lashes, of the lid's crease and of the lower rim."""
    inside = smoothstep(1.10, 0.90, np.abs(edge.across))
    outer = 0.55 + 0.45 * smoothstep(-1.0, 0.4, edge.across)
    line = np.exp(-(((y - edge.upper + 0.002) / 0.0068) ** 2)) * 0.86 * outer
    below = np.exp(-(((y - edge.lower - 0.003) / 0.0050) ** 2)) * 0.30 * outer
    lift = 0.026 + 0.010 * np.clip(1 - edge.across**2, 0, 1)
    rest = lids(shape, np.abs(edge.across) * 0 + shape.eye_x + edge.across * shape.eye_width, 0.0)
    crease = np.exp(-(((y - rest.upper + lift) / 0.0065) ** 2)) * 0.42 * (1 - 0.65 * blink)
    crease *= smoothstep(1.25, 0.80, np.abs(edge.across))
    dark = 1 - np.clip(line + below, 0, 1) * inside
    return np.asarray(dark * (1 - crease), np.float32)


def brow_cover(performer: Performer, grid: Grid, rng: np.random.Generator) -> Image:
    """Coverage by brow hair: slanted strokes, dense in the middle, thin at the ends."""
    shape = performer.shape
    t = (np.abs(grid.x) - 0.085) / 0.245
    c = np.clip(t, -0.2, 1.2)
    rise, fall = np.minimum(c / 0.65, 1), np.maximum((c - 0.65) / 0.35, 0)
    arch = rise - 0.75 * fall**1.4
    middle = -shape.brow_height + 0.018 - shape.brow_arch * arch
    half = (
        shape.brow_thickness
        * (0.25 + 0.75 * smoothstep(-0.12, 0.30, t))
        * (1.05 - 0.75 * np.clip(t, 0, 1) ** 1.6)
    )
    d = (grid.y - middle) / np.maximum(half, 1e-3)
    slanted = grid.x - np.sign(grid.x) * 0.8 * (grid.y - middle) * (1.2 - c)
    strokes = noise(rng, grid.x.shape, (0.006 * grid.px, 0.040 * grid.px))
    cols = ((slanted - grid.x.min()) * grid.px).astype(np.float32)
    rows = ((grid.y - grid.y.min()) * grid.px).astype(np.float32)
    strokes = np.asarray(cv2.remap(strokes, cols, rows, cv2.INTER_LINEAR))
    body = smoothstep(1.35, 0.25, np.abs(d) + 0.20 * strokes)
    cover = body * smoothstep(-0.14, 0.22, t) * smoothstep(1.12, 0.80, t) * (0.72 + 0.16 * strokes)
    return np.asarray(np.clip(cover, 0, 0.92), np.float32)
