"""From a performer and its articulation to pictures.

The neutral head is painted once (`portrait`). A frame re-lights only what moves: the lower face,
deformed and shaded anew from its relief, and the eyes; then the head's pose moves everything.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from mmmgpu.performer_articulation import Articulation
from mmmgpu.performer_eyes import (
    brow_cover,
    lash_shadow,
    lid_map,
    lids,
    opening,
    paint_eyeballs,
)
from mmmgpu.performer_geometry import Pucker, columns, pose_weight, pucker, squeeze, to_neutral
from mmmgpu.performer_head import Grid, Surface, make_grid, paint_face
from mmmgpu.performer_mouth import Opening, paint_inside
from mmmgpu.performer_portrait import neck_half_width, over, paint_behind, paint_front
from mmmgpu.performer_shading import Image, blur, shade, smoothstep, to_bytes
from mmmgpu.performer_traits import Performer

_REST_FOLD = 0.40


@dataclass(frozen=True)
class Portrait:
    """The neutral head in layers, and the parts of the picture that move.

    `colour` (albedo and alpha), `relief` (height, fold, lit and gloss) and `lip` are the moving
    layer, the face; `behind` and `front` lie below and above it; `shadow` is what the chin takes
    from `behind`; `still` is the finished neutral picture (uint8); `mouth` and `eyes` are the
    windows of it that every frame paints again.
    """

    grid: Grid
    colour: Image
    relief: Image
    lip: Image
    behind: Image
    front: Image
    front_alpha: Image
    shadow: Image
    weight: Image
    fibres: Image
    still: NDArray[np.uint8]
    mouth: tuple[slice, slice]
    eyes: tuple[slice, slice]


@lru_cache(maxsize=4)
def portrait(performer: Performer) -> Portrait:
    """Paint the neutral head (about a second; kept for the last few performers)."""
    rng = np.random.default_rng((performer.seed, 7))
    grid = make_grid(performer)
    face = paint_face(performer, grid, rng)
    face = _with_brows(performer, face, brow_cover(performer, grid, rng))
    behind = paint_behind(performer, grid, rng)
    front, front_alpha = paint_front(performer, grid, rng)
    shadow = _chin_shadow(performer, face.alpha, grid) * smoothstep(
        1.02, 0.96, np.abs(grid.x) / neck_half_width(performer, grid.y)
    )
    roots = blur(front_alpha, 0.020 * grid.px) * (1 - front_alpha)
    face = replace(face, lit=face.lit * (1 - 0.45 * roots))
    shape = performer.shape
    mouth = _window(grid, -0.58, 0.58, shape.mouth - 0.165, shape.chin + 0.24)
    reach = shape.eye_x + 1.6 * shape.eye_width
    eyes = _window(grid, -reach, reach, -0.12, 0.13)
    skin = _shade_face(performer, grid, face, _REST_FOLD)
    picture = over(behind * (1 - shadow)[..., None], skin, face.alpha)
    still = to_bytes(over(picture, front, front_alpha))
    weight = np.float32(1) * pose_weight(grid.x, grid.y)
    fibres = np.random.default_rng((performer.seed, 8)).normal(size=(8, 120)).astype(np.float32)
    colour = np.dstack([face.albedo, face.alpha])
    relief = np.dstack([face.height, face.fold, face.lit, face.gloss])
    layers = colour, relief, face.lip, behind, front, front_alpha, shadow
    return Portrait(grid, *layers, weight, fibres, still, mouth, eyes)


def _with_brows(performer: Performer, face: Surface, cover: Image) -> Surface:
    colour = 0.7 * np.asarray(performer.hair.colour, np.float32) + np.float32(0.015)
    albedo = over(face.albedo, colour, cover)
    return replace(face, albedo=albedo, gloss=face.gloss * (1 - cover))


def _chin_shadow(performer: Performer, alpha: Image, grid: Grid) -> Image:
    kx, ky, _ = performer.light.key_direction
    move = np.array([[1, 0, -0.10 * kx * grid.px], [0, 1, -0.16 * ky * grid.px]])
    size = alpha.shape[::-1]
    far = blur(np.asarray(cv2.warpAffine(alpha, move, size)), 0.045 * grid.px)
    near = blur(alpha, 0.030 * grid.px)
    return np.asarray(np.clip(0.62 * far + 0.30 * near, 0, 0.80), np.float32)


def _window(grid: Grid, x0: float, x1: float, y0: float, y1: float) -> tuple[slice, slice]:
    cols = np.searchsorted(grid.x[0], [x0, x1])
    rows = np.searchsorted(grid.y[:, 0], [y0, y1])
    return slice(int(rows[0]), int(rows[1])), slice(int(cols[0]), int(cols[1]))


def _inset(window: tuple[slice, slice]) -> tuple[slice, slice]:
    """The window without its border, where slopes cannot be told."""
    rows, cols = window
    return slice(rows.start + 2, rows.stop - 2), slice(cols.start + 2, cols.stop - 2)


def _shade_face(performer: Performer, grid: Grid, face: Surface, fold: float) -> Image:
    height = face.height + np.float32(fold) * face.fold
    return shade(face.albedo, height, face.lit, face.gloss, performer.light, grid.px)


def render_frames(
    performer: Performer, articulation: Articulation, rng: np.random.Generator | None
) -> Iterator[NDArray[np.uint8]]:
    """Pictures (H, W, 3) of every frame, one at a time."""
    for t in range(len(articulation)):
        frame = paint_frame(performer, articulation, t)
        yield frame if rng is None else _camera_noise(frame, rng)


def _camera_noise(frame: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Sensor noise: stronger in the light, the same for neighbouring lines of no frame."""
    grain = rng.standard_normal(frame.shape, dtype=np.float32)
    level = 0.7 + 1.0 * np.sqrt(frame.astype(np.float32) / 255)
    return np.asarray(np.clip(frame + grain * level + 0.5, 0, 255), np.uint8)


