"""What all jobs do with every clip of a corpus: track it, cut it, analyse it.

What is found for a clip, or for a stretch of one, is kept in a folder of finished steps
(`mmmgpu.checkpoints`); worker processes do the clips.
"""

import shutil
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mmmgpu.analysis import analyze, byte_thumbnail, prepare_analysis
from mmmgpu.backends import default_threads, get_backend
from mmmgpu.basis import Basis
from mmmgpu.checkpoints import (
    fingerprint,
    finished_steps_only,
    open_checkpoints,
    read_step,
    write_step,
)
from mmmgpu.corpora import Clip
from mmmgpu.dynamics import FIVE, MODELS, Dynamics
from mmmgpu.errors import InputError
from mmmgpu.frames import Frames, Stretch
from mmmgpu.models import REGULARISED, Calm, Model
from mmmgpu.parallel import one_thread_each
from mmmgpu.phonemes import Utterance
from mmmgpu.processes import Tick, Work, kept_processes, map_out, share_out
from mmmgpu.progress import progress_bar
from mmmgpu.regions import Region, mouth_mask
from mmmgpu.tracks import Reference, Track, track_clip

F32 = NDArray[np.float32]
T = TypeVar("T")
R = TypeVar("R")


def make_model(
    out: Path, corpus: Sequence[Clip], given: Mapping[str, Any], job: Callable[[Path], Model]
) -> Model:
    """Do `job`, which is given the folder for its finished steps, and save its model to `out`.

    The folder lies beside `out` until then. given: options and whatever else the steps depend on,
    as JSON values.
    """
    said = [[list(phone) for phone in clip.alignment.phones] for clip in corpus]
    mark = fingerprint([clip.path for clip in corpus], {**given, "said": said})
    folder = open_checkpoints(out.with_name(out.name + ".work"), mark)
    with one_thread_each(), kept_processes():
        model = job(folder)
    model.save(out)
    shutil.rmtree(folder)
    return model


class Piece(Protocol):
    """What a process does at a time, a clip or a stretch of one; no two have one name."""

    @property
    def name(self) -> str: ...

    @property
    def length(self) -> int: ...


class Seen(Piece, Protocol):
    """A piece that can be seen, picture by picture."""

    def crops(self, region: Region) -> Iterable[F32]: ...


def for_all(
    folder: Path,
    prepare: Callable[[Any], Work],
    shared: Any,
    step: str,
    label: str,
    pieces: Sequence[Piece],
) -> None:
    """Do what ``prepare(shared)`` returns to every piece whose step is not yet in `folder`.

    `label` names the progress bar.
    """
    left = [piece for piece in pieces if read_step(folder, f"{step}-{piece.name}") is None]
    total = sum(piece.length for piece in pieces)
    with progress_bar(total, label) as advance:
        advance(total - sum(piece.length for piece in left))
        with finished_steps_only(folder):
            share_out(prepare, shared, left, processes=default_threads(), advance=advance)


def finished_step(folder: Path, step: str, piece: Piece) -> dict[str, NDArray[Any]]:
    """A step that has been done for `piece`."""
    arrays = read_step(folder, f"{step}-{piece.name}")
    assert arrays is not None, (step, piece.name)
    return arrays


def track_corpus(
    folder: Path,
    corpus: Sequence[Clip],
    reference: Reference,
    known: Mapping[str, Track] | None = None,
) -> tuple[Frames, dict[str, str]]:
    """The clips whose head is found, as `reference` sees them; and why others were skipped.

    known: tracks by clip name, of clips that need no tracking.

    Raises:
        InputError: The head is found in no clip.
    """
    tracks, skipped = dict(known or {}), {}
    unknown = [clip for clip in corpus if clip.name not in tracks]
    for_all(folder, _tracking, (folder, reference), "track", "track frames", unknown)
    for clip in unknown:
        name = clip.name
        arrays = finished_step(folder, "track", clip)
        if "skipped" in arrays:
            skipped[name] = str(arrays["skipped"])
            print(f"warning: skipped: {skipped[name]}", file=sys.stderr)
        else:
            residual = float(arrays.pop("residual"))
            tracks[name] = Track(**arrays, residual=residual)
    if not tracks:
        raise InputError(next(iter(skipped.values())))
    return Frames([clip for clip in corpus if clip.name in tracks], tracks), skipped


def _tracking(shared: tuple[Path, Reference]) -> Work:
    """Keeps the track of a clip, or why it must be left out."""
    folder, reference = shared

    def work(clip: Clip, tick: Tick) -> None:
        try:
            track = track_clip(clip.path, reference, tick=tick)
        except InputError as e:
            write_step(folder, f"track-{clip.name}", {"skipped": np.array(str(e))})
            return
        arrays = vars(track) | {"residual": np.array(track.residual)}
        write_step(folder, f"track-{clip.name}", arrays)

    return work


def look(folder: Path, frames: Frames, region: Region) -> "Thumbnails":
    """Small pictures of the mouth in every frame, left in `folder`; `region` is its region."""
    shared = (folder, region)
    for_all(folder, _looking, shared, "thumbnails", "look at frames", frames.stretches)
    return Thumbnails(folder, frames)


