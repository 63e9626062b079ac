"""What is said when: phones and words of one clip, read from and written to files.

Formats: Praat TextGrid (interval tiers "phones" and "words"; those of the Montreal Forced Aligner
too), GRID `.align` (words only, in units of 1/25000 s) and HTK `.lab`. Making an alignment from
sound is the business of aligner; from text, of voices.
"""

import math
import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from mmmgpu.errors import InputError
from mmmgpu.files import write_text
from mmmgpu.phones import SIL, VOWELS, normalise_label
from mmmgpu.textgrid import Row, Tier, format_textgrid, parse_textgrid

SUFFIXES = (".TextGrid", ".textgrid", ".align", ".lab")  # in order of preference
GRID_RATE = 25_000  # units a second
HTK_RATE = 10_000_000
SNAP = 1e-4  # s; smaller gaps and overlaps are rounding of the writer


class Segment(NamedTuple):
    """What is said from `start` to `end` [s]."""

    label: str
    start: float
    end: float


@dataclass(frozen=True)
class Alignment:
    """Phones and words of one clip, in order and without overlap, within [0, duration] [s].

    Phones from this package's readers and makers cover the whole clip, SIL where nothing is said;
    words leave gaps there.
    """

    phones: tuple[Segment, ...]
    words: tuple[Segment, ...]
    duration: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.duration) and self.duration > 0):
            raise InputError(f"alignment: the duration must be > 0 s, got {self.duration}")
        for name, segments in (("phone", self.phones), ("word", self.words)):
            fault = _fault(segments, self.duration)
            if fault:
                raise InputError(f"alignment: {name} {fault[0] + 1} {fault[1]}; correct the times")


def cover(segments: Iterable[Segment], duration: float) -> tuple[Segment, ...]:
    """Return ordered `segments` with SIL in the gaps of [0, duration] [s] and SILs joined."""
    covered: list[Segment] = []

    def append(label: str, start: float, end: float) -> None:
        if covered and covered[-1].label == label == SIL:
            start = covered.pop().start
        covered.append(Segment(label, start, end))

    now = 0.0
    for label, start, end in segments:
        if start > now:
            append(SIL, now, start)
        append(label, start, end)
        now = end
    if now < duration:
        append(SIL, now, duration)
    return tuple(covered)


def spread(labels: Sequence[str], start: float, end: float) -> list[Segment]:
    """Return `labels` spread over [start, end] [s], a vowel as long as two consonants."""
    shares = [2 if label in VOWELS else 1 for label in labels]
    parts = [sum(shares[:i]) / sum(shares) for i in range(len(labels))]
    times = [*(start + part * (end - start) for part in parts), end]
    return [Segment(label, *time) for label, time in zip(labels, pairwise(times), strict=True)]


def read_alignment(path: str | os.PathLike[str]) -> Alignment:
    """Read the alignment in `path`; the suffix (.TextGrid, .align or .lab) says the format.

    Silent labels become SIL, stress digits go, all other labels are kept as they are; gaps are
    filled with SIL. A `.align` holds words only: their phones come from the pronunciation
    dictionary, a vowel as long as two consonants (one-letter words are letters, as in GRID); where
    the sound is at hand, `aligner.align_speech` is better. A `.lab` holds phones, and may hold the
    word that begins with a phone in its last column; whole numbers are units of 100 ns, numbers
    with a decimal point are seconds.

    Raises:
        InputError: The file cannot be read, or what it says is no alignment; names path and line.
    """
    path = Path(path)
    readers = {".textgrid": _from_textgrid, ".align": _from_grid, ".lab": _from_htk}
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: is no alignment; give one of {', '.join(SUFFIXES)}")
    duration, phones, words = readers[path.suffix.lower()](_read_text(path), path)
    phone_segments = _checked(phones, duration, path)
    word_segments = _checked(words, duration, path)
    if not (math.isfinite(duration) and duration > 0):
        raise InputError(f"{path}: the end time must be > 0 s, got {duration}; correct it")
    return Alignment(cover(phone_segments, duration), tuple(word_segments), duration)


def write_textgrid(alignment: Alignment, path: str | os.PathLike[str]) -> None:
    """Write `alignment` to `path` as a TextGrid (tiers "words" and "phones"), whole or not at all.

    Raises:
        InputError: The file cannot be written.
    """
    words = cover(alignment.words, alignment.duration)
    blank = [(label if label != SIL else "", start, end) for label, start, end in words]
    phones = cover(alignment.phones, alignment.duration)
    text = format_textgrid([("words", blank), ("phones", phones)])
    write_text(path, text)


