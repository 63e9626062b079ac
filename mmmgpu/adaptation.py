"""Adaptation: a transferred model takes on the new person's speaking style (CE05, section 5).

The prototypes that resemble A's are not those that show B's clips best: others are chosen from
B's clips, and the phoneme models are carried into their coordinates (Eq. 11-13, `reselection`).
Then the means are adapted to B's own trajectories, class by class (Eq. 14-17, `adaptation_folds`).
"""

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmmgpu.adaptation_folds import METHODS, Adapted, adapt_models
from mmmgpu.basis import Basis
from mmmgpu.corpora import Clip, check_rates, open_corpus
from mmmgpu.corpus_steps import (
    Seen,
    analyse,
    calmest,
    fit_dynamics,
    fit_streams,
    look,
    make_model,
    track_corpus,
    tracking_notes,
    utterances_of,
)
from mmmgpu.dynamics import Dynamics
from mmmgpu.errors import InputError
from mmmgpu.flows import MATCHERS
from mmmgpu.frames import Frames, Pictures, rebased_frames
from mmmgpu.gdlr import RULES, Descent
from mmmgpu.models import Model
from mmmgpu.phonemes import PhonemeModels, Utterance, coverage
from mmmgpu.phones import CE05_PHONES, SIL, ce05_phone
from mmmgpu.picture_errors import flow_weights, texture_weights
from mmmgpu.processes import Tick
from mmmgpu.prototype_flows import prototype_basis
from mmmgpu.prototypes import choose_prototypes, principal_coordinates
from mmmgpu.regression_classes import Classes, broad_classes, kmeans_classes, paper_classes
from mmmgpu.reselection import COVARIANCES, carry
from mmmgpu.tracked_clips import kept_tracks, known_tracks
from mmmgpu.tracks import Track
from mmmgpu.trajectories import scaled_smoothness
from mmmgpu.trajectory_training import History, TrainedStream

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]

CLASSES = ("broad", "kmeans", "paper")
CLASS_COUNT = 4  # of k-means: 15 seconds hold too few phones for the paper's nine
OTHER_STEP = "gdlr_other_step"  # among the curves: GDLR with the step that was not chosen
LEAST_S = 1.0  # of speech and silence together


@dataclass(frozen=True)
class AdaptOptions:
    """What a person may choose about adaptation.

    method: one of `adaptation_folds.METHODS`; the others are kept in the model for comparison.
    classes: one of `CLASSES`: silence, vowels and consonants; k-means on the phoneme means; or the
        paper's nine.
    covariance: one of `reselection.COVARIANCES`, of the phoneme models after Eq. 13.
    step: one of `gdlr.RULES`.
    sync: [s] by which sound and alignments are moved against the picture; negative: earlier.
    flow: one of `flows.MATCHERS`.
    seed: of k-means and of the folds.
    """

    method: str = "gdlr"
    classes: str = "broad"
    covariance: str = "diagonal"
    step: str = "bounded"
    sync: float = 0.0
    flow: str = "dis"
    seed: int = 0


DEFAULTS = AdaptOptions()


def adapt(
    model: Model,
    clips: Sequence[str | os.PathLike[str]],
    alignments: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    options: AdaptOptions = DEFAULTS,
    backend: str = "warp",
) -> Model:
    """Adapt `model`, which has the face of the person in `clips`, to how that person speaks.

    Args:
        model: A transferred model.
        clips: Video files of its person, the one with the model's reference frame among them.
        alignments: Folder of TextGrid, .align or .lab files named like the clips, or one file.
        out: The model file; beside it ``out.work`` keeps finished steps until the job is done, and
            the same call continues after them.
        options: See `AdaptOptions`.
        backend: A name for `mmmgpu.backends.get_backend`.

    Returns:
        The adapted model. Its pooled phoneme models are those before adaptation, its trained ones
        those after; `alternatives` are the means by the other methods.

    Raises:
        InputError: A clip or alignment cannot be used; too little is said; the model has no
            phoneme models; an option is unknown.
    """
    _check_options(options)
    out = Path(out)
    corpus = open_corpus([Path(c) for c in clips], Path(alignments), sync=options.sync)
    check_rates(corpus)
    _check_corpus(model, corpus)
    given = {
        "options": vars(options),
        "reference": list(model.sources[model.basis.reference]),
        "box": list(model.basis.region.box),
        "sources": [list(place) for place in model.sources],
        "tracked": {name: clip.sha256 for name, clip in model.tracked.items()},
        "face": _face(model),
        "adapt": 1,
    }
    return make_model(
        out,
        corpus,
        given,
        lambda folder: _Adaptation(model, corpus, options, backend, folder).run(),
    )