def _looking(shared: tuple[Path, Region]) -> Work:
    """Keeps a thumbnail of every frame of a stretch."""
    folder, region = shared
    mask = mouth_mask(region)

    def work(stretch: Stretch, tick: Tick) -> None:
        found = []
        for image in stretch.crops(region):
            found.append(byte_thumbnail(image, mask))
            tick()
        write_step(folder, f"thumbnails-{stretch.name}", {"thumbnails": np.array(found)})

    return work


def analyse_corpus(
    folder: Path, frames: Frames, basis: Basis, *, flow: str, backend: str
) -> tuple[list[F32], list[F32]]:
    """alpha (T, M - 1) and beta (T, M) of every clip of `frames`."""
    alpha, beta = analyse(folder, frames.stretches, basis, flow=flow, backend=backend)
    return frames.by_clip(alpha), frames.by_clip(beta)


def analyse(
    folder: Path, pieces: Sequence[Seen], basis: Basis, *, flow: str, backend: str
) -> tuple[F32, F32]:
    """alpha (N, M - 1) and beta (N, M) of the frames of all pieces, N in all."""
    shared = (folder, basis, flow, backend)
    for_all(folder, _analysing, shared, "analysis", "analyse frames", pieces)
    done = [finished_step(folder, "analysis", piece) for piece in pieces]
    alpha, beta = (np.concatenate([found[z] for found in done]) for z in ("alpha", "beta"))
    return alpha, beta


def _analysing(shared: tuple[Path, Basis, str, str]) -> Work:
    """Keeps alpha and beta of every frame of a piece."""
    folder, basis, flow, backend = shared
    analyzer = prepare_analysis(basis, get_backend(backend, 1), flow=flow)

    def work(piece: Seen, tick: Tick) -> None:
        alpha, beta = [], []
        for image in piece.crops(basis.region):
            a, b = analyze(analyzer, image)
            alpha.append(a)
            beta.append(b)
            tick()
        arrays = {"alpha": np.array(alpha, np.float32), "beta": np.array(beta, np.float32)}
        write_step(folder, f"analysis-{piece.name}", arrays)

    return work


@dataclass(frozen=True)
class Thumbnails(Sequence[NDArray[np.uint8]]):
    """The thumbnails of all clips, read from the work folder one clip at a time."""

    folder: Path
    frames: Frames

    def __len__(self) -> int:
        return len(self.frames.clips)

    def __getitem__(self, i: Any) -> Any:
        stretches = self.frames.stretches_of(self.frames.clips[i])
        found = [finished_step(self.folder, "thumbnails", stretch) for stretch in stretches]
        return np.concatenate([one["thumbnails"] for one in found])


def tracking_notes(frames: Frames, skipped: Mapping[str, str]) -> dict[str, Any]:
    """What tracking found, for reports: JSON values."""
    tracks = frames.tracks.values()
    return {
        "clips": [clip.name for clip in frames.clips],
        "skipped": dict(skipped),
        "frames": int(frames.registered.size),
        "unregistered_frames": int((~frames.registered).sum()),
        "registration_residual_px": float(np.mean([t.residual for t in tracks])),
    }


def utterances_of(frames: Frames, coordinates: Sequence[F32]) -> list[Utterance]:
    """One stream of every clip, (T, d) each, without the frames whose head was not found."""
    utterances = []
    for clip, z in zip(frames.clips, coordinates, strict=True):
        good = np.flatnonzero(frames.tracks[clip.name].registered)
        labels = clip.labels
        utterances.append(Utterance(z[good].astype(np.float64), [labels[t] for t in good]))
    return utterances


def fit_streams(
    fit: Callable[[T, Tick], tuple[R, dict[str, Dynamics]]], streams: Sequence[T], label: str
) -> tuple[list[R], dict[str, tuple[Dynamics, Dynamics]]]:
    """What `fit` finds for both streams, alpha and beta, each in a process of its own.

    `fit` is as `map_out` takes it; `label` names the progress bar.
    """
    with progress_bar(None, label) as advance:
        found = map_out(fit, streams, processes=default_threads(), advance=advance)
    (first, alpha), (second, beta) = found
    return [first, second], {name: (alpha[name], beta[name]) for name in alpha}


def fit_dynamics(utterances: Sequence[Utterance], tick: Tick) -> dict[str, Dynamics]:
    """The `FIVE` models of movement of one stream but `REGULARISED`, which is fitted apart."""
    some = [u for u in utterances if len(u.z)]

    def fit(name: str) -> Dynamics:
        model = MODELS[name].fit([u.z for u in some], [u.labels for u in some])
        tick()
        return model

    return {name: fit(name) for name in FIVE if name != REGULARISED}


def calmest(frames: Frames) -> Calm:
    """The clip in which the head moves least, as a background."""

    def unrest(clip: Clip) -> float:
        poses = frames.tracks[clip.name].poses
        return float(np.abs(poses[:, :2, 2] - poses[:, :2, 2].mean(axis=0)).mean())

    clip = min(frames.clips, key=unrest)
    data = np.fromfile(clip.path, np.uint8)
    return Calm(data, clip.path.suffix, frames.tracks[clip.name])
