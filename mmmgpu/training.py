"""Training: from clips and their alignments to a model, streaming and resumable (docs/model.md).

The steps: find the mouth, track every clip, choose prototypes, compute their flows, analyse every
frame, train the phoneme models. What each step finds for a clip is kept in a folder beside the
result until the job is done; in memory stay the PCA and model coordinates of the frames.
"""

import os
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmmgpu.analysis import analyze, prepare_analysis, thumbnail
from mmmgpu.backends import default_threads, get_backend
from mmmgpu.basis import Basis, make_basis
from mmmgpu.checkpoints import (
    fingerprint,
    finished_steps_only,
    open_checkpoints,
    read_step,
    write_step,
)
from mmmgpu.corpora import Clip, open_corpus
from mmmgpu.errors import InputError
from mmmgpu.flows import best_flow, extend_flows, matcher, path_to, shortest_paths
from mmmgpu.models import Calm, Model
from mmmgpu.parallel import one_thread_each
from mmmgpu.phonemes import Utterance
from mmmgpu.phones import SIL
from mmmgpu.processes import Tick, Work, share_out
from mmmgpu.progress import progress, progress_bar
from mmmgpu.prototypes import choose_prototypes, most_neutral, principal_coordinates
from mmmgpu.references import check_sound, find_reference, rebase_reference
from mmmgpu.regions import Region, mouth_mask
from mmmgpu.tracks import Reference, Track, crop, crops, frame_at, rebase, track_clip
from mmmgpu.trajectory_training import TrainedStream, fit_stream
from mmmgpu.videos import read_frames

Floats = NDArray[np.float64]
F32 = NDArray[np.float32]


@dataclass(frozen=True)
class Options:
    """What a person may choose about training.

    prototypes: M.
    region: (x, y, width, height) [px] of the mouth region in the first frame of the middle clip;
        None finds it.
    sync: [s] by which sound and alignments are moved against the picture; negative: earlier.
    flow: one of `flows.MATCHERS`.
    seed: of k-means and of the folds.
    """

    prototypes: int = 46
    region: tuple[int, int, int, int] | None = None
    sync: float = 0.0
    flow: str = "dis"
    seed: int = 0


DEFAULTS = Options()


def train(
    clips: Sequence[str | os.PathLike[str]],
    alignments: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    options: Options = DEFAULTS,
    backend: str = "warp",
) -> Model:
    """Learn a person from `clips` and write the model to `out`.

    Args:
        clips: Video files of one person.
        alignments: Folder of TextGrid, .align or .lab files named like the clips, or one file.
        out: The model file; beside it ``out.work`` keeps finished steps until the job is done, and
            the same call continues after them.
        options: See `Options`.
        backend: A name for `mmmgpu.backends.get_backend`.

    Raises:
        InputError: A clip or alignment cannot be used; the head is found in no clip.
    """
    out = Path(out)
    corpus = open_corpus([Path(c) for c in clips], Path(alignments), sync=options.sync)
    _check_rates(corpus)
    if options.region is None:
        check_sound(corpus)
    folder = _work_folder(out, corpus, options)
    with one_thread_each():
        model = _Training(corpus, options, backend, folder).run()
    model.save(out)
    shutil.rmtree(folder)
    return model


def _check_rates(corpus: Sequence[Clip]) -> None:
    rate = corpus[0].info.fps
    for clip in corpus:
        if abs(clip.info.fps / rate - 1) > 0.001:
            raise InputError(
                f"{clip.path}: has {float(clip.info.fps):g} frames/s but {corpus[0].path.name} "
                f"{float(rate):g}; convert the clips to one rate"
            )


def _work_folder(out: Path, corpus: Sequence[Clip], options: Options) -> Path:
    said = [[list(phone) for phone in clip.alignment.phones] for clip in corpus]
    given = {"options": vars(options), "said": said, "steps": 1}
    mark = fingerprint([clip.path for clip in corpus], given)
    return open_checkpoints(out.with_name(out.name + ".work"), mark)


