"""The active appearance model: how shape and texture of a face vary, in one short vector a frame.

    s = mean + sum_k b_k P_k             shape, points in the frame of the mean shape
    g = mean + sum_l d_l G_l             texture, colours at the pixels of the mean shape
    (W (s - mean), g - mean) = sum_i c_i Q_i     both together: the features c

The pose of the head (a similarity) and the light (gain and offset of each colour) are taken off
before, frame by frame, and kept apart: they are no part of c, and are put back when a frame is
rendered. The modes Q_i are orthonormal over both parts, so c is a projection.

Sources: Cootes, Edwards & Taylor, "Active appearance models" (PAMI 23, 2001); used for speech by
Englebienne, Cootes & Rattray (NIPS 2007), section 2.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mmmgpu.backends import Backend
from mmmgpu.errors import InputError
from mmmgpu.meshes import Mesh
from mmmgpu.shapes import align

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]

LEAST_GAIN = 0.02  # of a texture: below it there is nothing to be seen


@dataclass(frozen=True)
class Aam:
    """An active appearance model of one person; N points, P pixels, n parameters.

    mesh: the mean shape, its triangles and pixels.
    steadiness: weights of the points where a pose is found, (N,).
    rows: which landmarks of a frame the points are; None: all.
    reduction: frames are averaged over squares of so many pixels before anything else.
    shape_modes, shape_variance: P_k, (K, N, 2) [px of the mesh], and their variances, (K,).
    texture_mean: (P, 3), RGB in [0, 1].
    texture_modes, texture_variance: G_l, (L, P, 3), and their variances, (L,).
    weight: W [1/px]: how much a pixel of shape counts in units of colour.
    modes_of_shape, modes_of_texture: the two parts of Q_i, (n, N, 2) and (n, P, 3).
    variance: of the features, (n,).
    share: of the variance of shape and texture that the features have.
    notes: what it was made of.
    """

    mesh: Mesh
    steadiness: Floats
    rows: tuple[int, ...] | None
    reduction: int
    shape_modes: Floats
    shape_variance: Floats
    texture_mean: F32
    texture_modes: F32
    texture_variance: Floats
    weight: float
    modes_of_shape: Floats
    modes_of_texture: F32
    variance: Floats
    share: float
    notes: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Seen:
    """Frames as a model sees them.

    features: c, (T, n).
    poses: of the heads, (T, 4): from the mesh to the reduced frame; see `mmmgpu.shapes`.
    lights: gain and offset of each colour, (T, 3, 2): as seen = gain * model + offset.
    """

    features: Floats
    poses: Floats
    lights: Floats

    def __len__(self) -> int:
        return len(self.features)


def aligned(aam: Aam, points: Floats) -> tuple[Floats, Floats]:
    """Points (T, N, 2) of reduced pictures in the frame of the mesh, and their poses (T, 4)."""
    return align(points, aam.mesh.vertices, aam.steadiness)


def reduce_picture(picture: Picture, factor: int) -> F32:
    """A frame (H, W, 3) averaged over squares of `factor` pixels, as float32 in [0, 1]."""
    height, width = (n // factor for n in picture.shape[:2])
    cut = picture[: height * factor, : width * factor].astype(np.float32) / np.float32(255)
    if factor == 1:
        return cut
    return np.asarray(cv2.resize(cut, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def reduce_points(points: Floats, factor: float) -> Floats:
    """Points (..., 2) of a frame in its reduced picture."""
    return (points + 0.5) / factor - 0.5


def enlarge_points(points: Floats, factor: float) -> Floats:
    """Points (..., 2) of a reduced picture in the frame."""
    return (points + 0.5) * factor - 0.5


def read_texture(mesh: Mesh, picture: F32, points: Floats, kernels: Backend) -> F32:
    """Colours (P, 3) of a picture (H, W, 3) at the mesh's pixels; its vertices are at `points`."""
    pixels = mesh.pixels
    given = (picture[None], points[None].astype(np.float32))
    constant = (mesh.triangles, pixels.index, pixels.barycentric)
    read = kernels.piecewise_warp(*(kernels.to_device(a) for a in (*given, *constant)))
    return np.array(kernels.to_host(read)[0])


def fit_light(texture: F32, mean: F32) -> Floats:
    """Gain and offset of each colour, (3, 2): those of least squares with
    ``texture ~ gain * mean + offset``, (P, 3) both."""
    g, m = (np.array(colours.T, np.float64, order="C") for colours in (texture, mean))  # (3, P)
    dm = m - m.mean(axis=1, keepdims=True)  # sums to 0: g need not be centred
    gain = np.vecdot(g, dm) / np.maximum(np.vecdot(dm, dm), 1e-12)
    return np.stack([gain, g.mean(axis=1) - gain * m.mean(axis=1)], axis=-1)


def take_light_off(texture: F32, light: Floats) -> F32:
    """A texture (P, 3) as it were in the light of the mean."""
    return np.asarray((texture - light[:, 1]) / light[:, 0], np.float32)


def put_light_on(texture: F32, light: Floats) -> F32:
    """A texture (P, 3) in the light (3, 2) of a frame."""
    return np.asarray(texture * light[:, 0] + light[:, 1], np.float32)


def check_light(light: Floats, where: str) -> None:
    """Raise unless something could be seen between the landmarks."""
    if not (light[:, 0] >= LEAST_GAIN).all():
        raise InputError(
            f"{where}: what lies between the landmarks does not look like the face of the others; "
            "correct the landmarks or leave the clip out"
        )


def project(aam: Aam, shape: Floats, texture: F32) -> Floats:
    """The features (n,) of an aligned shape (N, 2) and a texture without light (P, 3)."""
    s = aam.weight * (shape - aam.mesh.vertices)
    g = (texture - aam.texture_mean).ravel()
    n = len(aam.variance)
    from_shape = aam.modes_of_shape.reshape(n, -1) @ s.ravel()
    return np.asarray(from_shape + aam.modes_of_texture.reshape(n, -1) @ g, np.float64)


def synthesize_shape(aam: Aam, features: Floats) -> Floats:
    """The shape (..., N, 2) [px of the mesh] of features (..., n)."""
    return aam.mesh.vertices + np.tensordot(features, aam.modes_of_shape, axes=1) / aam.weight


def synthesize_texture(aam: Aam, features: Floats) -> F32:
    """The texture (..., P, 3), in the light of the mean, of features (..., n)."""
    moved = np.tensordot(features.astype(np.float32), aam.modes_of_texture, axes=1)
    return np.asarray(aam.texture_mean + moved, np.float32)


def see(
    aam: Aam, frames: Iterable[Picture], points: Floats, kernels: Backend, *, where: str
) -> Seen:
    """Frames (T of them) as the model sees them where their landmarks are: `points` (T, N, 2) [px].

    where: names the frames in errors.

    Raises:
        InputError: There is no such face between the landmarks.
    """
    shapes, poses = aligned(aam, reduce_points(points, aam.reduction))
    features, lights = [], []
    for t, (frame, p, shape) in enumerate(zip(frames, points, shapes, strict=True)):
        picture = reduce_picture(frame, aam.reduction)
        at = reduce_points(p, aam.reduction)
        texture = read_texture(aam.mesh, picture, at, kernels)
        light = fit_light(texture, aam.texture_mean)
        check_light(light, f"{where}, frame {t}")
        features.append(project(aam, shape, take_light_off(texture, light)))
        lights.append(light)
    n = len(aam.variance)
    return Seen(np.reshape(features, (-1, n)), poses, np.reshape(lights, (-1, 3, 2)))
