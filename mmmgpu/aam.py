"""Active appearance models (ECR07, section 2): features of a face in video, and video from features.

    model = fit_aam(clips, landmarks)
    c = features(model, clip, landmarks)          # (T, 32)
    for frame in reconstruct(model, c, clip, landmarks):
        ...

This module is the door; the work is in `mmmgpu.aam_training`, `mmmgpu.appearances`,
`mmmgpu.aam_fitting` and `mmmgpu.aam_rendering`.
"""

from pathlib import Path

from mmmgpu.aam_training import fit_aam
from mmmgpu.appearances import Aam, Floats, Seen, see
from mmmgpu.backends import get_backend
from mmmgpu.errors import InputError
from mmmgpu.labelled_clips import LabelledClip, read_labelled_clip
from mmmgpu.parallel import one_thread_each
from mmmgpu.videos import read_frames

__all__ = ["Aam", "Seen", "features", "fit_aam", "see_clip"]


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


def complete_clip(aam: Aam, clip: Path, landmarks: Path) -> LabelledClip:
    """`clip` with the landmarks that the model uses, in every frame."""
    labelled = read_labelled_clip(Path(clip), Path(landmarks), aam.rows)
    if not labelled.is_complete:
        raise InputError(
            f"{labelled.path}: only {len(labelled.frames)} of {labelled.info.frames} frames have "
            "landmarks; fit the model to the others, or label them"
        )
    number = len(aam.mesh.vertices)
    if labelled.points.shape[1] != number:
        raise InputError(
            f"{labelled.path}: has {labelled.points.shape[1]} landmarks a frame, the model was "
            f"made of {number}; give the same ones"
        )
    return labelled
