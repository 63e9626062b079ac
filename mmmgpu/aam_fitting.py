"""Fitting an appearance model to a frame without landmarks: project-out inverse compositional
Gauss-Newton, coarse to fine.

With the mean texture A_0, the picture I read through the warp W(x; p), and the warp's parameters p
(a similarity and the shape modes), one step solves

    min_dp  |I(W(x; p)) - A_0(W(x; dp))|^2        over what no texture mode and no light explains

and composes: W(p) <- W(p) o W(dp)^-1. Everything on the side of A_0 is constant: with the steepest
descent images D = grad A_0 dW/dp, and Q an orthonormal basis of texture modes and lights,

    dp = (H + L)^-1 (D_o' (I(W(p)) - A_0) + L p),    D_o = D - Q Q' D,    H = D_o' D_o

The prior L = r / variance of the shape modes (0 for the similarity) is ours: it keeps what a
picture says little of, such as points along the jaw, near the mean.

Sources: Baker & Matthews, "Lucas-Kanade 20 years on" (IJCV 56, 2004); Matthews & Baker, "Active
appearance models revisited" (IJCV 60, 2004).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mmmgpu.appearances import (
    Aam,
    aligned,
    enlarge_points,
    fit_light,
    project,
    read_texture,
    reduce_picture,
    reduce_points,
    take_light_off,
)
from mmmgpu.backends import Backend
from mmmgpu.errors import InputError
from mmmgpu.meshes import Mesh, Pixels, rasterize
from mmmgpu.shapes import place

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]

FACTORS = (4, 2, 1)  # by which the picture is reduced, one level after the other
LEAST_PIXELS = 400  # of a level; fewer do not tell shape from texture
STEPS = 30  # of a level at most
SETTLED = 0.02  # [px] that no point moves further when a level is done
ASTRAY = 1.2  # growth of what the texture misses by at which a level has gone astray
FARTHEST = 3.0  # standard deviations of a shape mode
POSES = 4  # parameters of the similarity
PRIOR = 1e-2  # r: as if every colour of the texture, in [0, 1], were off by 0.1
LEAST_LIGHT = 0.2  # of a gain while the points may still be far off


@dataclass(frozen=True)
class Level:
    """What is constant at one size of the picture; D = 4 + K parameters.

    factor: reduction against the picture that the mesh lies in.
    mesh: the mean shape at this size.
    mean: A_0, (P, 3).
    step: (H + L)^-1 D_o', (D, 3 P).
    pull: (H + L)^-1 L, (D, D).
    """

    factor: int
    mesh: Mesh
    mean: F32
    step: Floats
    pull: Floats


@dataclass(frozen=True)
class Fitter:
    """A model made ready for fitting.

    levels: from coarse to fine.
    directions: how the vertices move with each parameter, (D, N, 2) [px of the mesh].
    inverse_sides: inverse of two sides of each triangle of the mesh, (K, 2, 2).
    shares: of each triangle in the affine map at each vertex, (N, K).
    """

    aam: Aam
    levels: tuple[Level, ...]
    directions: Floats
    inverse_sides: Floats
    shares: Floats


@dataclass(frozen=True)
class Match:
    """A model fitted to a frame.

    shape: its points, (N, 2) [px of the frame].
    features: c, (n,).
    pose, light: of the frame, (4,) and (3, 2); see `mmmgpu.appearances.Seen`.
    residual: root mean square of what the texture differs by, colours in [0, 1].
    settled: whether the points had come to rest.
    """

    shape: Floats
    features: Floats
    pose: Floats
    light: Floats
    residual: float
    settled: bool


def prepare_fitting(aam: Aam) -> Fitter:
    """Compute what is constant in fitting `aam`."""
    mesh = aam.mesh
    directions = np.concatenate([_similarities(mesh.vertices), aam.shape_modes])
    levels = (_level(aam, directions, factor) for factor in FACTORS)
    large = tuple(at for at in levels if at.factor == 1 or len(at.mean) >= LEAST_PIXELS)
    meets = (mesh.triangles[None] == np.arange(len(mesh.vertices))[:, None, None]).any(axis=2)
    shares = np.asarray(meets / meets.sum(axis=1, keepdims=True), np.float64)
    inverse_sides = np.asarray(np.linalg.inv(_sides(mesh, mesh.vertices)), np.float64)
    return Fitter(aam, large, directions, inverse_sides, shares)


def match(fitter: Fitter, frame: NDArray[np.uint8], start: Floats, kernels: Backend) -> Match:
    """Fit the model to `frame` (H, W, 3) from the points `start` (N, 2) [px], some pixels away.

    Raises:
        InputError: `start` has another number of points or is not finite.
    """
    aam = fitter.aam
    start = np.asarray(start, np.float64)
    if start.shape != aam.mesh.vertices.shape or not np.isfinite(start).all():
        raise InputError(
            f"start must be {len(aam.mesh.vertices)} finite points (x, y), has shape {start.shape}"
        )
    points, settled = reduce_points(start, aam.reduction), False
    for level in fitter.levels:
        picture = reduce_picture(frame, aam.reduction * level.factor)
        points, settled = _descend(fitter, level, picture, points, kernels)
    texture = read_texture(aam.mesh, picture, points, kernels)
    light = fit_light(texture, aam.texture_mean)
    plain = take_light_off(texture, _visible(light))
    (shape,), (pose,) = aligned(aam, points[None])
    c = project(aam, shape, plain)
    n = len(aam.variance)
    missed = (plain - aam.texture_mean).ravel() - c @ aam.modes_of_texture.reshape(n, -1)
    residual = float(np.sqrt(np.mean(missed**2)))
    return Match(enlarge_points(points, aam.reduction), c, pose, light, residual, settled)


def _descend(
    fitter: Fitter, level: Level, picture: F32, points: Floats, kernels: Backend
) -> tuple[Floats, bool]:
    """Points (N, 2) after the steps of one level, and whether they had come to rest.

    Where the picture ends up explained much worse than at the start, the start is kept.
    """
    start, first = points, _missed(level, picture, points, kernels)
    missed = first
    for _ in range(STEPS):
        change = level.step @ missed + level.pull[:, POSES:] @ _shape_of(fitter.aam, points)
        new = compose(fitter, points, change)
        settled = bool(np.abs(new - points).max() < SETTLED)
        points, missed = new, _missed(level, picture, new, kernels)
        if settled:
            break
    astray = np.linalg.norm(missed) > ASTRAY * np.linalg.norm(first)
    return (start, False) if astray else (points, settled)


def _missed(level: Level, picture: F32, points: Floats, kernels: Backend) -> F32:
    """What the texture at `points` (N, 2), in the light of the mean, differs by from it, (3 P,)."""
    texture = read_texture(level.mesh, picture, reduce_points(points, level.factor), kernels)
    light = _visible(fit_light(texture, level.mean))
    return (take_light_off(texture, light) - level.mean).ravel()


def _visible(light: Floats) -> Floats:
    """A light under which something can be seen, also where the start is far off."""
    return np.stack([np.maximum(light[:, 0], LEAST_LIGHT), light[:, 1]], axis=-1)


def compose(fitter: Fitter, points: Floats, change: Floats) -> Floats:
    """The points of W(p) o W(dp)^-1, kept to what the model can be: (N, 2), (D,) -> (N, 2).

    The vertices of the mesh move by -dp to first order; what W does beside a vertex is the mean of
    the affine maps of the triangles that meet there.
    """
    aam, mesh = fitter.aam, fitter.aam.mesh
    back = -np.tensordot(change, fitter.directions, axes=1)  # (N, 2)
    affine = _sides(mesh, points) @ fitter.inverse_sides  # (K, 2, 2)
    at_vertex = np.tensordot(fitter.shares, affine, axes=1)
    moved = points + (at_vertex @ back[..., None])[..., 0]
    (shape,), (pose,) = aligned(aam, moved[None])
    b = np.tensordot(aam.shape_modes, shape - mesh.vertices, axes=2)
    limit = FARTHEST * np.sqrt(aam.shape_variance)
    model = mesh.vertices + np.tensordot(np.clip(b, -limit, limit), aam.shape_modes, axes=1)
    return place(pose, model)


def _shape_of(aam: Aam, points: Floats) -> Floats:
    """b (K,) of points (N, 2) of the reduced picture."""
    (shape,), _ = aligned(aam, points[None])
    return np.tensordot(aam.shape_modes, shape - aam.mesh.vertices, axes=2)


def warp_jacobian(pixels: Pixels, triangles: NDArray[np.int32], directions: Floats) -> Floats:
    """dW/dp at every pixel: directions (D, N, 2) -> (P, 2, D)."""
    corners = directions[:, triangles[pixels.index]]  # (D, P, 3, 2)
    return np.asarray(np.einsum("pj,dpjc->pcd", pixels.barycentric.astype(np.float64), corners))


def _similarities(vertices: Floats) -> Floats:
    """Orthonormal directions of size, turn and place, (4, N, 2)."""
    centred = vertices - vertices.mean(axis=0)
    turned = np.stack([-centred[:, 1], centred[:, 0]], axis=1)
    across, down = (np.broadcast_to(axis, vertices.shape) for axis in np.eye(2))
    ways = np.stack([centred, turned, across, down])
    return np.asarray(ways / np.sqrt((ways**2).sum(axis=(1, 2), keepdims=True)))


def _sides(mesh: Mesh, points: Floats) -> Floats:
    """Two sides of every triangle as columns, (K, 2, 2)."""
    a, b, c = (points[mesh.triangles[:, i]] for i in range(3))
    return np.stack([b - a, c - a], axis=-1)


def _level(aam: Aam, directions: Floats, factor: int) -> Level:
    mesh, blocks = _coarse(aam.mesh, factor)
    mean = aam.texture_mean[blocks].mean(axis=1)  # (P, 3)
    modes = aam.texture_modes[:, blocks].mean(axis=2)  # (L, P, 3)
    jacobian = warp_jacobian(mesh.pixels, mesh.triangles, directions / factor)
    descent = np.einsum("pca,pad->pcd", _gradient(mesh, mean), jacobian)
    descent = descent.reshape(-1, len(directions))
    hidden = np.linalg.qr(_unexplained(mean, modes))[0]
    descent = descent - hidden @ (hidden.T @ descent)
    prior = np.zeros(len(directions))
    prior[POSES:] = PRIOR / factor**2 / aam.shape_variance
    inverse = np.linalg.inv(descent.T @ descent + np.diag(prior))
    mean = np.asarray(mean, np.float32)
    return Level(factor, mesh, mean, inverse @ descent.T, inverse * prior)


def _unexplained(mean: F32, modes: F32) -> Floats:
    """Ways in which a texture differs that say nothing of shape, (3 P, 6 + L): lights and modes."""
    number = len(mean)
    lights = np.zeros((6, number, 3))
    for colour in range(3):
        lights[colour, :, colour] = 1
        lights[3 + colour, :, colour] = mean[:, colour]
    return np.concatenate([lights, modes]).reshape(6 + len(modes), -1).T


def _coarse(mesh: Mesh, factor: int) -> tuple[Mesh, NDArray[np.int64]]:
    """The mesh in a reduced picture, and the pixels of `mesh` under each of its own, (P, factor^2).

    A coarse pixel counts if all that it covers lies in the mesh.
    """
    shape = tuple(-(-n // factor) for n in mesh.shape)
    numbers = np.full((shape[0] * factor, shape[1] * factor), -1)
    y, x = np.divmod(mesh.pixels.place, mesh.shape[1])
    numbers[y, x] = np.arange(len(mesh.pixels.place))
    split = numbers.reshape(shape[0], factor, shape[1], factor)
    blocks = split.swapaxes(1, 2).reshape(-1, factor**2)
    vertices = reduce_points(mesh.vertices, factor)
    found = rasterize(vertices, mesh.triangles, (shape[0], shape[1]))
    whole = (blocks[found.place] >= 0).all(axis=1)
    pixels = Pixels(found.place[whole], found.index[whole], found.barycentric[whole])
    return Mesh(vertices, mesh.triangles, (shape[0], shape[1]), pixels), blocks[pixels.place]


def _gradient(mesh: Mesh, texture: F32) -> Floats:
    """Central differences (P, 3, 2) of a texture (P, 3); 0 where a neighbour is no pixel of it."""
    height, width = mesh.shape
    picture = np.full((height + 2, width + 2, 3), np.nan)
    inner = np.full((height * width, 3), np.nan)
    inner[mesh.pixels.place] = texture
    picture[1:-1, 1:-1] = inner.reshape(height, width, 3)
    across = (picture[1:-1, 2:] - picture[1:-1, :-2]) / 2
    down = (picture[2:, 1:-1] - picture[:-2, 1:-1]) / 2
    both = np.stack([across, down], axis=-1).reshape(-1, 3, 2)[mesh.pixels.place]
    known = np.isfinite(both).all(axis=(1, 2), keepdims=True)
    return np.where(known, both, 0.0)