def _face(model: Model) -> str:
    """Hash of the numbers in `model` that steps depend on."""
    digest, basis = hashlib.sha256(), model.basis
    tracks = [clip.track for clip in model.tracked.values()]
    seen = [part for t in tracks for part in (t.poses, t.registered, t.gain, t.offset)]
    for array in (basis.images, basis.w_f, basis.w_t, model.reference.head.to_frame, *seen):
        digest.update(array.tobytes())
    return digest.hexdigest()


def _check_options(options: AdaptOptions) -> None:
    choices = {
        "method": METHODS,
        "classes": CLASSES,
        "covariance": COVARIANCES,
        "step": tuple(RULES),
        "flow": MATCHERS,
    }
    for name, known in choices.items():
        given = getattr(options, name)
        if given not in known:
            raise InputError(f"{name}: must be one of {', '.join(known)}, got {given!r}")


def _check_corpus(model: Model, corpus: Sequence[Clip]) -> None:
    """There is enough to learn from, in the model's frame rate and with its reference frame."""
    if not model.alpha.trained.labels:
        raise InputError("the source model has no phoneme models; transfer from a trained model")
    rate, first = model.fps, corpus[0]
    if abs(first.info.fps / rate - 1) > 0.001:
        raise InputError(
            f"{first.path}: has {float(first.info.fps):g} frames/s, the model {float(rate):g}; "
            "convert the clips"
        )
    name, t = model.sources[model.basis.reference]
    if name not in [clip.name for clip in corpus]:
        raise InputError(f"{name}: holds the model's reference frame {t}; give this clip too")
    length = sum(float(clip.info.duration) for clip in corpus)
    if length < LEAST_S:
        raise InputError(
            f"{first.path}: {length:.2f} s are too short to adapt to; give {LEAST_S:g} s or more"
        )
    spoken = {label for clip in corpus for label in clip.labels} - {SIL}
    if len(spoken) < 2:
        what = f"only the phone {spoken.pop()}" if spoken else "no speech"
        raise InputError(f"{first.path}: the clips hold {what}; give clips with several phones")


@dataclass(frozen=True)
class _Adaptation:
    """One run; every method is a step."""

    model: Model
    corpus: list[Clip]
    options: AdaptOptions
    backend: str
    folder: Path

    def run(self) -> Model:
        model, options = self.model, self.options
        known = known_tracks(self.corpus, model.tracked)
        tracked, skipped = track_corpus(self.folder, self.corpus, model.reference, known)
        coordinates = principal_coordinates(look(self.folder, tracked, model.basis.region))
        frames = rebased_frames(tracked, *model.sources[model.basis.reference])
        chosen, basis = self._reselect(frames, coordinates)
        to_new, analysed = self._analyse(frames, basis, known)
        weights = flow_weights(basis), texture_weights(basis, backend=self.backend)
        starts = [
            _Start(_carried(old, matrix, options.covariance), utterances_of(frames, z), seen)
            for old, matrix, z, seen in zip(
                (model.alpha, model.beta), to_new, analysed, weights, strict=True
            )
        ]
        classes = self._classes([start.stream.trained for start in starts])
        found, dynamics = fit_streams(partial(_adapt, options, classes), starts, "adapt")
        alpha, beta = (
            _adapted_stream(start.stream, results[options.method])
            for start, results in zip(starts, found, strict=True)
        )
        whole, sources = frames.pictures(chosen)
        return Model(
            basis=basis,
            reference=model.reference,
            alpha=alpha,
            beta=beta,
            fps=model.fps,
            prototype_frames=whole,
            sources=sources,
            calm=calmest(frames),
            notes=self._notes(frames, skipped, classes, found),
            alternatives={
                m: (found[0][m].models.mean, found[1][m].models.mean)
                for m in METHODS
                if m not in ("none", options.method)
            },
            dynamics=dynamics,
            tracked=kept_tracks(tracked.clips, tracked.tracks),
        )

    def _reselect(self, frames: Frames, coordinates: F32) -> tuple[NDArray[np.int64], Basis]:
        """New prototypes from these clips, the reference frame among them, and their basis."""
        usable = np.flatnonzero(frames.registered)
        count = min(len(self.model.sources), len(usable))
        chosen = usable[choose_prototypes(coordinates[usable], count, seed=self.options.seed)]
        origin = frames.number(*self.model.sources[self.model.basis.reference])
        if origin not in chosen:
            near = ((coordinates[chosen] - coordinates[origin]) ** 2).sum(axis=1).argmin()
            chosen = np.sort(np.append(np.delete(chosen, near), origin))
        region = self.model.basis.region
        basis = prototype_basis(frames, region, chosen, origin, coordinates, flow=self.options.flow)
        return chosen, replace(basis, w_f=self.model.basis.w_f, w_t=self.model.basis.w_t)

    def _analyse(
        self, frames: Frames, basis: Basis, known: Mapping[str, Track]
    ) -> tuple[tuple[Floats, Floats], tuple[list[F32], list[F32]]]:
        """The old prototypes and the clips in the new ones.

        Eq. 11-12, A (M' - 1, M - 1) and B (M', M): column k is old prototype k. Then alpha and beta
        of every clip. Old prototypes from clips that are `known` are among the frames.
        """
        old, sources = self.model.basis, self.model.sources
        strange = np.array([k for k, (name, _) in enumerate(sources) if name not in known], int)
        halves = np.array_split(strange, 2)  # as stretches are, for all processes to have some
        own = [Pictures(f"prototypes-{i}", old.images[k]) for i, k in enumerate(halves) if len(k)]
        pieces: list[Seen] = [*frames.stretches, *own]
        flow, backend = self.options.flow, self.backend
        alpha, beta = analyse(self.folder, pieces, basis, flow=flow, backend=backend)
        last = {int(k): len(frames) + i for i, k in enumerate(strange)}
        rows = [last[k] if k in last else frames.number(*at) for k, at in enumerate(sources)]
        a, b = (z[rows].T.astype(np.float64) for z in (alpha, beta))
        return (a[:, old.moving], b), (frames.by_clip(alpha), frames.by_clip(beta))

    def _classes(self, before: Sequence[PhonemeModels]) -> Classes:
        """The phones that move together."""
        if self.options.classes == "broad":
            return broad_classes(before[0].labels)
        if self.options.classes == "paper":
            return paper_classes(before[0].labels)
        return kmeans_classes(*before, count=CLASS_COUNT, seed=self.options.seed)

    def _notes(
        self,
        frames: Frames,
        skipped: Mapping[str, str],
        classes: Classes,
        found: Sequence[Mapping[str, Adapted]],
    ) -> dict[str, Any]:
        kept = ("transferred_from", "matching")
        return {
            **tracking_notes(frames, skipped),
            "sync_s": self.options.sync,
            "flow": self.options.flow,
            "seed": self.options.seed,
            **{key: self.model.notes[key] for key in kept if key in self.model.notes},
            "adaptation": {
                "method": self.options.method,
                "covariance": self.options.covariance,
                "step": self.options.step,
                "classes": [list(members) for members in classes],
                "coverage": _coverage(frames),
                "curves": {
                    name: {method: _curve(of) for method, of in results.items()}
                    for name, results in zip(("alpha", "beta"), found, strict=True)
                },
            },
        }


