"""An active appearance model from clips with landmarks.

Frames are read one at a time. What is learned from is a bounded number of frames, spread evenly
over all clips, so that memory does not grow with them.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mmmgpu.appearances import (
    Aam,
    check_light,
    fit_light,
    read_texture,
    reduce_picture,
    reduce_points,
    take_light_off,
)
from mmmgpu.backends import default_threads, get_backend
from mmmgpu.components import Components, gram_of, principal_components
from mmmgpu.errors import InputError
from mmmgpu.labelled_clips import ROWS, LabelledClip, Rows, read_labelled_clips, steadiness
from mmmgpu.meshes import Mesh, doubled_areas, fold_depths, make_mesh, triangulate
from mmmgpu.parallel import Cancelled, map_ordered, one_thread_each
from mmmgpu.progress import progress
from mmmgpu.shapes import align, procrustes_mean
from mmmgpu.videos import read_chosen_frames

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]

LARGEST = 20_000  # pixels of the mean shape; larger frames are reduced
PARAMETERS = 32  # features of a frame, as in ECR07
SHAPE_SHARE = 0.99  # of the variance of shapes that fitting follows; the rest is jitter
TEXTURES = 8  # modes that fitting looks through; with many of them even a jaw can be explained
FOLDED = 0.1  # of a shape's size: a triangle that is turned over by more is an error
STILL = 1e-6  # [px] landmarks that move less do not move
LIGHT_ITERATIONS = 4  # of the mean texture and the lights of the frames


def fit_aam(
    clips: Sequence[Path],
    landmarks: Path,
    *,
    parameters: int | None = None,
    variance: float | None = None,
    rows: Rows | None = ROWS,
    frames: int = 1000,
    backend: str = "warp",
) -> Aam:
    """Learn how the shape and the texture of a face vary.

    Args:
        clips: Video files of one person.
        landmarks: Folder with ``NAME.npz`` or ``NAME.json`` for every clip.
        parameters: Length of the features; `PARAMETERS`, if `variance` is not given either.
        variance: In place of `parameters`: the share of the variance that they must have, (0, 1].
        rows: Which landmarks of a frame are used; None: all of them.
        frames: Learned from at most; evenly spread over the clips.
        backend: A name for `mmmgpu.backends.get_backend`.

    Raises:
        InputError: A clip or its landmarks cannot be used, or there are too few frames.
    """
    _check_options(parameters, variance, frames)
    number = PARAMETERS if parameters is None else parameters
    with one_thread_each():
        labelled = read_labelled_clips([Path(c) for c in clips], Path(landmarks), rows)
        sample = _spread(labelled, frames)
        points = np.concatenate([c.points[i] for c, i in zip(labelled, sample, strict=True)])
        _check_number(len(points), number if variance is None else 1)
        steady = steadiness(rows, points.shape[1])
        mesh, reduction = _mean_mesh(points, steady)
        _check_folds(labelled, mesh, reduction)
        shapes, _ = align(reduce_points(points, reduction), mesh.vertices, steady)
        if np.ptp(shapes, axis=0).max() < STILL:
            raise InputError("the landmarks never move; give frames that differ")
        textures = _read_textures(labelled, sample, mesh, reduction, backend)
        mean = _in_one_light(textures, _names(labelled, sample))
        textures -= mean
        s, g = (shapes - mesh.vertices).reshape(len(points), -1), textures.reshape(len(points), -1)
        shape_gram, texture_gram = gram_of(s), gram_of(g)
        weight = _weight(shape_gram, texture_gram)
        shape, texture = principal_components(shape_gram), principal_components(texture_gram)
        both = principal_components(weight**2 * shape_gram + texture_gram)
        n = _count(both, number, variance)
        k, m = shape.count_for(SHAPE_SHARE), min(TEXTURES, len(texture.variance))
        return Aam(
            mesh=mesh,
            steadiness=steady,
            rows=rows,
            reduction=reduction,
            shape_modes=shape.modes(s, k).reshape(k, -1, 2),
            shape_variance=shape.variance[:k],
            texture_mean=mean,
            texture_modes=texture.modes(g, m).reshape(m, -1, 3).astype(np.float32),
            texture_variance=texture.variance[:m],
            weight=weight,
            modes_of_shape=both.modes(weight * s, n).reshape(n, -1, 2),
            modes_of_texture=both.modes(g, n).reshape(n, -1, 3).astype(np.float32),
            variance=both.variance[:n],
            share=both.share_of(n),
            notes={"clips": [c.path.name for c in labelled], "frames": len(points)},
        )


def _check_options(parameters: int | None, variance: float | None, frames: int) -> None:
    if parameters is not None and variance is not None:
        raise InputError("parameters and variance: either says how many features; give one of them")
    if parameters is not None and parameters < 1:
        raise InputError(f"parameters must be at least 1, got {parameters}")
    if variance is not None and not 0 < variance <= 1:
        raise InputError(f"variance must be a share above 0, at most 1, got {variance}")
    if frames < 2:
        raise InputError(f"frames must be at least 2, got {frames}")


def _check_number(frames: int, parameters: int) -> None:
    if frames <= parameters:
        raise InputError(
            f"{frames} labelled frame(s) are too few for {parameters} parameters; give more clips, "
            f"or fewer parameters than frames"
        )


def _spread(labelled: Sequence[LabelledClip], most: int) -> list[Numbers]:
    """Which of its labelled frames each clip gives, `most` in all, evenly spread."""
    ends = np.cumsum([len(c.frames) for c in labelled])
    count = min(most, int(ends[-1]))
    chosen = (np.arange(count) * int(ends[-1])) // count
    return [
        chosen[(chosen >= end - len(c.frames)) & (chosen < end)] - (end - len(c.frames))
        for c, end in zip(labelled, ends, strict=True)
    ]


def _names(labelled: Sequence[LabelledClip], sample: Sequence[Numbers]) -> list[str]:
    """Of every sampled frame, for errors."""
    pairs = zip(labelled, sample, strict=True)
    return [f"{c.path}, frame {c.frames[i]}" for c, chosen in pairs for i in chosen]


def _mean_mesh(points: Floats, steady: Floats) -> tuple[Mesh, int]:
    """The mesh of the mean of shapes (S, N, 2) [px], and by which factor frames are reduced."""
    mean = procrustes_mean(points, steady)
    area = float(np.abs(doubled_areas(mean, triangulate(mean))).sum()) / 2
    reduction = max(1, int(np.ceil(np.sqrt(area / LARGEST))))
    return make_mesh(mean / reduction), reduction


def _check_folds(labelled: Sequence[LabelledClip], mesh: Mesh, reduction: int) -> None:
    """No triangle is turned over by more than jitter can."""
    size = np.sqrt(((mesh.vertices - mesh.vertices.mean(axis=0)) ** 2).sum(axis=1).mean())
    for clip in labelled:
        depth = fold_depths(clip.points / reduction, mesh.triangles)
        if depth.max(initial=0) > FOLDED * size:
            t, k = np.unravel_index(int(depth.argmax()), depth.shape)
            raise InputError(
                f"{clip.path}: frame {clip.frames[t]}: the triangle between landmarks "
                f"{', '.join(map(str, mesh.triangles[k]))} is turned over by "
                f"{depth[t, k] * reduction:.1f} px; correct the landmarks or leave the clip out"
            )


def _read_textures(
    labelled: Sequence[LabelledClip],
    sample: Sequence[Numbers],
    mesh: Mesh,
    reduction: int,
    backend: str,
) -> F32:
    """The textures (S, P, 3) of the sampled frames, as seen."""
    kernels = get_backend(backend, 1)

    def one(item: tuple[LabelledClip, Numbers], _: Cancelled) -> F32:
        clip, chosen = item
        at = reduce_points(clip.points[chosen], reduction)
        pictures = read_chosen_frames(clip.path, clip.frames[chosen])
        read = [
            read_texture(mesh, reduce_picture(picture, reduction), p, kernels)
            for picture, p in zip(pictures, at, strict=True)
        ]
        return np.reshape(np.array(read, np.float32), (-1, len(mesh.pixels.index), 3))

    textures = np.empty((sum(map(len, sample)), len(mesh.pixels.index), 3), np.float32)
    items = list(zip(labelled, sample, strict=True))
    done = map_ordered(one, items, threads=default_threads())
    end = 0
    for part in progress(done, "read textures", total=len(items)):
        textures[end : end + len(part)] = part
        end += len(part)
    return textures


def _in_one_light(textures: F32, names: Sequence[str]) -> F32:
    """Take the light off `textures` (S, P, 3), in place; their mean, (P, 3).

    Mean and lights are found in turns; the mean keeps the light of the mean picture.
    """
    mean = anchor = textures.mean(axis=0)
    for _ in range(LIGHT_ITERATIONS):
        lights = [fit_light(texture, mean) for texture in textures]
        total = np.zeros(mean.shape)
        for texture, light, name in zip(textures, lights, names, strict=True):
            check_light(light, name)
            total += take_light_off(texture, light)
        mean = np.asarray(total / len(textures), np.float32)
        mean = take_light_off(mean, fit_light(mean, anchor))
    for t, texture in enumerate(textures):
        textures[t] = take_light_off(texture, fit_light(texture, mean))
    return np.asarray(textures.mean(axis=0), np.float32)


def _weight(shape_gram: Floats, texture_gram: Floats) -> float:
    """W: shapes and textures vary equally much (Cootes & Taylor 2004)."""
    return float(np.sqrt(np.trace(texture_gram) / np.trace(shape_gram)))


def _count(both: Components, parameters: int, variance: float | None) -> int:
    """Of the features."""
    if variance is not None:
        return both.count_for(variance)
    if parameters > len(both.variance):
        raise InputError(
            f"the labelled frames vary in {len(both.variance)} ways only, too few for {parameters} "
            "parameters; give more clips or fewer parameters"
        )
    return parameters
