"""What surrounds the face: wall, neck, clothes, ears and hair, painted once per performer.

Hair is strands: noise that is long along the direction of growth (polar about the parting) and
short across it, lit as a volume with a band of gloss.
"""

import cv2
import numpy as np

from mmmgpu.performer_head import Grid, outline
from mmmgpu.performer_shading import Image, blur, noise, occlusion, shade, smoothstep
from mmmgpu.performer_traits import Performer


def over(below: Image, layer: Image, alpha: Image) -> Image:
    """`layer` painted over `below` with coverage `alpha` (H, W)."""
    return np.asarray(below + alpha[..., None] * (layer - below), dtype=np.float32)


def paint_behind(performer: Performer, grid: Grid, rng: np.random.Generator) -> Image:
    """Everything behind the face: wall, back hair, shoulders, neck, ears."""
    picture = _wall(performer, grid)
    if performer.hair.style == "long":
        alpha = _back_hair(performer, grid)
        picture = over(picture, 0.40 * _strands(performer, grid, rng, alpha), alpha)
    picture = _body(performer, grid, rng, picture)
    return _ears(performer, grid, picture)


def paint_front(performer: Performer, grid: Grid, rng: np.random.Generator) -> tuple[Image, Image]:
    """Hair in front of the face: picture (H, W, 3) and coverage (H, W)."""
    alpha = _front_mask(performer, grid, rng)
    return _strands(performer, grid, rng, alpha), alpha


def _wall(performer: Performer, grid: Grid) -> Image:
    """A plain studio wall, brighter about the head on the side of the fill light."""
    side = np.sign(performer.light.fill_direction[0])
    glow = np.exp(-(((grid.x - 0.35 * side) / 1.1) ** 2) - ((grid.y + 0.15) / 1.2) ** 2)
    wall = np.asarray(performer.hair.background, dtype=np.float32)
    return np.asarray(wall * (0.55 + 0.75 * glow)[..., None], dtype=np.float32)


def neck_half_width(performer: Performer, y: Image) -> Image:
    """Half the width of the neck at height y."""
    s = performer.shape
    flare = np.maximum(y - (s.chin + 0.10), 0)
    return np.asarray(s.neck + 0.02 * (s.chin - y) * 0.5 + 1.3 * flare**2 + 0.9 * flare**4)


def _shoulder_line(performer: Performer, x: Image) -> Image:
    """Height y of the trapezius and shoulder at x."""
    s = performer.shape
    d = np.maximum(np.abs(x) - s.neck * 0.92, 0)
    return np.asarray(s.chin + 0.125 + 0.21 * d**0.8 * (1.10 / s.shoulder) + 0.14 * d**3)


def _body(performer: Performer, grid: Grid, rng: np.random.Generator, below: Image) -> Image:
    shape, light = performer.shape, performer.light
    half = neck_half_width(performer, grid.y)
    t = np.clip(grid.x / half, -1, 1)
    column = 0.30 * np.sqrt(np.maximum(1 - np.abs(t) ** 2.2, 0)) * half / shape.neck
    line = _shoulder_line(performer, grid.x)
    torso = 0.34 * (1 - np.exp(-np.maximum(grid.y - line, 0) / 0.13))
    tendon = 0.020 * np.exp(
        -(((np.abs(grid.x) - 0.15 + 0.25 * (grid.y - shape.chin)) / 0.035) ** 2)
    )
    height = blur(np.asarray(np.maximum(column, torso) + tendon, np.float32), 0.02 * grid.px)
    skin = np.asarray(performer.skin.base, dtype=np.float32) * np.array(
        [0.97, 0.93, 0.92], np.float32
    )
    skin = skin * (1 + 0.02 * noise(rng, grid.x.shape, (0.02 * grid.px, 0.02 * grid.px)))[..., None]
    lit = occlusion(height, grid.px, 0.4)
    gloss = np.full_like(lit, 0.35 * performer.skin.gloss)
    flesh = shade(skin.astype(np.float32), height, lit, gloss, light, grid.px)
    alpha = np.clip((half - np.abs(grid.x)) * grid.px * 0.6 + 0.5, 0, 1)
    below = over(below, flesh, alpha * smoothstep(0.25, 0.35, grid.y))
    return _shirt(
        performer, grid, rng, over(below, flesh, smoothstep(-0.004, 0.006, grid.y - line))
    )