def paint_frame(performer: Performer, articulation: Articulation, t: int) -> NDArray[np.uint8]:
    """Picture (H, W, 3) of frame `t`, without noise."""
    art = portrait(performer)
    canvas = art.still.copy()
    repaint(performer, art, canvas, articulation, t)
    pose = articulation.pose[t]
    moved = _posed(art, canvas, pose) if pose.any() else canvas
    height, width = performer.size
    return np.asarray(cv2.resize(moved, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def repaint(
    performer: Performer,
    art: Portrait,
    canvas: NDArray[np.uint8],
    articulation: Articulation,
    t: int,
) -> None:
    """Paint what moves at frame `t` into `canvas`, a copy of the still picture."""
    lower = _paint_lower_face(performer, art, articulation.at(t))
    canvas[_inset(art.mouth)] = to_bytes(lower[2:-2, 2:-2])
    _paint_eyes(performer, art, canvas, articulation.blink[t], articulation.gaze[t])


def _posed(
    art: Portrait, canvas: NDArray[np.uint8], pose: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Move the head (the map of `undo_pose`)."""
    g, (dx, dy, roll, log_scale) = art.grid, np.asarray(pose, np.float32)
    c, s = np.cos(-roll) * np.exp(-log_scale), np.sin(-roll) * np.exp(-log_scale)
    px, py = g.x - dx, g.y - dy - np.float32(0.7)
    hx = g.x + art.weight * (c * px - s * py - g.x)
    hy = g.y + art.weight * (s * px + c * py + np.float32(0.7) - g.y)
    cols, rows = _pixels(g, hx, hy)
    moved = cv2.remap(canvas, cols, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, np.uint8)


def _pixels(grid: Grid, x: Image, y: Image) -> tuple[Image, Image]:
    """Columns and rows of the supersampled grid at face coordinates."""
    return (x - grid.x[0, 0]) * np.float32(grid.px), (y - grid.y[0, 0]) * np.float32(grid.px)


def _carry(layer: Image, cols: Image, rows: Image) -> Image:
    return np.asarray(
        cv2.remap(layer, cols, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    )


def _carry_surface(art: Portrait, cols: Image, rows: Image) -> Surface:
    """The face as seen through a map of pixels."""
    colour, relief, lip = (_carry(layer, cols, rows) for layer in (art.colour, art.relief, art.lip))
    return Surface(
        np.ascontiguousarray(colour[..., :3]),
        colour[..., 3],
        relief[..., 0],
        relief[..., 1],
        relief[..., 2],
        relief[..., 3],
        lip,
    )


def _paint_lower_face(performer: Performer, art: Portrait, a: dict[str, float]) -> Image:
    shape = performer.shape
    grid = art.grid.window(*art.mouth)
    p = pucker(shape, a)
    c = columns(shape, p, grid.x[0].astype(np.float64))
    top, bottom = c.upper_lip().astype(np.float32), c.lower_lip().astype(np.float32)
    upper = grid.y < (top + bottom) / 2
    y = np.where(upper, np.minimum(grid.y, top), np.maximum(grid.y, bottom))
    v = to_neutral(c, y, upper)
    u = squeeze(shape, p, grid.x, v)
    cols, rows = _pixels(art.grid, np.float32(1) * u, np.float32(1) * v)
    cols, rows = cols.astype(np.float32), rows.astype(np.float32)
    face = _carry_surface(art, cols, rows)
    skin = _shade_face(performer, grid, _swell(performer, grid, face, p, a, top, bottom), _fold(a))
    aperture = _aperture(grid, Opening(top, bottom))
    if aperture.any():
        seen = _around(aperture)
        part, between = grid.window(*seen), Opening(top[seen[1]], bottom[seen[1]])
        tongue = a["tongue_height"], a["tongue_advance"]
        inside = paint_inside(performer, part, p, between, tongue)
        skin[seen] = over(skin[seen], inside, aperture[seen])
    shadow = _carry(art.shadow, cols, rows)
    picture = over(art.behind[art.mouth] * (1 - shadow)[..., None], skin, face.alpha)
    return over(picture, art.front[art.mouth], art.front_alpha[art.mouth])


def _fold(a: dict[str, float]) -> float:
    """How deep the nasolabial folds are."""
    return _REST_FOLD + 1.3 * max(a["width"] - 0.5, 0) + 0.25 * a["upper_lip"] - 0.25 * a["round"]


def _aperture(grid: Grid, gap: Opening) -> Image:
    """Coverage of the opening between the lips, antialiased; 0 where they touch."""
    span = (gap.lower - gap.upper) * grid.px
    above = np.clip((grid.y - gap.upper) * grid.px + 0.5, 0, 1)
    below = np.clip((gap.lower - grid.y) * grid.px + 0.5, 0, 1)
    return np.asarray(above * below * np.clip(span, 0, 1), np.float32)


def _around(cover: Image) -> tuple[slice, slice]:
    """The window of all that `cover` covers, which is something."""
    rows, cols = (np.flatnonzero(cover.any(axis=axis)) for axis in (1, 0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1)


def _swell(
    performer: Performer,
    grid: Grid,
    face: Surface,
    p: Pucker,
    a: dict[str, float],
    top: Image,
    bottom: Image,
) -> Surface:
    """Relief that the deformation alone does not give: protruding lips, lips rolling inwards."""
    mid = (p.upper + p.lower) / 2 + performer.shape.mouth
    r = (grid.x / (p.half_width * 1.15)) ** 2 + ((grid.y - mid) / 0.115) ** 2
    forward = (0.055 * a["round"] - 0.012 * a["press"]) * np.exp(-r * r)
    edge = np.minimum(np.abs(grid.y - top), np.abs(grid.y - bottom))
    wide = smoothstep(1.0, 0.85, np.abs(grid.x) / p.half_width)
    openness = min(max(p.lower - p.upper, 0.0) / 0.03, 1.0)
    roll = -0.010 * openness * wide * np.exp(-edge / 0.010)
    height = np.asarray(face.height + forward + roll, np.float32)
    return replace(face, height=height)


def _paint_eyes(
    performer: Performer,
    art: Portrait,
    canvas: NDArray[np.uint8],
    blink: float,
    gaze: NDArray[np.float64],
) -> None:
    """Paint the eyes' window of `canvas`."""
    shape, grid = performer.shape, art.grid.window(*art.eyes)
    edge = lids(shape, grid.x, float(blink))
    v = lid_map(edge, grid.y)
    cols, rows = _pixels(art.grid, grid.x, v)
    face = _carry_surface(art, cols, rows)
    skin = _shade_face(performer, grid, face, _REST_FOLD)
    skin = skin * lash_shadow(shape, edge, grid.y, float(blink))[..., None]
    balls = paint_eyeballs(performer, grid, edge, (float(gaze[0]), float(gaze[1])), art.fibres)
    balls = balls * (0.35 + 0.65 * lash_shadow(shape, edge, grid.y, 1.0))[..., None]
    picture = over(skin, balls, opening(edge, grid.y, grid.px))
    picture = over(picture, art.front[art.eyes], art.front_alpha[art.eyes])
    near = (np.abs(edge.across) < 1.55)[2:-2, 2:-2, None]
    part = _inset(art.eyes)
    canvas[part] = np.where(near, to_bytes(picture[2:-2, 2:-2]), canvas[part])