@dataclass(frozen=True)
class _Start:
    """A stream before adaptation; what the clips show of it; and W, what errors in it count."""

    stream: TrainedStream
    utterances: Sequence[Utterance]
    weights: Floats


def _carried(old: TrainedStream, matrix: Floats, covariance: str) -> TrainedStream:
    """A stream in the new prototypes (Eq. 13)."""
    models = carry(old.trained, matrix, covariance=covariance)
    smoothness = scaled_smoothness(models, old.constants.smoothness)
    return replace(old, pooled=models, trained=models, smoothness=smoothness)


def _adapt(
    options: AdaptOptions, classes: Classes, start: _Start, tick: Tick
) -> tuple[dict[str, Adapted], dict[str, Dynamics]]:
    """One stream by every method, and by GDLR with the step not chosen; and its other movements."""

    def by(method: str, step: str) -> Adapted:
        return adapt_models(
            start.stream.pooled,
            start.utterances,
            smoothness=start.stream.smoothness,
            order=start.stream.constants.order,
            method=method,
            classes=classes,
            rng=np.random.default_rng(options.seed),
            weights=start.weights,
            descent=Descent(rule=step),
            progress=lambda done, total: tick(),
        )

    (other,) = (rule for rule in RULES if rule != options.step)
    results = {method: by(method, options.step) for method in METHODS}
    results[OTHER_STEP] = by("gdlr", other)
    return results, fit_dynamics(start.utterances, tick)


def _coverage(frames: Frames) -> dict[str, Any]:
    """Frames a phone with and without silence and the phones not seen, of the paper's 40."""
    said = [ce05_phone(label) for clip in frames.clips for label in clip.labels]
    found = coverage(said, CE05_PHONES)
    return {
        "frames": found.frames,
        "frames_per_phone": found.per_phone,
        "frames_per_phone_without_silence": found.per_phone_without_silence,
        "phones_not_seen": list(found.unseen),
    }


def _adapted_stream(start: TrainedStream, best: Adapted) -> TrainedStream:
    dimensions = len(start.smoothness)
    return replace(
        start,
        trained=best.models,
        history=History(np.empty((0, dimensions))),
        validation=best.validation,
    )


def _curve(result: Adapted) -> dict[str, Any]:
    """What was tried and how well it did: `Adapted.training` and `Adapted.validation`.

    "path": which candidates are the iterations of GDLR at the chosen rate, in order.
    """
    return {
        "chosen": result.constants,
        "candidates": list(result.candidates),
        "path": result.path.tolist(),
        "training": [float(e) for e in result.training],
        "validation": [float(e) for e in result.validation],
    }
