"""What all jobs do with every clip of a corpus: track it, cut it, analyse it.

What is found for a clip, or for a stretch of one, is kept in a folder of finished steps
(`mmmgpu.checkpoints`); worker processes do the clips.
"""

import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
from mmmgpu.models import REGULARISED, Calm, Model
from mmmgpu.parallel import one_thread_each
from mmmgpu.phonemes import Utterance
from mmmgpu.processes import Tick, Work, map_out, share_out
from mmmgpu.progress import progress_bar
from mmmgpu.regions import Region, mouth_mask
from mmmgpu.tracks import Reference, Track, crop, crops, rebase, track_clip
from mmmgpu.videos import read_chosen_frames

Floats = NDArray[np.float64]
F32 = NDArray[np.float32]
T = TypeVar("T")
R = TypeVar("R")

STRETCHES = 8  # at least, of a corpus: to decode up to one costs little beside analysing it


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
    with one_thread_each():
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
) -> tuple["Frames", dict[str, str]]:
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


def look(folder: Path, frames: "Frames", region: Region) -> "Thumbnails":
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
    folder: Path, frames: "Frames", basis: Basis, *, flow: str, backend: str
) -> tuple[list[Floats], list[Floats]]:
    """alpha (T, M - 1) and beta (T, M) of every clip of `frames`."""
    found = analyse(folder, frames.stretches, basis, flow=flow, backend=backend)
    alpha, beta = (frames.by_clip(np.concatenate(z)) for z in zip(*found, strict=True))
    return alpha, beta


def analyse(
    folder: Path, pieces: Sequence[Seen], basis: Basis, *, flow: str, backend: str
) -> list[tuple[Floats, Floats]]:
    """alpha (T, M - 1) and beta (T, M) of the T frames of every piece."""
    shared = (folder, basis, flow, backend)
    for_all(folder, _analysing, shared, "analysis", "analyse frames", pieces)
    done = [finished_step(folder, "analysis", piece) for piece in pieces]
    return [(found["alpha"], found["beta"]) for found in done]


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
class Stretch:
    """The frames start <= t < stop of a tracked clip."""

    clip: Clip
    track: Track
    start: int
    stop: int

    @property
    def name(self) -> str:
        return f"{self.clip.name}-{self.start}"

    @property
    def length(self) -> int:
        return self.stop - self.start

    @property
    def registered(self) -> NDArray[np.bool_]:
        return self.track.registered[self.start : self.stop]

    def crops(self, region: Region) -> Iterator[F32]:
        """The region of each frame, (h, w, 3)."""
        return crops(self.clip.path, self.track, region, start=self.start, stop=self.stop)


@dataclass(frozen=True)
class Pictures:
    """Some pictures (n, h, w, 3) of a region, to be seen as if they were frames."""

    name: str
    images: F32

    @property
    def length(self) -> int:
        return len(self.images)

    def crops(self, region: Region) -> Iterator[F32]:
        """The pictures, which are of `region`."""
        assert self.images.shape[1:3] == region.shape
        return iter(self.images)


@dataclass(frozen=True)
class Thumbnails(Sequence[NDArray[np.uint8]]):
    """The thumbnails of all clips, read from the work folder one clip at a time."""

    folder: Path
    frames: "Frames"

    def __len__(self) -> int:
        return len(self.frames.clips)

    def __getitem__(self, i: Any) -> Any:
        stretches = self.frames.stretches_of(self.frames.clips[i])
        found = [finished_step(self.folder, "thumbnails", stretch) for stretch in stretches]
        return np.concatenate([one["thumbnails"] for one in found])


@dataclass(frozen=True)
class Frames:
    """The frames of all used clips as one numbered row."""

    clips: Sequence[Clip]
    tracks: Mapping[str, Track]

    def __len__(self) -> int:
        return sum(clip.length for clip in self.clips)

    @property
    def registered(self) -> NDArray[np.bool_]:
        return np.concatenate([self.tracks[c.name].registered for c in self.clips])

    def find(self, i: int) -> tuple[Clip, int]:
        """The clip and its frame that are number `i` of the row."""
        for clip in self.clips:
            if i < clip.length:
                return clip, i
            i -= clip.length
        raise IndexError(i)

    @property
    def stretches(self) -> list[Stretch]:
        """All frames in order."""
        return [stretch for clip in self.clips for stretch in self.stretches_of(clip)]

    def stretches_of(self, clip: Clip) -> list[Stretch]:
        """The frames of `clip`; few clips are cut, so that all processes end at the same time."""
        parts = min(clip.length, -(-STRETCHES // len(self.clips)))
        ends = [clip.length * part // parts for part in range(parts + 1)]
        track = self.tracks[clip.name]
        return [Stretch(clip, track, *ends[part : part + 2]) for part in range(parts)]

    def by_clip(self, rows: Floats) -> list[Floats]:
        """Rows of all frames, and others behind them, (N, d) -> (T, d) of every clip."""
        return np.split(rows, np.cumsum([clip.length for clip in self.clips]))[:-1]

    def pictures(
        self, numbers: Iterable[int]
    ) -> tuple[NDArray[np.uint8], tuple[tuple[str, int], ...]]:
        """Some frames in full, (n, H, W, 3), and the clip name and frame number of each."""
        wanted = [int(i) for i in numbers]
        found = {i: (frame, (clip.name, t)) for i, clip, t, frame in self._read(wanted)}
        whole, places = zip(*(found[i] for i in wanted), strict=True)
        return np.stack(whole), places

    def number(self, name: str, t: int) -> int:
        """The number in the row of frame `t` of the clip called `name`."""
        before = 0
        for clip in self.clips:
            if clip.name == name:
                return before + t
            before += clip.length
        raise KeyError(name)

    def crops(self, numbers: Iterable[int], region: Region) -> dict[int, F32]:
        """The regions of some frames, by number, rising."""
        return {
            i: crop(frame, self.tracks[clip.name].poses[t], self.tracks[clip.name], region)
            for i, clip, t, frame in self._read(numbers)
        }

    def _read(self, numbers: Iterable[int]) -> Iterator[tuple[int, Clip, int, NDArray[np.uint8]]]:
        """Some frames in full, rising, with number, clip and place in it; a clip is read once."""
        wanted = np.unique(np.fromiter(numbers, np.int64))
        first = 0
        for clip in self.clips:
            own = wanted[(first <= wanted) & (wanted < first + clip.length)] - first
            if len(own):
                for t, frame in zip(own.tolist(), read_chosen_frames(clip.path, own), strict=True):
                    yield first + t, clip, t, frame
            first += clip.length


def rebased_frames(frames: Frames, name: str, t: int) -> Frames:
    """`frames` as frame `t` of the clip called `name` sees them: its pose is the identity.

    Its gain becomes 1 and its offset 0.

    Raises:
        InputError: That clip was not tracked.
    """
    tracks = frames.tracks
    if name not in tracks:
        raise InputError(f"{name}: holds the reference frame, but its head was not found there")
    first = tracks[name]
    pose = first.poses[t]
    rebased = {n: rebase(track, pose, first.gain, first.offset) for n, track in tracks.items()}
    return Frames(frames.clips, rebased)


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


def utterances_of(frames: Frames, coordinates: Sequence[Floats]) -> list[Utterance]:
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
