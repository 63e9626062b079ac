"""Transfer: a model learned from one person's long video, with the pictures of another (CE05, 4).

A is the person with a model, B the new one. B's clips are tracked from the closed reference frame
that POINTS names, the flows of all of B's frames are taken relative to B's reference frames, and
every prototype of A is replaced by the frame of B that shows the same (`matching`). Phoneme models
stay A's: B speaks in A's style until `adaptation`.
"""

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mmmgpu.backends import default_threads
from mmmgpu.basis import MOUTH, Basis, around, make_basis, part_of, still_outside
from mmmgpu.checkpoints import write_step
from mmmgpu.corpora import Clip, open_corpus
from mmmgpu.corpus_steps import (
    calmest,
    finished_step,
    for_all,
    make_model,
    track_corpus,
    tracking_notes,
)
from mmmgpu.correspondence import Correspondence, rbf_correspondence
from mmmgpu.errors import InputError
from mmmgpu.flow_matching import SMOOTHING, View
from mmmgpu.flows import Matcher, at_scale, best_flow, best_of, concatenate, matcher
from mmmgpu.frames import Frames, Stretch, rebased_frames
from mmmgpu.matching import BALANCE, Matching, match_prototypes
from mmmgpu.models import Model
from mmmgpu.parallel import Cancelled, map_ordered
from mmmgpu.points import CLOSED, PointPair, check_frames, read_points
from mmmgpu.processes import Tick, Work
from mmmgpu.reference_pairs import pose_of
from mmmgpu.regions import Region, carried_mouth, mouth_mask, region_around
from mmmgpu.registration import head_from_frame, project
from mmmgpu.tracked_clips import kept_tracks
from mmmgpu.tracks import Reference, crop, frame_at, make_reference

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]

WIDE = 64  # [px] at most, of a mouth in the pictures in which B's flows are looked for
IMAGES = "images"  # beside the kinds of reference frames, what a step of flows keeps


@dataclass(frozen=True)
class TransferOptions:
    """What a person may choose about transfer.

    balance: t of the paper, in [0, 1]: 1 matches by flow alone, 0 by texture alone.
    sync: [s] by which sound and alignments are moved against the picture; negative: earlier.
    flow: one of `flows.MATCHERS`.
    """

    balance: float = BALANCE
    sync: float = 0.0
    flow: str = "dis"


DEFAULTS = TransferOptions()


def transfer(
    source: Model,
    clips: Sequence[str | os.PathLike[str]],
    alignments: str | os.PathLike[str],
    points: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    options: TransferOptions = DEFAULTS,
    backend: str = "warp",
) -> Model:
    """Give `source` the face of the person in `clips`, and write the new model to `out`.

    Args:
        source: A's model.
        clips: Video files of B; 15 seconds will do.
        alignments: Folder of TextGrid, .align or .lab files named like the clips, or one file.
        points: File of corresponding points (`mmmgpu mark`) in the closed and, if there are any,
            open reference frames of both.
        out: The model file; beside it ``out.work`` keeps finished steps until the job is done, and
            the same call continues after them.
        options: See `TransferOptions`.
        backend: A name for `mmmgpu.backends.get_backend`.

    Raises:
        InputError: A clip, alignment or the points cannot be used; the points are of other frames;
            B's head is found in no clip.
    """
    if not 0 <= options.balance <= 1:
        raise InputError(f"balance must be between 0 and 1, got {options.balance}")
    out = Path(out)
    corpus = open_corpus([Path(c) for c in clips], Path(alignments), sync=options.sync)
    marked = _marked_frames(source, corpus, Path(points))
    given = {
        "options": vars(options),
        "points": [vars(m.pair.b) | {"at": m.pair.points_b.tolist()} for m in marked.values()],
        "from": [m.pair.points_a.tolist() for m in marked.values()],
        "sources": [list(place) for place in source.sources],
        "transfer": 1,
    }
    return make_model(
        out,
        corpus,
        given,
        lambda folder: _Transfer(source, corpus, marked, options, backend, folder).run(),
    )