@dataclass(frozen=True)
class _Training:
    """One run over a corpus; every method is a step of the module docstring."""

    corpus: list[Clip]
    options: Options
    backend: str
    folder: Path

    def run(self) -> Model:
        provisional = find_reference(self.corpus, self.options.region, sync=self.options.sync)
        tracks, skipped = self._track(provisional)
        used = [clip for clip in self.corpus if clip.path.name in tracks]
        frames = _Frames(used, tracks)
        chosen, reference_frame, coordinates = self._choose(frames)
        clip, t = frames.find(reference_frame)
        size = (clip.info.width, clip.info.height)
        first = tracks[clip.path.name]
        kept = self.options.region is not None
        reference = rebase_reference(provisional, first, t, size, keep_box=kept)
        rebased = {
            name: rebase(track, first.poses[t], first.gain, first.offset)
            for name, track in tracks.items()
        }
        frames = _Frames(used, rebased)
        basis = self._basis(frames, reference, chosen, reference_frame, coordinates)
        alphas, betas = self._analyse(frames, basis)
        alpha = self._phonemes(frames, "alpha", alphas)
        beta = self._phonemes(frames, "beta", betas)
        places = [frames.find(int(i)) for i in chosen]
        calm = _calmest(used, rebased, reference)
        return Model(
            basis=basis,
            reference=reference,
            alpha=alpha,
            beta=beta,
            fps=used[0].info.fps,
            prototype_frames=np.stack([frame_at(c.path, f) for c, f in places]),
            sources=tuple((c.path.name, f) for c, f in places),
            calm=Calm(np.fromfile(calm.path, np.uint8), calm.path.suffix, rebased[calm.path.name]),
            notes=_notes(frames, skipped, self.options),
        )

    def _track(self, reference: Reference) -> tuple[dict[str, Track], dict[str, str]]:
        """Tracks by clip name, and why other clips were skipped; thumbnails are left on disk."""
        shared = (self.folder, reference, mouth_mask(reference.region))
        self._for_all(_tracking, shared, "track", "track frames", self.corpus)
        tracks, skipped = {}, {}
        for clip in self.corpus:
            name = clip.path.name
            arrays = _step(self.folder, "track", name)
            if "skipped" in arrays:
                skipped[name] = str(arrays["skipped"])
                print(f"warning: skipped: {skipped[name]}", file=sys.stderr)
            else:
                fields = {f: arrays[f] for f in arrays if f not in ("thumbnails", "residual")}
                tracks[name] = Track(**fields, residual=float(arrays["residual"]))
        if not tracks:
            raise InputError(next(iter(skipped.values())))
        return tracks, skipped

    def _for_all(
        self,
        prepare: Callable[[Any], Work],
        shared: Any,
        step: str,
        label: str,
        items: Sequence[Any],
    ) -> None:
        """Do what `prepare` returns to every item whose step is not yet on disk.

        An item is a clip, or a tuple that begins with one.
        """
        clips = [item[0] if isinstance(item, tuple) else item for item in items]
        done = [read_step(self.folder, f"{step}-{clip.path.name}") is not None for clip in clips]
        with progress_bar(sum(clip.info.frames for clip in clips), label) as advance:
            advance(sum(c.info.frames for c, d in zip(clips, done, strict=True) if d))
            left = [item for item, d in zip(items, done, strict=True) if not d]
            with finished_steps_only(self.folder):
                share_out(prepare, shared, left, processes=default_threads(), advance=advance)

    def _choose(self, frames: "_Frames") -> tuple[NDArray[np.int64], int, F32]:
        """Prototype frames, the reference among them, and the PCA coordinates of all frames."""
        coordinates = principal_coordinates(_Thumbnails(self.folder, frames.clips))
        usable = np.flatnonzero(frames.registered)
        chosen = choose_prototypes(
            coordinates[usable], self.options.prototypes, seed=self.options.seed
        )
        silent = np.array([label == SIL for clip in frames.clips for label in clip.labels])
        neutral = most_neutral(coordinates[usable], chosen, silent[usable])
        return usable[chosen], int(usable[chosen[neutral]]), coordinates

    def _basis(
        self,
        frames: "_Frames",
        reference: Reference,
        chosen: NDArray[np.int64],
        reference_frame: int,
        coordinates: F32,
    ) -> Basis:
        """Prototypes with their flows: direct, or along the path of similar frames."""
        region, match = reference.region, matcher(self.options.flow)
        mask = mouth_mask(region)
        before = shortest_paths(coordinates, reference_frame)
        paths = {int(i): path_to(int(i), before) for i in chosen}
        images = frames.crops(sorted({i for path in paths.values() for i in path}), region)
        origin, flows = images[reference_frame], []
        walked: dict[int, F32] = {}
        for i, path in progress(list(paths.items()), "prototype flows"):
            via = []
            if len(path) > 2:
                extend_flows(walked, path[:-1], images, match)
                via.append((images[path[-2]], walked[path[-2]]))
            flows.append(best_flow(origin, images[i], mask, via, match))
        stacked = np.stack([images[int(i)] for i in chosen])
        place = int(np.flatnonzero(chosen == reference_frame)[0])
        return make_basis(stacked, np.stack(flows), place, region)

    def _analyse(self, frames: "_Frames", basis: Basis) -> tuple[list[Floats], list[Floats]]:
        """alpha (T, M - 1) and beta (T, M) of every clip."""
        shared = (self.folder, basis, self.options.flow, self.backend)
        items = [(clip, frames.tracks[clip.path.name]) for clip in frames.clips]
        self._for_all(_analysing, shared, "analysis", "analyse frames", items)
        done = [_step(self.folder, "analysis", clip.path.name) for clip in frames.clips]
        return [d["alpha"] for d in done], [d["beta"] for d in done]

    def _phonemes(self, frames: "_Frames", name: str, coordinates: list[Floats]) -> TrainedStream:
        """The phoneme models of one stream, from the frames whose head was found."""
        utterances = []
        for clip, z in zip(frames.clips, coordinates, strict=True):
            good = np.flatnonzero(frames.tracks[clip.path.name].registered)
            labels = clip.labels
            utterances.append(Utterance(z[good].astype(np.float64), [labels[t] for t in good]))
        rng = np.random.default_rng(self.options.seed)
        with progress_bar(None, f"train {name}") as advance:
            return fit_stream(utterances, rng=rng, progress=lambda done, total: advance(1))


