"""Reconstruction: a real clip analysed and synthesised back, the same in size and length."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mmmgpu.analysis import analyze, prepare_analysis
from mmmgpu.backends import default_threads, get_backend
from mmmgpu.compositing import composite, looked_at
from mmmgpu.models import Model
from mmmgpu.parallel import Cancelled, map_ordered, one_thread_each
from mmmgpu.progress import progress
from mmmgpu.sounds import check_sync, read_sound
from mmmgpu.synthesis import mouths, prepare_synthesis
from mmmgpu.tracks import Track, crop, track_clip
from mmmgpu.video_writing import write_video
from mmmgpu.videos import probe, read_frames

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Analysed:
    """A clip in model coordinates: alpha (T, M - 1), beta (T, M), and its track."""

    track: Track
    alpha: Floats
    beta: Floats


def analyse_clip(model: Model, clip: Path, *, backend: str = "warp") -> Analysed:
    """Model coordinates of every frame of `clip`.

    Raises:
        InputError: The clip cannot be read, or the model's head is not found in it.
    """
    track = track_clip(clip, model.reference)
    analyzer = prepare_analysis(model.basis, get_backend(backend, 1))
    region = model.basis.region

    def one(item: tuple[NDArray[np.uint8], Floats], _: Cancelled) -> tuple[Floats, Floats]:
        return analyze(analyzer, crop(item[0], item[1], track, region))

    items = zip(read_frames(clip), track.poses, strict=False)
    found = map_ordered(one, items, threads=default_threads())
    done = list(progress(found, f"analyse {clip.name}", total=len(track)))
    return Analysed(track, np.array([a for a, _ in done]), np.array([b for _, b in done]))


def reconstruct(
    model: Model,
    clip: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    lossless: bool = False,
    backend: str = "warp",
) -> Analysed:
    """Analyse `clip` and write its reconstruction to `out`, with the sound of the clip.

    Nothing is matched or added: what the model predicts is seen in the clip's own exposure; outside
    the cover the pixels are those of the clip.

    Args:
        model: The person in the clip.
        clip: A video file.
        out: ``.mp4``, ``.mov`` or ``.mkv``.
        lossless: Exact RGB.
        backend: A name for `mmmgpu.backends.get_backend`.

    Raises:
        InputError: The clip cannot be read or registered, its sound is of another length, or `out`
            cannot be written.
    """
    clip = Path(clip)
    info = probe(clip, minimum_frames=2)
    with one_thread_each():
        sound = read_sound(clip, mono=False) if info.has_sound else None
        if sound is not None:
            check_sync(info, sound)
        analysed = analyse_clip(model, clip, backend=backend)
        frames = reconstructed_frames(model, clip, analysed, backend=backend)
        write_video(out, frames, fps=info.fps, sound=sound, lossless=lossless)
    return analysed


def reconstructed_frames(
    model: Model, clip: Path, analysed: Analysed, *, backend: str = "warp"
) -> Iterator[NDArray[np.uint8]]:
    """The frames of `clip` with the mouth that the model makes of its coordinates."""
    basis, track = model.basis, analysed.track
    synthesizer = prepare_synthesis(basis, shown=looked_at(basis.cover), backend=backend)

    def one(item: tuple[Picture, Floats, F32], _: Cancelled) -> Picture:
        frame, pose, image = item
        return composite(frame, image, basis.cover, pose, track, basis.region)

    images = mouths(synthesizer, analysed.alpha, analysed.beta)
    rows = zip(read_frames(clip), track.poses, images, strict=False)
    yield from map_ordered(one, rows, threads=default_threads())