@dataclass(frozen=True)
class _Marked:
    """A pair of reference frames with the points in them.

    prototype: A's frame is that of this prototype. picture: B's frame, (H, W, 3).
    """

    pair: PointPair
    prototype: int
    picture: NDArray[np.uint8]


def _marked_frames(source: Model, corpus: Sequence[Clip], path: Path) -> dict[str, _Marked]:
    """The frames that the points at `path` are of, by kind."""
    marked = {}
    by_name = {clip.name: clip for clip in corpus}
    for pair in read_points(path):
        where = f"{path}: {pair.kind} pair"
        place = (pair.a.clip, pair.a.frame)
        if place not in source.sources:
            raise InputError(
                f"{where}: frame {pair.a.frame} of {pair.a.clip} is no prototype of the model; "
                "mark the points again with this model"
            )
        k = source.sources.index(place)
        if pair.kind == CLOSED and k != source.basis.reference:
            raise InputError(
                f"{where}: frame {pair.a.frame} of {pair.a.clip} is not the reference of the "
                "model; mark the points again with this model"
            )
        clip = by_name.get(pair.b.clip)
        if clip is None or not 0 <= pair.b.frame < clip.length:
            raise InputError(
                f"{where}: frame {pair.b.frame} of {pair.b.clip} is not among the clips; give "
                "the clip too, or mark the points again"
            )
        marked[pair.kind] = _Marked(pair, k, frame_at(clip.path, pair.b.frame))
    shown = {kind: (source.prototype_frames[m.prototype], m.picture) for kind, m in marked.items()}
    check_frames([m.pair for m in marked.values()], shown, path)
    return marked


