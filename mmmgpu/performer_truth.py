"""What is true of a rendered frame: flow, masks and landmarks, from the geometry alone.

A pixel shows one of two moving layers. The face carries neutral points (u, v) through the maps of
`performer_geometry`; all else (hair, ears, neck, clothes, wall) only follows the head's pose.
Both maps are inverted to about 1e-8 px, so the flow is exact, not estimated. Pictures are as by
`render`; eyes are left out (not valid) when the lids or the gaze move, and so is the inside of the
mouth, whose teeth and tongue slide behind the lips.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mmmgpu.performer_articulation import Articulation
from mmmgpu.performer_eyes import lids
from mmmgpu.performer_geometry import (
    Columns,
    Pucker,
    apply_pose,
    columns,
    from_neutral,
    pucker,
    seam,
    squeeze,
    to_neutral,
    undo_pose,
    unsqueeze,
    vermilion,
)
from mmmgpu.performer_head import Grid, lip_mask, outline
from mmmgpu.performer_render import portrait
from mmmgpu.performer_shading import Image
from mmmgpu.performer_traits import Field, Performer, Shape

Array = Field
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class _View:
    """One frame as seen at points (N,): head coordinates, neutral coordinates, layers."""

    x: Array
    y: Array
    u: Array
    v: Array
    upper: Mask
    inside: Mask
    face: Mask


def pixel_centres(performer: Performer) -> tuple[Array, Array]:
    """Face-unit coordinates of all pixels, each (H * W,)."""
    height, width = performer.size
    rows, cols = np.mgrid[0:height, 0:width].astype(np.float64)
    ox, oy = performer.origin
    return ((cols - ox) / performer.scale).ravel(), ((rows - oy) / performer.scale).ravel()


def _mouth(performer: Performer, articulation: Articulation, t: int) -> Pucker:
    return pucker(performer.shape, articulation.at(t))


def _look(performer: Performer, p: Pucker, x: Array, y: Array) -> _View:
    """What the head shows at its own points (x, y)."""
    shape = performer.shape
    c = columns(shape, p, x)
    top, bottom = c.upper_lip(), c.lower_lip()
    upper = y < (top + bottom) / 2
    edge = np.where(upper, np.minimum(y, top), np.maximum(y, bottom))
    v = to_neutral(c, edge, upper)
    u = squeeze(shape, p, x, v)
    inside = (y > top) & (y < bottom)
    face = _sample(performer, portrait(performer).colour[..., 3], u, v) > 0.5
    front = _sample(performer, portrait(performer).front_alpha, x, y) > 0.5
    return _View(x, y, u, v, upper, inside, face & ~front)


def _sample(performer: Performer, layer: Image, x: Array, y: Array) -> Array:
    """Nearest value of a supersampled layer at face coordinates."""
    grid = portrait(performer).grid
    cols = np.rint((x - grid.x[0, 0]) * grid.px).astype(int).clip(0, layer.shape[1] - 1)
    rows = np.rint((y - grid.y[0, 0]) * grid.px).astype(int).clip(0, layer.shape[0] - 1)
    return np.asarray(layer[rows, cols])


def _show(shape: Shape, p: Pucker, u: Array, v: Array, upper: Mask) -> tuple[Array, Array]:
    """Head point of the neutral points (u, v) on the side `upper` of the lips."""
    x = unsqueeze(shape, p, u, v)
    c: Columns = columns(shape, p, x)
    return x, from_neutral(c, v, upper)


def true_flow(
    performer: Performer, articulation: Articulation, a: int, b: int
) -> tuple[NDArray[np.float32], Mask]:
    """Flow [px] (H, W, 2) from frame `a` to `b`, and where it is valid (H, W)."""
    px, py = pixel_centres(performer)
    hx, hy = undo_pose(articulation.pose[a], px, py)
    seen = _look(performer, _mouth(performer, articulation, a), hx, hy)
    after = _mouth(performer, articulation, b)
    fx, fy = _show(performer.shape, after, seen.u, seen.v, seen.upper)
    qx, qy = np.where(seen.face, fx, hx), np.where(seen.face, fy, hy)
    again = _look(performer, after, qx, qy)
    valid = (again.face == seen.face) & ~seen.inside
    if articulation.blink[a] != articulation.blink[b] or np.any(
        articulation.gaze[a] != articulation.gaze[b]
    ):
        valid &= ~_about_the_eyes(performer.shape, hx, hy)
    rx, ry = apply_pose(articulation.pose[b], qx, qy)
    dx, dy = (rx - px) * performer.scale, (ry - py) * performer.scale
    ox, oy = performer.origin
    height, width = performer.size
    cols, rows = rx * performer.scale + ox, ry * performer.scale + oy
    valid &= (np.abs(cols - (width - 1) / 2) <= (width - 1) / 2 + 1e-6) & (
        np.abs(rows - (height - 1) / 2) <= (height - 1) / 2 + 1e-6
    )
    flow = np.stack([dx, dy], axis=-1).reshape(height, width, 2).astype(np.float32)
    return flow, valid.reshape(height, width)


def _about_the_eyes(shape: Shape, x: Array, y: Array) -> Mask:
    near = np.abs(np.abs(x) - shape.eye_x) < 1.6 * shape.eye_width
    return np.asarray(near & (y > -0.12) & (y < 0.13))


def true_masks(performer: Performer, articulation: Articulation, t: int) -> dict[str, Mask]:
    """Masks (H, W) of frame `t` by name; see `mmmgpu.performer.masks`."""
    px, py = pixel_centres(performer)
    hx, hy = undo_pose(articulation.pose[t], px, py)
    seen = _look(performer, _mouth(performer, articulation, t), hx, hy)
    on_lip = lip_mask(performer.shape, Grid(np.float32(1) * seen.u, np.float32(1) * seen.v, 1.0))
    lips = (on_lip > 0.5) & ~seen.inside
    flat = {"face": seen.face, "inside": seen.inside, "lips": lips, "mouth": lips | seen.inside}
    return {name: np.asarray(mask).reshape(performer.size) for name, mask in flat.items()}


def true_landmarks(performer: Performer, articulation: Articulation, t: int) -> NDArray[np.float64]:
    """The 103 points (x, y) [px] of frame `t`; see `mmmgpu.performer.landmarks`."""
    shape, p = performer.shape, _mouth(performer, articulation, t)
    skin, upper = _skin_points(shape)
    x, y = _show(shape, p, skin[:, 0], skin[:, 1], upper)
    eyes = _eye_points(shape, float(articulation.blink[t]))
    points = np.insert(np.stack([x, y], axis=1), 75, eyes, axis=0)
    qx, qy = apply_pose(articulation.pose[t], points[:, 0], points[:, 1])
    found = np.stack([qx, qy], axis=1) * performer.scale + performer.origin
    return np.asarray(found, np.float64)


def _skin_points(shape: Shape) -> tuple[Array, Mask]:
    """Neutral points that the skin carries, without the eyes, and the lip's side of each."""
    ring = np.pi * (1 + np.arange(20) / 10)  # from the right corner along the lower lip and back
    u = shape.mouth_width * np.cos(ring)
    line = seam(shape, u)
    thick_up, thick_low = vermilion(shape, u)
    upper = np.arange(20) > 10
    outer = np.stack([u, np.where(upper, line - thick_up, line + thick_low)], axis=1)
    inner = np.stack([0.97 * u, seam(shape, 0.97 * u)], axis=1)
    rest = np.concatenate([_jaw_points(shape), _nose_points(shape), _cheek_points(shape)])
    sides = np.concatenate([upper, upper, rest[:, 1] < seam(shape, rest[:, 0])])
    return np.concatenate([outer, inner, rest]), sides


