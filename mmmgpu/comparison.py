"""Comparison of the models of movement by cross-validation over sentences (ECR07, section 4).

The sentences are dealt into folds. For each fold features are learned from the other folds' clips
(`mmmgpu.comparison_features`), every model is fitted to them, and each is judged by what it
generates for the fold's own sentences. Folds run in parallel processes; those that are finished are
kept, so that a killed comparison goes on.
"""

from __future__ import annotations

import json
import shutil
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mmmgpu.backends import default_threads
from mmmgpu.checkpoints import (
    fingerprint,
    finished_steps_only,
    open_checkpoints,
    read_step,
    write_step,
)
from mmmgpu.comparison_features import Eye, Features
from mmmgpu.comparison_scores import Scores, not_comparable, paired_tests, score, summarise
from mmmgpu.corpora import Clip
from mmmgpu.dynamics import FIVE, MODELS, Dynamics, Generative, trajectory
from mmmgpu.errors import InputError, UnsettledWarning
from mmmgpu.files import require_folder
from mmmgpu.labelled import Floats, check_sequence, stand_ins
from mmmgpu.processes import Tick, Work, share_out
from mmmgpu.progress import progress_bar

REALITY = "reality"  # the condition of videos made from real features


@dataclass(frozen=True)
class CompareOptions:
    """What a person may choose about a comparison.

    folds: into which the sentences are dealt.
    seed: of the dealing.
    models: names in `dynamics.MODELS`.
    """

    folds: int = 10
    seed: int = 0
    models: tuple[str, ...] = FIVE


DEFAULTS = CompareOptions()


def compare(
    corpus: Sequence[Clip],
    features: Features,
    work: Path,
    *,
    videos: Path | None = None,
    options: CompareOptions = DEFAULTS,
) -> dict[str, Any]:
    """Judge models of movement on sentences that they were not fitted to.

    Args:
        corpus: Clips of one person with their alignments: the sentences.
        features: Where features come from.
        work: Folder for finished folds; removed at the end. The same call continues there.
        videos: Folder for ``CONDITION/SENTENCE.mp4`` of every sentence by every model and by
            `REALITY`. None: no videos are made.
        options: See `CompareOptions`.

    Returns:
        JSON values: `models`, `tests` and `not_comparable` (see `comparison_scores`), `folds` with
        the scores of each, `sentences` with those of each sentence, and by fold `stand_ins`, the
        labels that were in no sentence that it learned from, with what took their place, and
        `unsettled`, the fits that a cap on their iterations ended.

    Raises:
        InputError: There are fewer clips than folds, or fewer than two folds; there is no such
            model; a video would replace a clip; what cannot be used is named by fold and sentence.
    """
    folds = deal(len(corpus), options)
    _check_names(options.models)
    _keep_clips(corpus, videos, options.models)
    given = {**vars(options), "features": features.facts(), "videos": str(videos)}
    given["said"] = [clip.labels for clip in corpus]
    folder = open_checkpoints(work, fingerprint([clip.path for clip in corpus], given))
    shared = (folder, list(corpus), features, folds, videos, options.models)
    done = [read_step(folder, f"fold-{f}") is not None for f in range(len(folds))]
    with (
        progress_bar(len(folds) * len(options.models), "compare") as advance,
        finished_steps_only(folder),
    ):
        advance(sum(done) * len(options.models))
        left = [f for f, is_done in enumerate(done) if not is_done]
        share_out(_comparing, shared, left, processes=default_threads(), advance=advance)
    results = [_read(folder, f) for f in range(len(folds))]
    shutil.rmtree(folder)
    return _gathered(results, options.models)


def _check_names(models: Sequence[str]) -> None:
    """There are such models, each named once."""
    if not models or len(set(models)) != len(models) or not set(models) <= set(MODELS):
        raise InputError(
            f"models must be some of {', '.join(MODELS)}, each once, got {','.join(models)!r}"
        )


def _keep_clips(corpus: Sequence[Clip], videos: Path | None, models: Sequence[str]) -> None:
    """Refuse videos that would replace what they are made from."""
    if videos is None:
        return
    clips = {clip.path.resolve() for clip in corpus}
    for condition in (*models, REALITY):
        for clip in corpus:
            out = _video(videos, condition, clip.path.stem)
            if out.resolve() in clips:
                raise InputError(f"{out}: would replace a clip; choose another folder for videos")


def _video(videos: Path, condition: str, sentence: str) -> Path:
    return videos / condition / f"{sentence}.mp4"


def deal(count: int, options: CompareOptions) -> list[list[int]]:
    """Numbers 0 ... count - 1 in `options.folds` random folds whose sizes differ by 1 at most.

    Raises:
        InputError: There are not that many folds to be had.
    """
    if not 2 <= options.folds <= count:
        raise InputError(
            f"folds must be between 2 and the number of clips, {count}, got {options.folds}"
        )
    order = np.random.default_rng(options.seed).permutation(count)
    return [sorted(order[f :: options.folds].tolist()) for f in range(options.folds)]


def _comparing(
    shared: tuple[Path, list[Clip], Features, list[list[int]], Path | None, tuple[str, ...]],
) -> Work:
    """Keeps the results of a fold."""
    folder, corpus, features, folds, videos, models = shared

    def work(fold: int, tick: Tick) -> None:
        result = _Fold(fold, corpus, features, folds[fold], videos, models).run(folder, tick)
        write_step(folder, f"fold-{fold}", {"result": np.array(json.dumps(result))})

    return work


