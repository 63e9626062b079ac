"""Synthetic faces put back into video frames, under the frame's own pose and light.

The mesh reaches to the outline of its landmarks only. When the new face has another outline than
the frame's own (a jaw that is further down), what lies around it is moved along: a ring of
triangles between the outline and points outside it, which stay. Along the outline the face fades
into the frame, moved likewise.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from mmmgpu.appearances import (
    Aam,
    aligned,
    check_light,
    enlarge_points,
    fit_light,
    put_light_on,
    read_texture,
    reduce_picture,
    reduce_points,
    synthesize_shape,
    synthesize_texture,
)
from mmmgpu.backends import Backend
from mmmgpu.meshes import Ints, Mesh, Pixels, rasterize
from mmmgpu.shapes import place

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]

RING = 1.35  # size of the ring that stays, about the outline
GREY = 128  # about a face that is drawn alone
FADE = 0.03  # of the outline's width: over so much the face fades into the frame


def render_face(
    aam: Aam, frame: Picture, points: Floats, features: Floats, kernels: Backend, *, where: str
) -> Picture:
    """`frame` (H, W, 3) with the face of `features` (n,) in place of its own.

    points: landmarks of the frame's own face, (N, 2) [px]: they say its pose and its light.
    where: names the frame in errors.

    Raises:
        InputError: There is no such face between the landmarks.
    """
    at = reduce_points(points, aam.reduction)
    texture = read_texture(aam.mesh, reduce_picture(frame, aam.reduction), at, kernels)
    light = fit_light(texture, aam.texture_mean)
    check_light(light, where)
    _, (pose,) = aligned(aam, at[None])
    wanted = enlarge_points(place(pose, synthesize_shape(aam, features)), aam.reduction)
    colours = put_light_on(synthesize_texture(aam, features), light)
    return _compose(aam.mesh, frame, (points, wanted), colours, kernels)


def draw_face(aam: Aam, features: Floats, kernels: Backend, *, scale: float = 3.0) -> Picture:
    """The face of `features` (n,) alone, on grey, `scale` times as large as the mean shape's
    picture, uint8 (h, w, 3); it stands there as the mean shape does.
    """
    mesh, margin = aam.mesh, max(aam.mesh.shape) // 8
    shape = synthesize_shape(aam, features) + margin
    height, width = (round(scale * (n + 2 * margin)) for n in mesh.shape)
    pixels = rasterize(enlarge_points(shape, scale), mesh.triangles, (height, width))
    texture = _texture_picture(mesh, synthesize_texture(aam, features), kernels)
    colours = _read(texture, mesh.vertices, mesh.triangles, pixels, kernels)
    picture = np.full((height * width, 3), GREY, np.uint8)
    picture[pixels.place] = np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8)
    return picture.reshape(height, width, 3)


def _compose(
    mesh: Mesh, frame: Picture, moved: tuple[Floats, Floats], colours: F32, kernels: Backend
) -> Picture:
    """`frame` with its landmarks moved from the one place to the other, and `colours` over it."""
    now, wanted = moved
    ring = now.mean(axis=0) + RING * (now - now.mean(axis=0))
    triangles = np.concatenate([mesh.triangles, _ring_triangles(mesh)])
    pixels = rasterize(np.concatenate([wanted, ring]), triangles, frame.shape[:2])
    source = np.concatenate([now, ring])
    shown = _read(frame.astype(np.float32), source, triangles, pixels, kernels)
    inside = pixels.index < len(mesh.triangles)
    face = Pixels(pixels.place[inside], pixels.index[inside], pixels.barycentric[inside])
    picture = _texture_picture(mesh, colours, kernels)
    over = 255 * _read(picture, mesh.vertices, mesh.triangles, face, kernels)
    opacity = _opacity(face, frame.shape[:2], float(np.ptp(wanted[:, 0])))
    shown[inside] += opacity[:, None] * (over - shown[inside])
    result = frame.copy()
    result.reshape(-1, 3)[pixels.place] = np.clip(np.rint(shown), 0, 255).astype(np.uint8)
    return result


def _ring_triangles(mesh: Mesh) -> Ints:
    """Triangles between the outline of the mesh and the points N ... 2 N - 1, outside of 0 ..."""
    t, n = mesh.triangles, len(mesh.vertices)
    edges = {(int(a), int(b)) for k in range(3) for a, b in zip(t[:, k], t[:, k - 2], strict=True)}
    outline = sorted((a, b) for a, b in edges if (b, a) not in edges)
    near = [(b, a, n + a) for a, b in outline]
    far = [(b, n + a, n + b) for a, b in outline]
    return np.array(near + far, np.int32)


def _read(picture: F32, vertices: Floats, triangles: Ints, pixels: Pixels, kernels: Backend) -> F32:
    """Colours (P, 3) of a picture (H, W, 3) at pixels of triangles whose vertices lie there."""
    return read_texture(Mesh(vertices, triangles, (0, 0), pixels), picture, vertices, kernels)


def _texture_picture(mesh: Mesh, colours: F32, kernels: Backend) -> F32:
    """The texture (P, 3) as a picture, continued beyond its outline, (h, w, 3)."""
    height, width = mesh.shape
    picture = np.zeros((1, height * width, 3), np.float32)
    weight = np.zeros((1, height * width), np.float32)
    picture[0, mesh.pixels.place], weight[0, mesh.pixels.place] = colours, 1
    field, known = picture.reshape(1, height, width, 3), weight.reshape(1, height, width)
    filled = kernels.fill_holes(kernels.to_device(field), kernels.to_device(known), 0.5)
    return np.array(kernels.to_host(filled)[0])


def _opacity(face: Pixels, shape: tuple[int, ...], width: float) -> F32:
    """Of the face at each of its pixels, (P,): from 0 at the outline to 1 within."""
    inside = np.zeros(shape[0] * shape[1], np.uint8)
    inside[face.place] = 1
    depth = cv2.distanceTransform(inside.reshape(shape[:2]), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    share = np.clip(depth.ravel()[face.place] / max(1.0, FADE * width), 0, 1)
    return np.asarray(share, np.float32)
