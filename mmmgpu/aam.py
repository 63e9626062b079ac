"""Active appearance models (ECR07, section 2): features of a face, and faces from features.

    model = fit_aam(clips, landmarks)
    c = features(model, clip, landmarks)          # (T, 32)
    for frame in reconstruct(model, c, clip, landmarks):
        ...

This module is the door; the work is in `mmmgpu.aam_training`, `mmmgpu.appearances`,
`mmmgpu.aam_fitting`, `mmmgpu.aam_tracking`, `mmmgpu.aam_rendering` and `mmmgpu.aam_files`.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mmmgpu.aam_files import load_aam, save_aam
from mmmgpu.aam_fitting import Fitter, Match, match, prepare_fitting
from mmmgpu.aam_rendering import render_face
from mmmgpu.aam_tracking import Start, Tracked, start_in_box, track_clip
from mmmgpu.aam_training import fit_aam
from mmmgpu.appearances import Aam, Seen, see
from mmmgpu.backends import default_threads, get_backend
from mmmgpu.errors import InputError
from mmmgpu.labelled_clips import LabelledClip, read_labelled_clip
from mmmgpu.parallel import Cancelled, map_ordered, one_thread_each
from mmmgpu.videos import read_frames

__all__ = [
    "Aam",
    "Fitter",
    "Match",
    "Seen",
    "Start",
    "Tracked",
    "complete_clip",
    "features",
    "fit_aam",
    "labelled_clip",
    "load_aam",
    "match",
    "prepare_fitting",
    "reconstruct",
    "save_aam",
    "see_clip",
    "start_in_box",
    "track_clip",
]

Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]


def features(aam: Aam, clip: Path, landmarks: Path, *, backend: str = "warp") -> Floats:
    """The features c (T, n) of every frame of `clip`, by its landmarks.

    Pose and light are not in them; see `see_clip`.

    Args:
        aam: The model.
        clip: A video file.
        landmarks: Folder with its landmarks in every frame.
        backend: A name for `mmmgpu.backends.get_backend`.

    Raises:
        InputError: The clip or its landmarks cannot be used.
    """
    return see_clip(aam, clip, landmarks, backend=backend).features


def see_clip(aam: Aam, clip: Path, landmarks: Path, *, backend: str = "warp") -> Seen:
    """Features, pose and light of every frame of `clip`; arguments as for `features`."""
    labelled = complete_clip(aam, clip, landmarks)
    with one_thread_each():
        kernels = get_backend(backend, 1)
        frames = read_frames(labelled.path)
        return see(aam, frames, labelled.points, kernels, where=str(labelled.path))


def reconstruct(
    aam: Aam, features: Floats, clip: Path, landmarks: Path, *, backend: str = "warp"
) -> Iterator[Picture]:
    """The frames of `clip` with faces made from `features` (T, n) in place of their own.

    Each face stands under the pose and in the light of the frame's own, which its landmarks and
    colours say. With the clip's own features it is what the model can show of the clip.

    Raises:
        InputError: The clip or its landmarks cannot be used, or `features` are not those of so
            many frames.
    """
    labelled = complete_clip(aam, clip, landmarks)
    c = np.asarray(features, np.float64)
    wanted = (labelled.info.frames, len(aam.variance))
    if c.shape != wanted or not np.isfinite(c).all():
        raise InputError(
            f"features for {labelled.path} must be finite, of shape {wanted}, got {c.shape}"
        )
    kernels = get_backend(backend, 1)

    def one(item: tuple[int, Picture], _: Cancelled) -> Picture:
        t, frame = item
        where = f"{labelled.path}, frame {t}"
        return render_face(aam, frame, labelled.points[t], c[t], kernels, where=where)

    yield from map_ordered(one, enumerate(read_frames(labelled.path)), threads=default_threads())


def complete_clip(aam: Aam, clip: Path, landmarks: Path) -> LabelledClip:
    """`clip` with the landmarks that the model uses, in every frame.

    Raises:
        InputError: Some frames have none, or `labelled_clip` refuses it.
    """
    labelled = labelled_clip(aam, clip, landmarks)
    if not labelled.is_complete:
        raise InputError(
            f"{labelled.path}: only {len(labelled.frames)} of {labelled.info.frames} frames have "
            "landmarks; label the others too"
        )
    return labelled


def labelled_clip(aam: Aam, clip: Path, landmarks: Path) -> LabelledClip:
    """`clip` with the landmarks that the model uses, in some frames at least.

    Raises:
        InputError: There are more or fewer in a frame than the model has points.
    """
    labelled = read_labelled_clip(Path(clip), Path(landmarks), aam.rows)
    number = len(aam.mesh.vertices)
    if labelled.points.shape[1] != number:
        raise InputError(
            f"{labelled.path}: has {labelled.points.shape[1]} landmarks a frame, the model was "
            f"made of {number}; give the same ones"
        )
    return labelled
