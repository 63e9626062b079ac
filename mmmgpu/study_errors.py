"""Error measures of the clips of a study, to be put beside what people chose.

They come from `compare.json`, as `mmmgpu compare` writes it, whose `sentences` hold a value for
each sentence, condition and metric; or from any CSV file with the columns condition, sentence,
metric and value. Whether people agree with a measure is counted answer by answer: did they take the
clip with the lower value for real?
"""

import csv
import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mmmgpu.errors import InputError
from mmmgpu.studies import StudyClip
from mmmgpu.study_statistics import Shares, exact_shares

COLUMNS = ("condition", "sentence", "metric", "value")
Errors = Mapping[str, Mapping[tuple[str, str], float]]  # metric -> (condition, sentence) -> value
Decided = tuple[StudyClip, StudyClip]  # the clip that was chosen, and the other one


def read_errors(path: str | os.PathLike[str]) -> Errors:
    """Read a table of error measures.

    Raises:
        InputError: It cannot be read, lacks a column, has a value that is no finite number, or two
            for one clip.
    """
    errors: dict[str, dict[tuple[str, str], float]] = {}
    for number, row in enumerate(_rows(Path(path)), start=1):
        where = f"{path}: row {number}"
        values = [row.get(name) for name in COLUMNS]
        if any(value is None for value in values):
            raise InputError(f"{where}: must have {', '.join(COLUMNS)}; add what is missing")
        condition, sentence, metric = (str(value) for value in values[:3])
        clips = errors.setdefault(metric, {})
        if (condition, sentence) in clips:
            raise InputError(
                f"{where}: a second {metric} of '{sentence}' by '{condition}'; keep one of them"
            )
        clips[condition, sentence] = _number(values[3], where)
    return errors


def _rows(path: Path) -> Iterable[Mapping[str, Any]]:
    try:
        text = path.read_text("utf-8-sig")
        if path.suffix.lower() != ".json":
            return list(csv.DictReader(text.splitlines()))
        values = json.loads(text)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except (ValueError, RecursionError, csv.Error) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: is no table of errors ({reason}); correct it") from error
    try:
        return list(_compared(values["sentences"]))
    except (AttributeError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: has no values by sentence, condition and metric; give the file that "
            "mmmgpu compare wrote"
        ) from error


def _compared(sentences: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """A row for each value; null stands where a metric is not defined."""
    for sentence, conditions in sentences.items():
        for condition, metrics in conditions.items():
            for metric, value in metrics.items():
                if value is not None:
                    yield dict(zip(COLUMNS, (condition, sentence, metric, value), strict=True))


def _number(value: Any, where: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"{where}: value must be a finite number, is {value!r}; correct it")
    return number


def require_errors(errors: Errors, clips: Sequence[StudyClip], path: str) -> None:
    """Make sure that `errors`, read from `path`, hold something about `clips`.

    Raises:
        InputError: Not one of the clips is in it.
    """
    known = {key for values in errors.values() for key in values}
    if not any((clip.condition, clip.sentence) in known for clip in clips):
        raise InputError(
            f"{path}: has none of the study's conditions and sentences; give the table of the "
            "clips that the study was made from"
        )


def mean_errors(
    errors: Errors, conditions: Sequence[str], sentences: Sequence[str]
) -> dict[str, dict[str, float | None]]:
    """Of each metric the mean over `sentences`, by condition; None where there are no values."""
    means: dict[str, dict[str, float | None]] = {}
    for metric, values in errors.items():
        means[metric] = {}
        for condition in conditions:
            found = [values[condition, s] for s in sentences if (condition, s) in values]
            means[metric][condition] = math.fsum(found) / len(found) if found else None
    return means


def agreement(errors: Errors, decided: Sequence[Decided]) -> dict[str, Shares]:
    """Of each metric, how often the clip with the lower, and the higher, value was chosen.

    Pairs of which one value is missing, or both are equal, do not count.
    """
    found = {}
    for metric, values in errors.items():
        pairs = [[values.get((str(c.condition), c.sentence)) for c in pair] for pair in decided]
        known = [(a, b) for a, b in pairs if a is not None and b is not None]
        found[metric] = exact_shares(sum(a < b for a, b in known), sum(a > b for a, b in known))
    return found