def _shirt(performer: Performer, grid: Grid, rng: np.random.Generator, below: Image) -> Image:
    shape, hair = performer.shape, performer.hair
    x, y = np.abs(grid.x), grid.y
    line = _shoulder_line(performer, grid.x)
    throat = shape.chin + (0.47 if hair.neckline == "vee" else 0.235)
    span = shape.neck * (1.04 if hair.neckline == "vee" else 1.12)
    bend = 1.15 if hair.neckline == "vee" else 2.0
    edge = throat - (throat - line + 0.03) * np.minimum(x / span, 1.0) ** bend
    edge = np.where(x > span, line - 0.03, edge)
    rim = np.exp(-(((y - edge - 0.022) / 0.020) ** 2))
    height = 0.34 * (1 - np.exp(-np.maximum(y - line + 0.03, 0) / 0.14)) + 0.016 * rim
    folds = noise(rng, x.shape, (0.12 * grid.px, 0.40 * grid.px))
    height = height + 0.012 * blur(folds, 0.02 * grid.px)
    weave = noise(rng, x.shape, (2.0, 2.0))
    cloth = np.asarray(hair.shirt, dtype=np.float32) * (1 + 0.07 * weave)[..., None]
    relief = blur(np.asarray(height, np.float32), 0.008 * grid.px)
    flat = np.full_like(relief, 0.02)
    body = shade(
        cloth.astype(np.float32),
        relief,
        occlusion(relief, grid.px, 0.6),
        flat,
        performer.light,
        grid.px,
    )
    alpha = smoothstep(-0.005, 0.005, y - edge)
    contact = blur(alpha, 0.022 * grid.px) * (1 - alpha)
    contact *= smoothstep(-0.02, 0.01, y - line)  # on the skin, not on the wall
    return over(below * (1 - 0.75 * contact)[..., None], body, alpha)


def _ears(performer: Performer, grid: Grid, below: Image) -> Image:
    if performer.hair.style == "long":
        return below
    top, end = -0.075, performer.shape.nose_base - 0.055
    cy, ry = (top + end) / 2, (end - top) / 2
    lean = np.abs(grid.x) - 0.492 + 0.10 * (grid.y - cy)
    dx, dy = lean / 0.072, (grid.y - cy) / ry
    r = np.sqrt(dx * dx * (1 + 0.35 * np.clip(dy, -1.5, 1.5)) + dy * dy)
    rim = np.exp(-(((r - 0.84) / 0.16) ** 2)) * smoothstep(-0.4, 0.3, dx)
    bowl = np.exp(-(((dx - 0.15) / 0.38) ** 2) - ((dy - 0.08) / 0.45) ** 2)
    height = 0.030 * rim - 0.030 * bowl + 0.05 * np.sqrt(np.maximum(1 - r * r, 0))
    height = blur(np.asarray(height, np.float32), 0.007 * grid.px)
    red = np.asarray(performer.skin.base, np.float32) * np.array([1.0, 0.80, 0.78], np.float32)
    albedo = np.broadcast_to(red, (*height.shape, 3)).astype(np.float32)
    lit = occlusion(height, grid.px, 1.2) * (1 - 0.45 * bowl)
    ear = shade(albedo, height, lit.astype(np.float32), 0.3 * lit, performer.light, grid.px)
    return over(below, 0.85 * ear, smoothstep(1.04, 0.96, r))


def _hairline(performer: Performer, x: Image) -> Image:
    """Height y of the hair's edge on the forehead, falling to the sideburns."""
    hair = performer.hair
    side = np.abs(x) / 0.46
    recess = hair.recess * np.exp(-(((np.abs(x) - 0.25) / 0.09) ** 2))
    if hair.style in ("long", "tied"):  # parted, so that the forehead shows up to the parting
        off = np.abs(x - 0.25 * hair.parting) / 0.46
        return np.asarray(hair.hairline - 0.115 + 0.62 * np.minimum(off, 1.25) ** 2.2)
    return np.asarray(hair.hairline + 0.48 * np.minimum(side, 1.15) ** 4 - recess)


def _outer(performer: Performer, grid: Grid) -> Image:
    """Distance inside the hair's outer border (> 0 inside) [face units, about]."""
    hair, top = performer.hair, performer.shape.skull
    a, b = 0.500 + 0.55 * hair.volume, 0.56 + hair.volume
    cy = -top + 0.56
    x = grid.x - 0.02 * np.sign(hair.parting)
    radius = (np.abs(x / a) ** 2.4 + np.abs(np.minimum(grid.y - cy, 0) / b) ** 2.4) ** (1 / 2.4)
    inside = (1 - radius) * a
    if hair.style == "long":
        wave = 0.012 * np.sin(7 * grid.y + 2 * np.sign(grid.x)) * smoothstep(-0.2, 0.2, grid.y)
        inside += 0.075 * smoothstep(-0.35, 0.55, grid.y) + wave
        inside -= 0.05 * smoothstep(0.75, 1.15, grid.y)
    return np.asarray(inside)


def _flow(performer: Performer, grid: Grid) -> tuple[Image, Image]:
    """Coordinates (across, along) the strands: polar about the crown, hanging below the ears."""
    hair = performer.hair
    dx = grid.x - hair.parting * (1.0 if hair.style == "side" else 0.25)
    dy = grid.y + performer.shape.skull + 0.12
    angle, along = np.arctan2(dx, dy), np.hypot(dx, dy)
    fall = smoothstep(-0.35, 0.15, grid.y) * (hair.style == "long")
    hang = grid.x * 1.6 + 0.03 * np.sin(7 * grid.y + 2 * np.sign(grid.x))
    bend = 0.10 * np.sin(3.2 * along + 2 * np.sign(dx))
    return (angle + bend) * (1 - fall) + fall * hang, along


