"""Text to speech with exact phone times, by espeak-ng in a process of its own (espeak_child)."""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mmmgpu import espeak_child
from mmmgpu.alignments import Alignment, Segment, cover, spread
from mmmgpu.errors import InputError
from mmmgpu.phones import from_ipa

RATES: Final = (80, 400)  # words a minute; from 450 on, espeak-ng's event times are wrong
WORD_EVENT: Final = 1
QUIET: Final = 16  # of 32768
SHORTEST_CLOSURE: Final = 0.005  # s


@dataclass(frozen=True)
class Speech:
    """Sound and what is said in it: samples float32 mono in [-1, 1], shape (N,), N / rate [s]."""

    samples: NDArray[np.float32]
    rate: int
    alignment: Alignment


class _Event(NamedTuple):
    """A phoneme of espeak-ng from `start` [samples] on; ipa "" is a pause."""

    ipa: str
    start: int
    word: tuple[int, int, int]  # number, start and end in the text [characters]


def is_installed() -> bool:
    """Return whether `say` and `transcribe` can be used."""
    return find_spec("espeakng_loader") is not None


def say(text: str, *, rate_wpm: int = 175, voice: str = "en-us") -> Speech:
    """Speak `text` with espeak-ng; the same text always gives the same samples (22050 Hz).

    Phones are those of CMUdict, in other languages the nearest of them; SIL covers the pauses, and
    the silence before the burst of a stop belongs to the stop.

    Args:
        text: Any length, in the language of `voice`.
        rate_wpm: Words a minute, 80 to 400.
        voice: A voice or language of espeak-ng.

    Raises:
        InputError: Nothing in `text` can be said, no such voice or rate, or no espeak-ng.
    """
    if not RATES[0] <= rate_wpm <= RATES[1]:
        raise InputError(f"rate_wpm must be {RATES[0]} to {RATES[1]}, got {rate_wpm}")
    text = "".join(c if c.isprintable() else " " for c in text)
    if not any(c.isalnum() for c in text):
        raise InputError(f"there is nothing to say in the text {text[:40]!r}; give some words")
    reply, data = _ask({"voice": voice, "rate": rate_wpm, "text": text})
    samples = np.frombuffer(data, np.int16)
    phones, words = _segments(_phoneme_events(reply["events"]), samples, reply["rate"], text)
    if not words:
        raise InputError(f"voice {voice!r} says nothing for the text {text[:40]!r}; try another")
    duration = len(samples) / reply["rate"]
    alignment = Alignment(cover(phones, duration), words, duration)
    return Speech(np.divide(samples, 32768, dtype=np.float32), reply["rate"], alignment)


def transcribe(word: str, *, voice: str = "en-us") -> tuple[str, ...]:
    """Return the phones with which espeak-ng says `word`; () if it says nothing."""
    reply, _ = _ask({"voice": voice, "words": [word]})
    return from_ipa(reply["ipa"][0])


def _ask(request: dict[str, Any]) -> tuple[dict[str, Any], bytes]:
    """Return the reply of a fresh espeak_child and the samples that follow it."""
    try:
        import espeakng_loader
    except ImportError as error:
        raise InputError("speech needs espeak-ng; run pip install 'mmmgpu[tts]'") from error
    request["library"] = os.path.abspath(espeakng_loader.get_library_path())
    child = subprocess.run(
        [sys.executable, "-I", "-S", os.path.abspath(espeak_child.__file__)],
        input=json.dumps(request).encode(),
        capture_output=True,
        cwd=Path(espeakng_loader.get_data_path()).parent,
        check=False,
    )
    head, _, samples = child.stdout.partition(b"\n")
    if child.returncode != 0 or not head:
        reason = child.stderr.decode(errors="replace").strip().splitlines() or ["no reason given"]
        raise InputError(f"espeak-ng failed ({reason[-1]}); reinstall 'mmmgpu[tts]'")
    reply = json.loads(head)
    if "error" in reply:
        raise InputError(f"espeak-ng {reply['error']}")
    return reply, samples


def _phoneme_events(events: Sequence[tuple[int, int, int, int, str]]) -> list[_Event]:
    """Return the phonemes among espeak's events, each with its word, in the order of time."""
    word = (0, 0, 0)
    phonemes = []
    for kind, sample, position, length, ipa in events:
        if kind == WORD_EVENT:
            word = (word[0] + 1, position - 1, position - 1 + length)
        elif kind == espeak_child.EVENT_PHONEME:
            phonemes.append(_Event(ipa, sample, word))
    return sorted(phonemes, key=lambda event: event.start)


def _segments(
    events: Sequence[_Event], samples: NDArray[np.int16], rate: int, text: str
) -> tuple[list[Segment], tuple[Segment, ...]]:
    """Return phones and words [s]; phones may leave gaps, which are pauses."""
    phones: list[Segment] = []
    words: dict[tuple[int, int, int], Segment] = {}
    starts = [_onset(events, i, samples, rate) for i in range(len(events))] + [len(samples)]
    for event, start, end in zip(events, starts, starts[1:], strict=False):
        if start >= end or _is_pause(event, samples[start:end]):
            continue
        labels = from_ipa(event.ipa)
        if labels:
            said = spread(labels, start / rate, end / rate)
        elif phones:  # such as a glottal stop: does not show
            said = [phones.pop()._replace(end=end / rate)]
        else:
            continue
        phones += said
        first = words.get(event.word, said[0])
        label = text[event.word[1] : event.word[2]]
        words[event.word] = Segment(label, first.start, said[-1].end)
    return phones, tuple(words.values())


def _is_pause(event: _Event, samples: NDArray[np.int16]) -> bool:
    return not event.ipa and not _loud(samples).size


def _loud(samples: NDArray[np.int16]) -> NDArray[np.intp]:
    return np.flatnonzero(np.abs(samples) > QUIET)


def _onset(events: Sequence[_Event], i: int, samples: NDArray[np.int16], rate: int) -> int:
    """Return the sample at which phoneme i begins, with the closure before the burst of a stop.

    espeak-ng puts the closure, which it renders as silence, at the end of the phoneme before.
    """
    start = events[i].start
    if i == 0 or not from_ipa(events[i].ipa) or not from_ipa(events[i - 1].ipa):
        return start
    loud = _loud(samples[events[i - 1].start : start])
    if not loud.size:
        return start
    onset = events[i - 1].start + int(loud[-1]) + 1
    return onset if start - onset > SHORTEST_CLOSURE * rate else start