def _step(folder: Path, step: str, name: str) -> dict[str, NDArray[Any]]:
    """A step that has been done."""
    arrays = read_step(folder, f"{step}-{name}")
    assert arrays is not None, (step, name)
    return arrays


def _tracking(shared: tuple[Path, Reference, F32]) -> Work:
    """Keeps the track of a clip and a thumbnail of every frame; or why it must be left out."""
    folder, reference, mask = shared

    def work(clip: Clip, tick: Tick) -> None:
        try:
            track = track_clip(clip.path, reference)
        except InputError as e:
            write_step(folder, f"track-{clip.path.name}", {"skipped": np.array(str(e))})
            return
        small = []
        for image in crops(clip.path, track, reference.region):
            small.append(np.round(thumbnail(image, mask) * 255).astype(np.uint8))
            tick()
        arrays = vars(track) | {"residual": np.array(track.residual)}
        write_step(folder, f"track-{clip.path.name}", {**arrays, "thumbnails": np.array(small)})

    return work


def _analysing(shared: tuple[Path, Basis, str, str]) -> Work:
    """Keeps alpha and beta of every frame of a clip."""
    folder, basis, flow, backend = shared
    analyzer, kernels = prepare_analysis(basis, flow=flow), get_backend(backend, 1)

    def work(item: tuple[Clip, Track], tick: Tick) -> None:
        clip, track = item
        alpha, beta = [], []
        for image in crops(clip.path, track, basis.region):
            a, b = analyze(analyzer, image, kernels)
            alpha.append(a)
            beta.append(b)
            tick()
        arrays = {"alpha": np.array(alpha, np.float32), "beta": np.array(beta, np.float32)}
        write_step(folder, f"analysis-{clip.path.name}", arrays)

    return work


@dataclass(frozen=True)
class _Thumbnails(Sequence[NDArray[np.uint8]]):
    """The thumbnails of all clips, read from the work folder one clip at a time."""

    folder: Path
    clips: Sequence[Clip]

    def __len__(self) -> int:
        return len(self.clips)

    def __getitem__(self, i: Any) -> Any:
        return _step(self.folder, "track", self.clips[i].path.name)["thumbnails"]


@dataclass(frozen=True)
class _Frames:
    """The frames of all used clips as one numbered row."""

    clips: Sequence[Clip]
    tracks: Mapping[str, Track]

    @property
    def registered(self) -> NDArray[np.bool_]:
        return np.concatenate([self.tracks[c.path.name].registered for c in self.clips])

    def find(self, i: int) -> tuple[Clip, int]:
        """The clip and its frame that are number `i` of the row."""
        for clip in self.clips:
            if i < clip.info.frames:
                return clip, i
            i -= clip.info.frames
        raise IndexError(i)

    def crops(self, numbers: Sequence[int], region: Region) -> dict[int, F32]:
        """The regions of some frames, each clip read once; `numbers` is sorted."""
        found, first = {}, 0
        for clip in self.clips:
            wanted = {i - first for i in numbers if first <= i < first + clip.info.frames}
            if wanted:
                track = self.tracks[clip.path.name]
                frames = read_frames(clip.path, stop=max(wanted) + 1)
                for t, frame in enumerate(frames):
                    if t in wanted:
                        found[first + t] = crop(frame, track.poses[t], track, region)
            first += clip.info.frames
        return found


def _calmest(clips: Sequence[Clip], tracks: Mapping[str, Track], reference: Reference) -> Clip:
    """The clip whose head stays nearest to the pose of the reference."""

    def unrest(clip: Clip) -> float:
        poses = tracks[clip.path.name].poses
        return float(np.abs(poses[:, :2, 2] - poses[:, :2, 2].mean(axis=0)).mean())

    return min(clips, key=unrest)


def _notes(frames: _Frames, skipped: Mapping[str, str], options: Options) -> dict[str, Any]:
    tracks = frames.tracks.values()
    return {
        "clips": [clip.path.name for clip in frames.clips],
        "skipped": dict(skipped),
        "frames": int(frames.registered.size),
        "unregistered_frames": int((~frames.registered).sum()),
        "registration_residual_px": float(np.mean([t.residual for t in tracks])),
        "seed": options.seed,
        "sync_s": options.sync,
        "flow": options.flow,
    }