def find_alignment(place: str | os.PathLike[str], clip: str | os.PathLike[str]) -> Path:
    """Return the alignment of `clip` in the folder `place`; if `place` is a file, that file.

    Raises:
        InputError: There is none; says which names were looked for.
    """
    place, stem = Path(place), Path(clip).stem
    if place.is_file():
        return place
    if not place.is_dir():
        raise InputError(f"{place}: no such file or folder; give the folder of the alignments")
    candidates = [place / (stem + suffix) for suffix in SUFFIXES]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    names = ", ".join(c.name for c in candidates)
    raise InputError(f"{place}: holds no alignment of {clip} (none of {names}); run mmmgpu align")


def check_against(
    alignment: Alignment,
    duration: float,
    path: str | os.PathLike[str],
    *,
    tolerance: float = 0.1,
) -> None:
    """Raise InputError if speech in the alignment read from `path` ends after the clip [s]."""
    spoken = [s.end for s in (*alignment.phones, *alignment.words) if s.label != SIL]
    end = max(spoken, default=0.0)
    if end > duration + tolerance:
        raise InputError(
            f"{path}: ends at {end:.2f} s but the clip ends at {duration:.2f} s; "
            "give the alignment of this clip"
        )


def shift(alignment: Alignment, seconds: float) -> Alignment:
    """Return `alignment` moved later by `seconds` (negative: earlier), cut to the same duration."""
    if not math.isfinite(seconds):
        raise InputError(f"the shift must be a finite number of seconds, got {seconds}")

    def moved(segments: Iterable[Segment]) -> Iterator[Segment]:
        for label, start, end in segments:
            start, end = max(start + seconds, 0.0), min(end + seconds, alignment.duration)
            if start < end:
                yield Segment(label, start, end)

    duration = alignment.duration
    return Alignment(
        cover(moved(alignment.phones), duration), tuple(moved(alignment.words)), duration
    )


def frame_labels(alignment: Alignment, n_frames: int, fps: float) -> list[str]:
    """Return the label that fills most of each frame [t, t + 1) / fps; SIL after the end.

    Of labels that fill a frame equally, the one heard first.
    """
    if n_frames < 0 or not (math.isfinite(fps) and fps > 0):
        raise InputError(f"need n_frames >= 0 and fps > 0, got {n_frames} and {fps}")
    seconds_of: list[dict[str, float]] = [defaultdict(float) for _ in range(n_frames)]
    end_of_all = max(alignment.duration, n_frames / fps)
    for label, start, end in cover(alignment.phones, end_of_all):
        for t in range(math.floor(start * fps), min(math.ceil(end * fps), n_frames)):
            shared = min(end, (t + 1) / fps) - max(start, t / fps)
            seconds_of[t][label] += round(shared, 9)  # equal shares stay equal
    return [max(seconds, key=seconds.__getitem__) for seconds in seconds_of]


def _fault(segments: Sequence[Segment | Row], duration: float) -> tuple[int, str] | None:
    """Return the index of the first bad segment and what is wrong with it."""
    now = 0.0
    for i, segment in enumerate(segments):
        start, end = segment.start, segment.end
        said = f"({segment.label!r}, {start:g} to {end:g} s)"
        if not (math.isfinite(start) and math.isfinite(end)):
            return i, f"{said} has a time that is no finite number"
        if start >= end:
            return i, f"{said} ends before it starts" if start > end else f"{said} has no length"
        if start < now:
            return i, f"{said} overlaps what comes before" if i else f"{said} starts before 0 s"
        if end > duration:
            return i, f"{said} ends after the end of the alignment ({duration:g} s)"
        now = end
    return None


def _checked(rows: Sequence[Row], duration: float, path: Path) -> list[Segment]:
    """Return `rows` as segments, rounding of less than `SNAP` undone; raise on what is wrong."""
    snapped: list[Row] = []
    now = 0.0
    for row in rows:
        start = now if abs(row.start - now) <= SNAP else row.start
        end = duration if abs(row.end - duration) <= SNAP else row.end
        if row.start < row.end and not start < end:
            continue  # shorter than the rounding
        snapped.append(row._replace(start=start, end=end))
        now = end
    fault = _fault(snapped, duration)
    if fault:
        raise InputError(f"{path}:{snapped[fault[0]].line}: {fault[1]}; correct the times")
    return [Segment(row.label, row.start, row.end) for row in snapped]