@dataclass(frozen=True)
class _Transfer:
    """One run; every method is a step."""

    source: Model
    corpus: list[Clip]
    marked: Mapping[str, _Marked]
    options: TransferOptions
    backend: str
    folder: Path

    def run(self) -> Model:
        reference, old = self._reference(), self.source.basis
        tracked, skipped = self._track(reference)
        at = self.marked[CLOSED].pair.b
        frames = rebased_frames(tracked, at.clip, at.frame)
        region, usable = reference.region, np.flatnonzero(frames.registered)
        to_region = self._correspondence(frames, CLOSED, region)
        w_f, w_t = (carried_mask(m, to_region, region.shape) for m in (old.w_f, old.w_t))
        inside = around(np.maximum(w_f, w_t) > MOUTH)
        near = part_of(region, inside)
        flows = self._seen(frames, near, w_t[inside])
        images = flows.pop(IMAGES)
        views = [
            View(
                self._correspondence(frames, kind, near, smoothing=SMOOTHING),
                self._source_flows(kind),
                flow,
            )
            for kind, flow in flows.items()
        ]
        closed = int(np.searchsorted(usable, self._number(frames, CLOSED)))
        matching = match_prototypes(
            old,
            Basis(images, flows[CLOSED], 0, near, w_f[inside], w_t[inside], w_t[inside]),
            views,
            fixed=[(old.reference, closed)],
            balance=self.options.balance,
            backend=self.backend,
        )
        chosen = matching.chosen
        basis = self._basis(frames, region, usable[chosen])
        whole, sources = frames.pictures(usable[chosen])
        return replace(
            self.source,
            basis=replace(basis, w_f=w_f, w_t=w_t),
            reference=reference,
            prototype_frames=whole,
            sources=sources,
            calm=calmest(frames),
            notes=self._notes(frames, skipped, matching, near),
            tracked=kept_tracks(tracked.clips, tracked.tracks),
        )

    def _reference(self) -> Reference:
        """B's closed frame, with A's mouth carried to where it is in it."""
        closed = self.marked[CLOSED]
        s = rbf_correspondence(closed.pair.points_a, closed.pair.points_b)
        mouth = carried_mouth(self.source.reference.region.mouth, s)
        height, width = closed.picture.shape[:2]
        head = head_from_frame(closed.picture, np.array(mouth))
        return make_reference(closed.picture, head, region_around(mouth, (width, height)))

    def _track(self, reference: Reference) -> tuple[Frames, dict[str, str]]:
        """B's frames, those that are marked among them; and the clips left out, with reasons."""
        frames, skipped = track_corpus(self.folder, self.corpus, reference)
        for kind, marked in self.marked.items():
            if marked.pair.b.clip not in frames.tracks:
                raise InputError(
                    f"{marked.pair.b.clip}: holds the {kind} reference frame, but its head was "
                    "not found in the clip; mark another frame"
                )
        return frames, skipped

    def _number(self, frames: Frames, kind: str) -> int:
        at = self.marked[kind].pair.b
        return frames.number(at.clip, at.frame)

    def _correspondence(
        self, frames: Frames, kind: str, region: Region, smoothing: float = 0.0
    ) -> Correspondence:
        """S of a pair, from the pixels of A's stabilised region to those of `region` of B."""
        marked = self.marked[kind]
        pose_a = np.eye(3)
        if kind != CLOSED:
            picture = self.source.prototype_frames[marked.prototype]
            pose_a = pose_of(picture, self.source.reference, f"the model's {kind} frame")
        pose_b = frames.tracks[marked.pair.b.clip].poses[marked.pair.b.frame]
        a = _carried_back(pose_a, marked.pair.points_a) - self.source.basis.region.box[:2]
        b = _carried_back(pose_b, marked.pair.points_b) - region.box[:2]
        return rbf_correspondence(a, b, smoothing=smoothing)

    def _folded(self, frames: Frames, kind: str, region: Region) -> float:
        """Share of A's mouth that S folds over; a warning says so."""
        mouth = self.source.basis.w_t > MOUTH
        s = self._correspondence(frames, kind, region)
        share = float(s.folds(*mouth.shape[::-1])[mouth].mean())
        if share:
            print(
                f"warning: the {kind} points fold {100 * share:.1f} % of the mouth over; look for "
                "crossed points with: mmmgpu mark",
                file=sys.stderr,
            )
        return share

    def _source_flows(self, kind: str) -> F32:
        """Flows of A's prototypes from the reference frame of `kind`, (M, h, w, 2)."""
        basis, match = self.source.basis, matcher(self.options.flow)
        if kind == CLOSED:
            return basis.flows
        origin = basis.images[self.marked[kind].prototype]
        closed = basis.images[basis.reference]
        via = [(closed, match(origin, closed))]

        def one(image: F32, _: Cancelled) -> F32:
            return best_flow(origin, image, basis.w_t, via, match)

        flows = list(map_ordered(one, basis.images, threads=default_threads()))
        return still_outside(np.stack(flows), basis.cover)

    def _references(self, frames: Frames, region: Region) -> dict[str, F32]:
        """`region` of B's reference frames."""
        pictures = {}
        for kind, marked in self.marked.items():
            track = frames.tracks[marked.pair.b.clip]
            pictures[kind] = crop(marked.picture, track.poses[marked.pair.b.frame], track, region)
        return pictures

    def _basis(self, frames: Frames, region: Region, chosen: NDArray[np.int64]) -> Basis:
        """The basis of the frames of B that are number `chosen`, on the whole region."""
        origins = self._references(frames, region)
        images = frames.crops(chosen, region)
        flows_to = _flow_finder(origins, mouth_mask(region), matcher(self.options.flow))

        def one(image: F32, _: Cancelled) -> F32:
            return flows_to(image)[CLOSED]

        found = map_ordered(one, images.values(), threads=default_threads())
        flows = dict(zip(images, found, strict=True))
        pictures, moved = (np.stack([found[int(i)] for i in chosen]) for found in (images, flows))
        return make_basis(pictures, moved, self.source.basis.reference, region)

    def _seen(self, frames: Frames, region: Region, mask: F32) -> dict[str, F32]:
        """B's usable frames: `region` of each, (N, h', w', 3), called `IMAGES`; and its flows from
        each reference frame, (N, h', w', 2).
        """
        shared = (self.folder, region, self._references(frames, region), mask, self.options.flow)
        for_all(self.folder, _flowing, shared, "flow", "flows of frames", frames.stretches)
        parts: dict[str, list[F32]] = {name: [] for name in (IMAGES, *self.marked)}
        for stretch in frames.stretches:
            step = finished_step(self.folder, "flow", stretch)
            for name, found in parts.items():
                found.append(step[name][stretch.registered])
        return {name: np.concatenate(found) for name, found in parts.items()}

    def _notes(
        self,
        frames: Frames,
        skipped: Mapping[str, str],
        matching: Matching,
        region: Region,
    ) -> dict[str, Any]:
        kinds = list(self.marked)
        return {
            **tracking_notes(frames, skipped),
            "sync_s": self.options.sync,
            "flow": self.options.flow,
            "transferred_from": {
                "clips": self.source.notes.get("clips", []),
                "prototypes": [list(place) for place in self.source.sources],
            },
            "matching": {
                "balance": self.options.balance,
                "outcome": matching.outcome,
                "iterations": len(matching.history) - 1,
                "flow_history": matching.flow_history.tolist(),
                "history": matching.history.tolist(),
                "flow_distance": np.round(matching.flow_distance, 6).tolist(),
                "texture_distance": np.round(matching.texture_distance, 6).tolist(),
                "reference": [kinds[v] for v in matching.view],
                "different_frames": len(set(matching.chosen.tolist())),
                "folded_share": {kind: self._folded(frames, kind, region) for kind in kinds},
            },
        }


