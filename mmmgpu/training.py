"""Training: from clips and their alignments to a model, streaming and resumable (docs/model.md).

The steps: find the mouth, track every clip, choose prototypes, compute their flows, analyse every
frame, train the phoneme models. What each step finds for a clip is kept in a folder beside the
result until the job is done; in memory stay the PCA and model coordinates of the frames.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmmgpu.corpora import Clip, check_rates, open_corpus
from mmmgpu.corpus_steps import (
    analyse_corpus,
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
from mmmgpu.frames import Frames, rebased_frames
from mmmgpu.models import Model
from mmmgpu.phonemes import Utterance
from mmmgpu.phones import SIL
from mmmgpu.processes import Tick
from mmmgpu.prototype_flows import prototype_basis
from mmmgpu.prototypes import choose_prototypes, most_neutral, principal_coordinates
from mmmgpu.references import check_sound, find_reference, rebase_reference
from mmmgpu.regions import Region
from mmmgpu.trajectory_training import TrainedStream, fit_stream

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
    check_rates(corpus)
    if options.region is None:
        check_sound(corpus)
    given = {"options": vars(options), "steps": 2}
    return make_model(
        out, corpus, given, lambda folder: _Training(corpus, options, backend, folder).run()
    )


@dataclass(frozen=True)
class _Training:
    """One run over a corpus; every method is a step of the module docstring."""

    corpus: list[Clip]
    options: Options
    backend: str
    folder: Path

    def run(self) -> Model:
        provisional = find_reference(self.corpus, self.options.region, sync=self.options.sync)
        frames, skipped = track_corpus(self.folder, self.corpus, provisional)
        chosen, reference_frame, coordinates = self._choose(frames, provisional.region)
        clip, t = frames.find(reference_frame)
        size = (clip.info.width, clip.info.height)
        first = frames.tracks[clip.name]
        kept = self.options.region is not None
        reference = rebase_reference(provisional, first, t, size, keep_box=kept)
        frames = rebased_frames(frames, clip.name, t)
        flow = self.options.flow
        basis = prototype_basis(
            frames, reference.region, chosen, reference_frame, coordinates, flow=flow
        )
        alphas, betas = analyse_corpus(self.folder, frames, basis, flow=flow, backend=self.backend)
        spoken = [utterances_of(frames, stream) for stream in (alphas, betas)]
        (alpha, beta), dynamics = fit_streams(
            partial(_learn, self.options.seed), spoken, "train phonemes"
        )
        whole, sources = frames.pictures(chosen)
        return Model(
            basis=basis,
            reference=reference,
            alpha=alpha,
            beta=beta,
            fps=frames.clips[0].info.fps,
            prototype_frames=whole,
            sources=sources,
            calm=calmest(frames),
            notes=_notes(frames, skipped, self.options),
            dynamics=dynamics,
        )

    def _choose(self, frames: Frames, region: Region) -> tuple[NDArray[np.int64], int, F32]:
        """Prototype frames, the reference among them, and the PCA coordinates of all frames."""
        coordinates = principal_coordinates(look(self.folder, frames, region))
        usable = np.flatnonzero(frames.registered)
        chosen = choose_prototypes(
            coordinates[usable], self.options.prototypes, seed=self.options.seed
        )
        silent = np.array([label == SIL for clip in frames.clips for label in clip.labels])
        neutral = most_neutral(coordinates[usable], chosen, silent[usable])
        return usable[chosen], int(usable[chosen[neutral]]), coordinates


def _learn(
    seed: int, utterances: Sequence[Utterance], tick: Tick
) -> tuple[TrainedStream, dict[str, Dynamics]]:
    """The phoneme models and other movements of one stream, from frames whose head was found."""
    rng = np.random.default_rng(seed)
    trained = fit_stream(utterances, rng=rng, progress=lambda done, total: tick())
    return trained, fit_dynamics(utterances, tick)


def _notes(frames: Frames, skipped: Mapping[str, str], options: Options) -> dict[str, Any]:
    return {
        **tracking_notes(frames, skipped),
        "seed": options.seed,
        "sync_s": options.sync,
        "flow": options.flow,
    }
