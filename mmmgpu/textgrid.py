"""Praat TextGrid text files as interval tiers; what the tiers mean is the business of alignments.

The long and the short format are one grammar: like Praat itself, read only free-standing numbers,
quoted strings and <flags>, and skip all else. See "TextGrid file formats" in the Praat manual.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from mmmgpu.errors import InputError

_TOKEN = re.compile(r'"(?:[^"]|"")*"|"|!.*|[^\s"]+')


class Row(NamedTuple):
    """One labelled interval [s] and the line of the file it was read from (from 1)."""

    label: str
    start: float
    end: float
    line: int


class Tier(NamedTuple):
    """One interval tier."""

    name: str
    rows: list[Row]


def parse_textgrid(text: str, path: Path) -> tuple[float, list[Tier]]:
    """Return the end time [s] and the interval tiers of `text`; `path` is for messages only.

    Point tiers are passed over. Times are not checked here beyond being numbers.
    """
    values = _Values(text, path)
    if values.string("the file type") != "ooTextFile" or values.string("TextGrid") != "TextGrid":
        raise InputError(f"{path}: is not a Praat TextGrid text file; save it as text from Praat")
    values.number("xmin")
    duration = values.number("xmax")
    values.string("<exists>")
    n_tiers = values.count("the number of tiers")
    tiers = [_parse_tier(values) for _ in range(n_tiers)]
    return duration, [tier for tier in tiers if tier is not None]


def _parse_tier(values: "_Values") -> Tier | None:
    kind = values.string("the class of a tier")
    name = values.string("the name of a tier")
    values.number("xmin")
    values.number("xmax")
    n = values.count("the number of intervals")
    if kind != "IntervalTier":
        for _ in range(n):
            values.number("time")
            values.string("mark")
        return None
    rows = []
    for _ in range(n):
        start, end = values.number("xmin"), values.number("xmax")
        rows.append(Row(values.string("text"), start, end, values.line))
    return Tier(name, rows)


def format_textgrid(tiers: Sequence[tuple[str, Sequence[tuple[str, float, float]]]]) -> str:
    """Return tiers of (name, contiguous (label, start, end) [s]) as a long TextGrid.

    Times are written in full, so that reading them back gives the same numbers. All tiers must
    begin and end at the same times.
    """
    xmin, xmax = _time(tiers[0][1][0][1]), _time(tiers[0][1][-1][2])
    lines = ['File type = "ooTextFile"', 'Object class = "TextGrid"', ""]
    lines += [f"xmin = {xmin}", f"xmax = {xmax}", "tiers? <exists>", f"size = {len(tiers)}"]
    lines += ["item []:"]
    for i, (name, rows) in enumerate(tiers, 1):
        lines += [f"    item [{i}]:", '        class = "IntervalTier"']
        lines += [f"        name = {_quoted(name)}", f"        xmin = {xmin}"]
        lines += [f"        xmax = {xmax}", f"        intervals: size = {len(rows)}"]
        for j, (label, start, end) in enumerate(rows, 1):
            lines += [f"        intervals [{j}]:", f"            xmin = {_time(start)}"]
            lines += [f"            xmax = {_time(end)}", f"            text = {_quoted(label)}"]
    return "\n".join(lines) + "\n"


def _time(seconds: float) -> str:
    return repr(float(seconds))


def _quoted(label: str) -> str:
    return '"' + label.replace('"', '""') + '"'


class _Values:
    """The values of a TextGrid in order; `line` is that of the value last taken."""

    def __init__(self, text: str, path: Path):
        self._tokens = _values_with_lines(text)
        self._path = path
        self.line = 1

    def _take(self, what: str) -> str | float:
        taken = next(self._tokens, None)
        if taken is None:
            raise InputError(f"{self._path}:{self.line}: truncated, ends before {what}; remake it")
        self.line, value = taken
        return value

    def number(self, what: str) -> float:
        value = self._take(what)
        if isinstance(value, str):
            raise self._unexpected(value, f"a number ({what})")
        return value

    def string(self, what: str) -> str:
        value = self._take(what)
        if not isinstance(value, str):
            raise self._unexpected(value, f"a quoted text ({what})")
        return value

    def count(self, what: str) -> int:
        value = self.number(what)
        if not (value >= 0 and value.is_integer()):
            raise self._unexpected(value, f"a whole number ({what})")
        return int(value)

    def _unexpected(self, value: str | float, wanted: str) -> InputError:
        return InputError(
            f"{self._path}:{self.line}: expected {wanted}, found {str(value)[:40]!r}; "
            "save the TextGrid again from Praat"
        )


def _values_with_lines(text: str) -> Iterator[tuple[int, str | float]]:
    line, counted = 1, 0
    for match in _TOKEN.finditer(text):
        line += text.count("\n", counted, match.start())
        counted = match.start()
        token = match.group()
        if len(token) > 1 and token[0] == token[-1] == '"':
            yield line, token[1:-1].replace('""', '"')
        elif token.startswith("<") and token.endswith(">"):
            yield line, token
        else:
            try:
                yield line, float(token)
            except ValueError:
                continue