@dataclass(frozen=True)
class _Fold:
    """One fold: the sentences `own` are judged by what is learned from all others."""

    number: int
    corpus: Sequence[Clip]
    features: Features
    own: Sequence[int]
    videos: Path | None
    models: Sequence[str]

    def run(self, folder: Path, tick: Tick) -> dict[str, Any]:
        others = [i for i in range(len(self.corpus)) if i not in self.own]
        with self._named("features"):
            eye = self.features.learn([self.corpus[i] for i in others], folder, self.number)
        y: dict[int, Floats] = {}
        for i in (*others, *self.own):
            y[i] = self._seen(eye, i, y[others[0]].shape[1] if y else None)
        labels = [self.corpus[i].labels for i in others]
        unsettled: list[str] = []
        scores: dict[str, Scores] = {}
        sentences: dict[str, dict[str, Scores]] = {self._name(i): {} for i in self.own}
        for name in self.models:
            with self._named(name), _noting(unsettled):
                model = MODELS[name].fit([y[i] for i in others], labels)
            made, likely = [], []
            for i in self.own:
                x, value = self._judged(name, model, i, y[i])
                made.append(x)
                likely.append(value)
                sentences[self._name(i)][name] = score([x], [y[i]], value)
                self._show(eye, name, i, x)
            total = None if None in likely else float(sum(v for v in likely if v is not None))
            scores[name] = score(made, [y[i] for i in self.own], total)
            tick()
        for i in self.own:
            self._show(eye, REALITY, i, y[i])
        spoken = [label for i in self.own for label in self.corpus[i].labels]
        known = sorted({label for row in labels for label in row})
        return {
            "scores": scores,
            "sentences": sentences,
            "stand_ins": stand_ins(known, spoken),
            "unsettled": unsettled,
        }

    def _name(self, i: int) -> str:
        return self.corpus[i].path.stem

    def _seen(self, eye: Eye, i: int, d: int | None) -> Floats:
        """Features of sentence i, (T, d); any d if None."""
        with self._named(self._name(i)):
            clip = self.corpus[i]
            return check_sequence(eye.features(clip), clip.labels, "features", d)

    def _judged(self, name: str, model: Dynamics, i: int, y: Floats) -> tuple[Floats, float | None]:
        """What `model` makes of sentence i, and how likely it holds the real one."""
        labels = self.corpus[i].labels
        with self._named(f"{self._name(i)} by {name}"):
            value = model.log_likelihood(y, labels) if isinstance(model, Generative) else None
            return trajectory(model, labels), value

    def _show(self, eye: Eye, condition: str, i: int, x: Floats) -> None:
        if self.videos is not None:
            out = _video(self.videos, condition, self._name(i))
            require_folder(out.parent)
            with self._named(f"{self._name(i)} by {condition}"):
                eye.render(self.corpus[i], x, out)

    @contextmanager
    def _named(self, what: str) -> Iterator[None]:
        """Errors say which fold and sentence or model they are of."""
        try:
            yield
        except (InputError, ArithmeticError, np.linalg.LinAlgError) as e:
            raise InputError(f"fold {self.number + 1}, {what}: {e}") from e


@contextmanager
def _noting(unsettled: list[str]) -> Iterator[None]:
    """Adds to `unsettled` which fits were ended by their cap on iterations."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", UnsettledWarning)
        yield
    for one in said:
        if issubclass(one.category, UnsettledWarning):
            unsettled.append(str(one.message))
        else:
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)


def _read(folder: Path, fold: int) -> dict[str, Any]:
    step = read_step(folder, f"fold-{fold}")
    assert step is not None, fold
    result: dict[str, Any] = json.loads(str(step["result"]))
    return result


def _gathered(results: Sequence[Mapping[str, Any]], models: Sequence[str]) -> dict[str, Any]:
    """All folds together; warnings tell of labels that some fold had to replace, and of fits."""
    missing, unsettled = _by_fold(results, "stand_ins"), _by_fold(results, "unsettled")
    if missing:
        said = "; ".join(
            f"{fold}: " + ", ".join(f"{other} for {label}" for label, other in own.items())
            for fold, own in missing.items()
        )
        print(f"warning: not in every fold's training sentences: {said}", file=sys.stderr)
    if unsettled:
        said = "; ".join(f"{fold}: {', '.join(own)}" for fold, own in unsettled.items())
        print(f"warning: fits that were ended early: {said}", file=sys.stderr)
    scores = [result["scores"] for result in results]
    return {
        "models": summarise(scores),
        "not_comparable": not_comparable([m for m in models if not MODELS[m].comparable]),
        "tests": paired_tests(scores),
        "folds": scores,
        "sentences": {k: v for r in results for k, v in sorted(r["sentences"].items())},
        "stand_ins": missing,
        "unsettled": unsettled,
    }


def _by_fold(results: Sequence[Mapping[str, Any]], what: str) -> dict[str, Any]:
    """What the folds, counted from 1, have to tell; those that have nothing are left out."""
    return {f"fold {n}": r[what] for n, r in enumerate(results, start=1) if r[what]}