def _front_mask(performer: Performer, grid: Grid, rng: np.random.Generator) -> Image:
    hair = performer.hair
    across, along = _flow(performer, grid)
    fine, wide = _comb(rng, across, along, 150), _comb(rng, across, along, 45)
    wisps = 0.6 * fine + 0.5 * wide
    inside = smoothstep(-0.012, 0.012, _outer(performer, grid) + 0.004 * wisps)
    line = _hairline(performer, grid.x)
    soft = 0.040
    if hair.style == "side":
        sweep = np.sign(hair.parting) * (grid.x - hair.parting)
        line = line - 0.09 * np.exp(-((sweep / 0.08) ** 2)) + 0.06 * smoothstep(-0.02, -0.30, sweep)
        soft = 0.024
    above = smoothstep(-soft, soft, line - grid.y + 0.010 * wisps)
    if hair.style == "long":
        return np.asarray(inside * np.maximum(above, _curtains(grid, wisps)), np.float32)
    end = 0.09 if hair.style in ("short", "side") else 0.02
    burn = smoothstep(end + 0.03, end - 0.07, grid.y + 0.02 * wisps)
    edge = outline(performer.shape, grid.y)
    strip = smoothstep(edge - 0.060, edge - 0.006, np.abs(grid.x) + 0.008 * wisps)
    strip *= smoothstep(-0.42, -0.30, grid.y)
    return np.asarray(inside * burn * np.maximum(above, strip), np.float32)


def _curtains(grid: Grid, wisps: Image) -> Image:
    """Long hair that falls in front of the ears on both sides."""
    wave = 0.016 * np.sin(7 * grid.y + 2 * np.sign(grid.x)) + 0.006 * wisps
    inner = 0.425 + 0.05 * smoothstep(-0.25, 0.15, grid.y) - 0.07 * smoothstep(0.35, 1.0, grid.y)
    start = smoothstep(-0.30, -0.12, grid.y)
    return smoothstep(-0.006, 0.026, np.abs(grid.x) - inner + wave - 0.05 * (1 - start))


def _back_hair(performer: Performer, grid: Grid) -> Image:
    """Long hair behind the neck."""
    return smoothstep(-0.012, 0.012, _outer(performer, grid)) * smoothstep(-0.4, -0.3, grid.y)


def _strands(performer: Performer, grid: Grid, rng: np.random.Generator, alpha: Image) -> Image:
    """Radiance of a body of hair that grows away from the crown."""
    hair, light = performer.hair, performer.light
    across, along = _flow(performer, grid)
    fine, wide = _comb(rng, across, along, 230), _comb(rng, across, along, 40)
    cap = np.clip(_outer(performer, grid) / 0.24, 0, 1)
    volume = 0.22 * np.sqrt(np.maximum(1 - (1 - cap) ** 2, 0))
    relief = blur(np.asarray(volume + 0.010 * wide, np.float32), 0.008 * grid.px)
    edge = blur(alpha, 0.030 * grid.px)
    lit = np.clip(0.35 + 0.65 * edge, 0, 1) * (1 - 0.10 * np.clip(-wide, -1, 2))
    albedo = np.asarray(hair.colour, np.float32) * np.exp(0.26 * fine + 0.16 * wide)[..., None]
    flat = np.zeros_like(relief)
    body = shade(albedo.astype(np.float32), relief, lit.astype(np.float32), flat, light, grid.px)
    sheen = _sheen(performer, grid, fine, lit)[..., None] * _sheen_colour(hair.colour)
    return np.asarray(body + sheen, np.float32)


def _sheen_colour(colour: tuple[float, float, float]) -> Image:
    return 0.5 * np.asarray(colour, np.float32) ** 0.6 + np.float32(0.05)


def _sheen(performer: Performer, grid: Grid, fine: Image, lit: Image) -> Image:
    """The band of gloss across the strands, where they turn towards the light."""
    kx = performer.light.key_direction[0]
    height = -0.62 + 0.45 * (grid.x - 0.25 * kx) ** 2
    band = np.exp(-(((grid.y - height + 0.02 * fine) / 0.10) ** 2))
    side = np.exp(-(((grid.x - 0.30 * np.sign(kx)) / 0.30) ** 2))
    return np.asarray(0.32 * band * side * lit * (1 + 0.35 * fine), dtype=np.float32)


def _comb(rng: np.random.Generator, across: Image, along: Image, count: int) -> Image:
    """Streaks: `count` strands a unit of `across`, slowly varying along their length."""
    table = rng.normal(size=(24, 4 * count)).astype(np.float32)
    table = np.asarray(cv2.GaussianBlur(table, (0, 0), 0.8), np.float32)
    u = ((across - across.min()) * count) % (4 * count - 2)
    streak = cv2.remap(
        table, u.astype(np.float32), (along * 9 % 22).astype(np.float32), cv2.INTER_LINEAR
    )
    return np.asarray(streak / table.std(), dtype=np.float32)