def _carried_back(pose: Floats, points: Floats) -> Floats:
    """Points of a frame, (n, 2) [px], where the reference sees them."""
    return project(np.asarray(np.linalg.inv(pose), np.float64), points)


def carried_mask(mask: F32, s: Correspondence, shape: tuple[int, int]) -> F32:
    """A's `mask` (h, w) on B's pixels, (h', w') = `shape`: read at the inverse of S."""
    q = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), axis=-1)
    p = s.inverse(q).astype(np.float32)
    return np.asarray(cv2.remap(mask, p[..., 0], p[..., 1], cv2.INTER_LINEAR), np.float32)


def _flow_finder(
    origins: Mapping[str, F32], mask: F32, match: Matcher
) -> Callable[[F32], dict[str, F32]]:
    """A function image -> flows from all references: direct, or by another reference."""
    between = {(a, b): match(origins[a], origins[b]) for a in origins for b in origins if a != b}

    def flows_to(image: F32) -> dict[str, F32]:
        direct = {kind: match(origin, image) for kind, origin in origins.items()}
        found = {}
        for kind, origin in origins.items():
            via = [concatenate(way, direct[b]) for (a, b), way in between.items() if a == kind]
            found[kind] = best_of(origin, image, mask, [direct[kind], *via])
        return found

    return flows_to


def frame_matcher(name: str, region: Region) -> Matcher:
    """One of `flows.MATCHERS` for all frames of a corpus, in pictures as large as need be.

    Matching finds as many counterparts with mouths 47, 64 and 94 px wide.
    """
    return at_scale(matcher(name), min(1.0, WIDE / region.mouth[2]))


def _flowing(shared: tuple[Path, Region, Mapping[str, F32], F32, str]) -> Work:
    """Keeps the pictures of a stretch and their flows from each reference."""
    folder, region, origins, mask, flow = shared
    flows_to = _flow_finder(origins, mask, frame_matcher(flow, region))

    def work(stretch: Stretch, tick: Tick) -> None:
        seen: dict[str, list[F32]] = {name: [] for name in (IMAGES, *origins)}
        for image in stretch.crops(region):
            for name, found in {IMAGES: image, **flows_to(image)}.items():
                seen[name].append(found)
            tick()
        write_step(folder, f"flow-{stretch.name}", {k: np.stack(f) for k, f in seen.items()})

    return work
