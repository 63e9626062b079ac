"""Speaking: from phones with times to a video of the model's person saying them.

phones -> trajectories (Eq. 3) -> frame rate of the background -> images (Eq. 1-2) -> composite

Trajectories may also come from the models of `mmmgpu.dynamics`.
"""

import itertools
import math
import os
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mmmgpu.alignments import Alignment, frame_labels
from mmmgpu.backends import default_threads
from mmmgpu.backgrounds import Background, extended, open_background
from mmmgpu.compositing import composite_matched, looked_at
from mmmgpu.errors import InputError
from mmmgpu.models import REGULARISED, Model, moved_by, project_on_simplex
from mmmgpu.parallel import Cancelled, map_ordered, one_thread_each
from mmmgpu.phones import SIL
from mmmgpu.progress import progress
from mmmgpu.synthesis import mouths, prepare_synthesis
from mmmgpu.trajectory_files import Trajectory
from mmmgpu.video_writing import write_video
from mmmgpu.voices import Speech

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]

ARTICULATION = (0.5, 1.5)  # least and most
FOCUS = 2.5  # power of beta: it is as concentrated then as that of real frames at rest
FAINT = 0.03  # taken off, as a share of the strongest: faint textures cost time


def speak(
    model: Model,
    speech: Speech,
    out: str | os.PathLike[str],
    *,
    background: str | os.PathLike[str] | None = None,
    movement: str = REGULARISED,
    articulation: float = 1.0,
    lossless: bool = False,
    backend: str = "warp",
) -> Trajectory:
    """Write a video of the model's person saying `speech`, and return what the mouth did.

    Args:
        model: A trained model.
        speech: Sound and alignment: from `voices.say`, or a recording with its own.
        out: ``.mp4``, ``.mov`` or ``.mkv``.
        background: A clip of the person; None uses the one stored in the model.
        movement: How phones become trajectories; see `models.moved_by`.
        articulation: Scales the movement about the silent mouth, 0.5 to 1.5.
        lossless: Exact RGB.
        backend: A name for `mmmgpu.backends.get_backend`.

    Raises:
        InputError: The background cannot be read or registered, or `out` not be written; the model
            has no such movement.
    """
    trajectory = plan(model, speech.alignment, movement=movement, articulation=articulation)
    sound = (speech.samples, speech.rate)
    render(
        model,
        trajectory,
        out,
        sound=sound,
        background=background,
        lossless=lossless,
        backend=backend,
    )
    return trajectory


def plan(
    model: Model,
    alignment: Alignment,
    *,
    movement: str = REGULARISED,
    articulation: float = 1.0,
) -> Trajectory:
    """The trajectory of `alignment` at the model's frame rate, beta on the simplex.

    movement: Eq. 3, or another of the model's; see `models.moved_by`.

    Raises:
        InputError: `articulation` is outside 0.5 to 1.5; the model has no such movement.
    """
    check_articulation(articulation)
    frames = max(1, math.ceil(alignment.duration * float(model.fps) - 1e-6))
    labels = frame_labels(alignment, frames, float(model.fps))
    alpha, beta = (
        scale_about(y, neutral, articulation)
        for y, neutral in zip(moved_by(model, labels, movement), silent_mouth(model), strict=True)
    )
    return Trajectory(tuple(labels), alpha, focused(project_on_simplex(beta)), model.fps)


def check_articulation(factor: float) -> None:
    """Raise InputError where `factor` is outside 0.5 to 1.5."""
    if not ARTICULATION[0] <= factor <= ARTICULATION[1]:
        raise InputError(f"articulation must be between 0.5 and 1.5, got {factor}")


def focused(beta: Floats) -> Floats:
    """`beta` (T, M) with more of the strongest textures; continuous, so that nothing flickers.

    The mean texture of a phone mixes more prototypes than any frame shows, and the teeth of many
    overlap to a grey haze.
    """
    share = beta / beta.max(axis=1, keepdims=True)
    kept = np.maximum(share**FOCUS - FAINT, 0)
    return np.asarray(kept / kept.sum(axis=1, keepdims=True))


def silent_mouth(model: Model) -> tuple[Floats, Floats]:
    """(alpha (M - 1,), beta (M,)) of silence; the reference, where no silence was seen."""
    if SIL in model.alpha.trained.labels:
        row = model.alpha.trained.labels.index(SIL)
        return model.alpha.trained.mean[row], model.beta.trained.mean[row]
    beta = np.zeros(len(model.basis.images))
    beta[model.basis.reference] = 1
    return np.zeros(len(beta) - 1), beta


def scale_about(y: Floats, centre: Floats, factor: float) -> Floats:
    """``centre + factor (y - centre)``; exactly `y` for a factor of 1."""
    return y if factor == 1 else centre + factor * (y - centre)


def at_rate(trajectory: Trajectory, fps: Fraction) -> Trajectory:
    """`trajectory` at another frame rate: linear between the middles of its frames."""
    if fps == trajectory.fps:
        return trajectory
    length = max(1, math.ceil(len(trajectory) / trajectory.fps * fps - Fraction(1, 10**6)))
    middle = (np.arange(length) + 0.5) * float(trajectory.fps / fps) - 0.5
    here = np.arange(len(trajectory))
    alpha, beta = (
        np.stack([np.interp(middle, here, column) for column in z.T], axis=1)
        for z in (trajectory.alpha, trajectory.beta)
    )
    nearest = np.clip(np.rint(middle), 0, len(trajectory) - 1).astype(int)
    labels = tuple(trajectory.labels[i] for i in nearest)
    return Trajectory(labels, alpha, beta, fps)


def render(
    model: Model,
    trajectory: Trajectory,
    out: str | os.PathLike[str],
    *,
    sound: tuple[NDArray[np.float32], int] | None = None,
    background: str | os.PathLike[str] | None = None,
    lossless: bool = False,
    backend: str = "warp",
) -> None:
    """Write the video of a trajectory; see `speak` for the arguments.

    sound: (samples (n,) or (n, channels), rate [Hz]), starting with the first frame.
    """
    place = None if background is None else Path(background)
    with one_thread_each(), open_background(model, place) as behind:
        frames = spoken_frames(model, at_rate(trajectory, behind.fps), behind, backend=backend)
        write_video(out, frames, fps=behind.fps, sound=sound, lossless=lossless)


def spoken_frames(
    model: Model, trajectory: Trajectory, background: Background, *, backend: str = "warp"
) -> Iterator[NDArray[np.uint8]]:
    """Yield the frames of a trajectory on a background of the same frame rate."""
    basis, track = model.basis, background.track
    synthesizer = prepare_synthesis(basis, shown=looked_at(basis.cover), backend=backend)

    def one(item: tuple[int, F32, tuple[Picture, int]], _: Cancelled) -> Picture:
        i, image, (frame, t) = item
        rng = np.random.default_rng([i, len(trajectory)])
        pose = track.poses[t]
        return composite_matched(frame, image, basis.cover, pose, track, basis.region, rng)

    images = mouths(synthesizer, trajectory.alpha, trajectory.beta)
    behind = extended(background, len(trajectory))
    items = zip(itertools.count(), images, behind, strict=False)
    frames = map_ordered(one, items, threads=default_threads())
    yield from progress(frames, "render", total=len(trajectory))
