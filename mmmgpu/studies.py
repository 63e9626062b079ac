"""A forced-choice study: who is shown which clips, and the folder that holds it.

Participants see two clips of one sentence, made under different conditions, and choose the real one
(Englebienne, Cootes & Rattray, NIPS 2007, section 4). A study folder holds `study.json`, the plan
with the key to what each clip is, and `clips/`, under names that mean nothing. The answers are kept
by `mmmgpu.study_store`; `mmmgpu.study_creation` makes the folder. The schema is in docs/study.md.
"""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mmmgpu.errors import InputError
from mmmgpu.files import write_json

Place = str | os.PathLike[str]

FORMAT, VERSION = "mmmgpu-study", 1
PLAN, CLIPS = "study.json", "clips"  # in the folder
LEFT, UNDECIDED, RIGHT = CHOICES = ("left", "undecided", "right")
SIDES = (LEFT, RIGHT)
_REMEDY = "create the study again: mmmgpu study create"


@dataclass(frozen=True)
class StudyClip:
    """One clip of a study.

    name: its file is `clips/NAME.mp4`.
    condition: how it was made; None: its picture is frozen, to see whether people pay attention.
    """

    name: str
    sentence: str
    condition: str | None


@dataclass(frozen=True)
class Pair:
    """Two clips of one sentence, shown side by side."""

    left: StudyClip
    right: StudyClip

    @property
    def is_check(self) -> bool:
        """Whether it only shows if the participant pays attention."""
        return self.left.condition is None or self.right.condition is None

    def chosen(self, choice: str) -> StudyClip | None:
        """The clip that `choice`, one of CHOICES, takes for real; None: undecided."""
        return {LEFT: self.left, RIGHT: self.right}.get(choice)


@dataclass(frozen=True)
class Participant:
    """One person, who answers `pairs` in their order, at the address that holds `token`."""

    token: str
    pairs: tuple[Pair, ...]


@dataclass(frozen=True)
class Study:
    """The plan of a study.

    id: random; answers belong to the study of this id.
    seed: of the random numbers that the plan was drawn with.
    conditions: sorted; `real` is the one of them that attention checks are made from.
    introduction: what participants read first.
    """

    id: str
    seed: int
    conditions: tuple[str, ...]
    real: str
    introduction: str
    clips: tuple[StudyClip, ...]
    participants: tuple[Participant, ...]


def clip_path(folder: Place, clip: StudyClip) -> Path:
    """The file of `clip` in a study folder."""
    return Path(folder) / CLIPS / f"{clip.name}.mp4"


def write_study(folder: Place, study: Study) -> None:
    """Write the plan into a study folder."""
    clips = {c.name: {"condition": c.condition, "sentence": c.sentence} for c in study.clips}
    participants = [
        {"token": p.token, "pairs": [[pair.left.name, pair.right.name] for pair in p.pairs]}
        for p in study.participants
    ]
    values = {
        "format": FORMAT,
        "version": VERSION,
        "id": study.id,
        "seed": study.seed,
        "conditions": list(study.conditions),
        "real": study.real,
        "introduction": study.introduction,
        "clips": clips,
        "participants": participants,
    }
    write_json(Path(folder) / PLAN, values)


def read_study(folder: Place) -> Study:
    """Read the plan of a study folder.

    Raises:
        InputError: It is no study folder, its plan is damaged or newer, or a clip is missing.
    """
    path = Path(folder) / PLAN
    values = _load(path)
    study = _parse(values, path)
    for clip in study.clips:
        if not clip_path(folder, clip).is_file():
            raise InputError(f"{clip_path(folder, clip)}: the clip is missing; {_REMEDY}")
    return study


def _load(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); give a folder of mmmgpu study create"
        ) from error
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: is not JSON ({reason}); {_REMEDY}") from error
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        raise InputError(f"{path}: is no plan of a study ({FORMAT}); {_REMEDY}")
    version = values.get("version")
    if type(version) is not int or version < 1:
        raise InputError(f"{path}: version must be {VERSION}, is {version!r}; {_REMEDY}")
    if version > VERSION:
        raise InputError(
            f"{path}: is of version {version}, newer than this mmmgpu reads ({VERSION}); "
            "update mmmgpu"
        )
    return values


def _parse(values: Mapping[str, Any], path: Path) -> Study:
    """The study that `values` describe; whatever does not fit is one InputError."""
    try:
        study = _study(values)
        _check(study)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise InputError(f"{path}: does not hold a whole study ({reason}); {_REMEDY}") from error
    return study


def _study(values: Mapping[str, Any]) -> Study:
    clips = {
        _word(name): StudyClip(_word(name), str(about["sentence"]), about["condition"])
        for name, about in values["clips"].items()
    }
    participants = tuple(
        Participant(
            _word(p["token"]), tuple(Pair(clips[left], clips[right]) for left, right in p["pairs"])
        )
        for p in values["participants"]
    )
    return Study(
        id=_word(values["id"]),
        seed=int(values["seed"]),
        conditions=tuple(map(str, values["conditions"])),
        real=str(values["real"]),
        introduction=str(values["introduction"]),
        clips=tuple(clips.values()),
        participants=participants,
    )


def _word(text: str) -> str:
    """A name or token; none that could be a path."""
    if not text or not text.isascii() or not text.replace("-", "").replace("_", "").isalnum():
        raise ValueError(f"{text!r} is no name")
    return text


def _check(study: Study) -> None:
    """ValueError, unless all that the plan names belongs together."""
    known = {*study.conditions, None}
    pairs = [pair for p in study.participants for pair in p.pairs]
    tokens = {p.token for p in study.participants}
    if study.real not in study.conditions or any(c.condition not in known for c in study.clips):
        raise ValueError("a condition is not among conditions")
    if len(tokens) < len(study.participants):
        raise ValueError("two participants have one token")
    if any(p.left.condition == p.right.condition for p in pairs):
        raise ValueError("a pair has one condition on both sides")
    if any(p.left.sentence != p.right.sentence for p in pairs):
        raise ValueError("a pair has two sentences")
