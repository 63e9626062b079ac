"""Make a study folder from folders of clips: blind copies of them, and the plan of who sees what.

The plan comes from a seed, which is kept with it; names and tokens must not be guessed, and never
come from it.
"""

import os
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mmmgpu.errors import InputError
from mmmgpu.files import atomic_folder
from mmmgpu.progress import progress
from mmmgpu.studies import CLIPS, Pair, Participant, Study, StudyClip, write_study
from mmmgpu.study_clips import compare_clips, find_clips, write_clips
from mmmgpu.study_plans import PlannedPair, draw_plan

INTRODUCTION = (
    "You will be shown pairs of short video clips of one person who speaks one sentence. "
    "Some clips are real, others are artificial. Of each pair, choose the clip that you take for "
    "real. If you cannot tell, say so. Please switch the sound on."
)
SEED_BITS = 32


@dataclass(frozen=True)
class StudyOptions:
    """How a study is made.

    conditions: the folders that are taken; None: all.
    real: the condition whose sound all clips get, and whose clips attention checks are made from.
    participants: how many links there are; unused ones do no harm.
    pairs: a participant; None: each ordered pair of conditions once.
    checks: attention checks a participant, beside the pairs.
    cut: show as much of a sentence's clips as the shortest has. mute: no sound.
    seed: of the plan; None: one that nobody knows beforehand.
    introduction: what participants read first.
    """

    conditions: tuple[str, ...] | None = None
    real: str = "reality"
    participants: int = 40
    pairs: int | None = None
    checks: int = 2
    cut: bool = False
    mute: bool = False
    seed: int | None = None
    introduction: str = INTRODUCTION


def create_study(
    clips: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    options: StudyOptions = StudyOptions(),
) -> Study:
    """Make the study folder `out` from the clips CLIPS/CONDITION/SENTENCE.*, and return its plan.

    The folder appears when it is complete.

    Raises:
        InputError: The clips are not paired or not alike, cannot be read, or none of them is
            called `options.real`; a number of `options` is out of range; `out` exists already.
    """
    _check(options)
    found = find_clips(Path(clips), options.conditions)
    conditions = sorted(next(iter(found.values())))
    if options.real not in conditions:
        raise InputError(
            f"{clips}: '{options.real}' is none of the conditions; say with --real which is real: "
            f"{', '.join(conditions)}"
        )
    sentences = [
        compare_clips(name, files, cut=options.cut)
        for name, files in progress(found.items(), "clips", total=len(found))
    ]
    with atomic_folder(out) as folder:
        (folder / CLIPS).mkdir()
        written: list[StudyClip] = []
        for sentence in progress(sentences, "blind copies"):
            written += write_clips(folder / CLIPS, sentence, real=options.real, mute=options.mute)
        study = _plan(conditions, list(found), written, options)
        write_study(folder, study)
    return study


def _check(options: StudyOptions) -> None:
    for name, value, least in (
        ("participants", options.participants, 1),
        ("pairs", 1 if options.pairs is None else options.pairs, 1),
        ("checks", options.checks, 0),
    ):
        if value < least:
            raise InputError(f"--{name}: must be {least} or more, is {value}; give a larger number")


def _plan(
    conditions: Sequence[str],
    sentences: Sequence[str],
    written: Sequence[StudyClip],
    options: StudyOptions,
) -> Study:
    seed = secrets.randbits(SEED_BITS) if options.seed is None else options.seed
    plan = draw_plan(
        conditions,
        sentences,
        real=options.real,
        participants=options.participants,
        pairs=options.pairs,
        checks=options.checks,
        rng=np.random.default_rng(seed),
    )
    key = {(clip.sentence, clip.condition): clip for clip in written}
    return Study(
        id=secrets.token_hex(8),
        seed=seed,
        conditions=tuple(conditions),
        real=options.real,
        introduction=options.introduction,
        clips=tuple(sorted(written, key=lambda clip: clip.name)),
        participants=tuple(_participant(pairs, key) for pairs in plan),
    )


def _participant(
    planned: Sequence[PlannedPair], key: Mapping[tuple[str, str | None], StudyClip]
) -> Participant:
    pairs = [Pair(key[p.sentence, p.left], key[p.sentence, p.right]) for p in planned]
    return Participant(secrets.token_urlsafe(24), tuple(pairs))