def _jaw_points(shape: Shape) -> Array:
    """21 points of the outline from the right ear by the chin to the left ear."""
    t = np.linspace(0, np.pi / 2, 11)
    y = 0.05 + (shape.chin - 0.004 - 0.05) * np.sin(t)
    half = outline(shape, y.astype(np.float32)) * (np.arange(11) < 10)
    right = np.stack([-half, y], axis=1)
    return np.concatenate([right, right[-2::-1] * (-1, 1)])


def _nose_points(shape: Shape) -> Array:
    """8 points down the ridge, then three pairs about the wings (right, left)."""
    ridge = np.stack([np.zeros(8), np.linspace(0.0, shape.nose_base, 8)], axis=1)
    wing, base = shape.nose_width, shape.nose_base
    pairs = [(wing * 0.95, base - 0.005), (wing * 1.04, base - 0.055), (wing * 1.05, base - 0.030)]
    return np.concatenate([ridge, [(s * x, y) for x, y in pairs for s in (-1, 1)]])


def _cheek_points(shape: Shape) -> Array:
    """7 pairs on the cheeks (right, left), then two points of the chin."""
    m, c = shape.mouth, shape.chin
    spots = [(0.30, 0.21), (0.24, 0.25), (0.32, 0.28), (0.22, 0.35), (0.20, m - 0.05)]
    spots += [(0.18, m + 0.08), (0.21, m + 0.085)]
    chin = [(0.0, m + 0.55 * (c - m)), (0.0, m + 0.70 * (c - m))]
    return np.asarray([(s * x, y) for x, y in spots for s in (-1, 1)] + chin)


def _eye_points(shape: Shape, blink: float) -> Array:
    """Six points an eye, right eye first: corners and two points on each lid."""
    s = np.array([1.0, 0.35, -0.35, -1.0, -0.35, 0.35])  # outer corner, upper lid, inner, lower lid
    x = (shape.eye_x + s * shape.eye_width).astype(np.float32)
    edge = lids(shape, x, blink)
    y = np.where([False, True, True, False, False, False], edge.upper, edge.lower)
    right = np.stack([-x, y], axis=1).astype(np.float64)
    left = (right * (-1, 1))[[3, 2, 1, 0, 5, 4]]
    left[4:] = left[[5, 4]]
    return np.concatenate([right, left])