def _read_text(path: Path) -> str:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    if not data.strip():
        raise InputError(f"{path}: is empty; make the alignment again")
    utf16 = data[:2] in (b"\xff\xfe", b"\xfe\xff")
    try:
        text = data.decode("utf-16" if utf16 else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text in UTF-8 or UTF-16; convert it") from error
    if "\0" in text:
        raise InputError(f"{path}: is not a text file; give an alignment saved as text")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _from_textgrid(text: str, path: Path) -> tuple[float, list[Row], list[Row]]:
    duration, tiers = parse_textgrid(text, path)
    phones = _tier(tiers, ("phones", "phone", "phonemes"), path)
    words = _tier(tiers, ("words", "word"), path)
    if phones is None:
        names = ", ".join(repr(tier.name) for tier in tiers) or "none"
        raise InputError(f"{path}: has no interval tier named 'phones' (it has {names}); rename it")
    return duration, _labelled(phones.rows), _spoken(words.rows if words else [])


def _tier(tiers: Sequence[Tier], names: tuple[str, ...], path: Path) -> Tier | None:
    """Return the tier with one of `names`, after a speaker's name and a dash or not."""
    found = [t for t in tiers if t.name.lower().split(" - ")[-1].strip() in names]
    if len(found) > 1:
        raise InputError(f"{path}: has {len(found)} tiers named {names[0]!r}; keep the speaker's")
    return found[0] if found else None


def _from_grid(text: str, path: Path) -> tuple[float, list[Row], list[Row]]:
    rows = [
        Row(label, start / GRID_RATE, end / GRID_RATE, line)
        for line, start, end, (label, *_), _ in _columns(text, path)
    ]
    words = _spoken(rows)
    return max(row.end for row in rows), [p for word in words for p in _spoken_phones(word)], words


def _spoken_phones(word: Row) -> Iterator[Row]:
    from mmmgpu.pronunciation import letter_name, pronounce

    is_letter = len(word.label) == 1 and word.label.isalpha()
    labels = letter_name(word.label) if is_letter else pronounce(word.label)
    if not word.start < word.end:
        yield word  # to be reported with its line
        return
    for segment in spread(labels, word.start, word.end):
        yield Row(*segment, word.line)


def _from_htk(text: str, path: Path) -> tuple[float, list[Row], list[Row]]:
    columns = _columns(text, path)
    rate = HTK_RATE if all(whole for *_, whole in columns) else 1.0
    rows = [
        Row(_centre(labels[0]), start / rate, end / rate, line)
        for line, start, end, labels, _ in columns
    ]
    begun = [i for i, c in enumerate(columns) if len(c[3]) > 1 and not _is_number(c[3][-1])]
    words = [
        Row(columns[i][3][-1], rows[i].start, rows[j - 1].end, rows[i].line)
        for i, j in pairwise([*begun, len(rows)])
    ]
    return max(row.end for row in rows), _labelled(rows), _spoken(words)


def _centre(label: str) -> str:
    """Return b of a-b+c, x^a-b+c=y/A:..., a-b or b+c; other labels as they are."""
    match = re.fullmatch(r"(?:[^-+]+-)?([^-+]+)(?:\+.+)?", label)
    return match.group(1) if match else label


def _columns(text: str, path: Path) -> list[tuple[int, float, float, list[str], bool]]:
    """Return (line, start, end, the columns after them, both times are whole numbers), not none."""
    columns = []
    for line, content in enumerate(text.split("\n"), 1):
        parts = content.split()
        if not parts or content.startswith("#"):
            continue
        if len(parts) < 3 or not (_is_number(parts[0]) and _is_number(parts[1])):
            raise InputError(
                f"{path}:{line}: expected 'start end label', found {content[:40]!r}; correct it"
            )
        whole = parts[0].isdecimal() and parts[1].isdecimal()
        columns.append((line, float(parts[0]), float(parts[1]), parts[2:], whole))
    if not columns:
        raise InputError(f"{path}: holds no segments; make the alignment again")
    return columns


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _labelled(rows: Iterable[Row]) -> list[Row]:
    return [row._replace(label=normalise_label(row.label)) for row in rows]


def _spoken(rows: Iterable[Row]) -> list[Row]:
    """Return the words of `rows` without the silences."""
    return [row for row in rows if normalise_label(row.label) != SIL]
