"""Forced alignment: when each phone of a known English transcript is said, by pocketsphinx.

Two passes: the words of the transcript through the sound, then the phones of the words found. The
acoustic model is that of pocketsphinx's wheel; nothing is trained or downloaded.
"""

import re
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mmmgpu.alignments import Alignment, Segment, cover
from mmmgpu.errors import InputError
from mmmgpu.phones import SIL, normalise_label
from mmmgpu.pronunciation import dictionary, pronounce, spoken_words

MODEL_RATE: Final = 16_000  # Hz
FRAME: Final = 0.01  # s, between frames of the acoustic model
WINDOW: Final = 0.025625  # s, of sound that a frame sees
POOREST_SCORE: Final = -36.0  # a frame of speech, see align_speech
LEAST_SHARE: Final = 0.5  # of the sound's energy above low frequencies, within the words


class _Attempt(NamedTuple):
    """Quiet noise before and after the sound, and how many hypotheses the search keeps."""

    padding: float  # s
    noise: float  # deviation, of full scale
    beam: float


# About 1 clip in 15 fails without padding; what fails once mostly works with another.
_ATTEMPTS: Final = (
    _Attempt(0.25, 3e-4, 1e-48),
    _Attempt(0.40, 1e-3, 1e-64),
    _Attempt(0.15, 1e-4, 1e-80),
    _Attempt(0.50, 3e-3, 1e-120),
)


class _Phone(NamedTuple):
    """A phone in the frames of the acoustic model; score is log likelihood, summed over frames."""

    label: str
    start: int
    n_frames: int
    score: float


class _Word(NamedTuple):
    label: str
    phones: list[_Phone]


def align_speech(samples: ArrayLike, rate: int, transcript: str) -> Alignment:
    """Return when the words and phones of `transcript` are said in `samples`.

    Words that CMUdict does not have get a pronunciation (see pronunciation). The same input gives
    the same alignment. Boundaries lie halfway between the centres of two frames, 10 ms apart.

    A transcript of other words is told by one of three things: the search finds no way through the
    sound; the mean score of a frame of speech (log likelihood less that of the best state in the
    search) is below `POOREST_SCORE`; or the words hold less than `LEAST_SHARE` of the energy of the
    sound's derivative. A transcript with half its words right may pass.

    Args:
        samples: Sound, mono, shape (N,), in [-1, 1].
        rate: Samples a second.
        transcript: What is said, English, with or without punctuation.

    Raises:
        InputError: No sound, no words, a transcript that does not fit, or no pocketsphinx.
    """
    from mmmgpu.sounds import checked_speech, levelled

    sound = checked_speech(samples, rate)
    words = spoken_words(transcript)
    if not words:
        raise InputError(f"the transcript {transcript[:40]!r} has no words; give what is said")
    pronunciations = {word: pronounce(word) for word in words if word not in dictionary()}
    duration = len(sound) / rate
    at_model_rate = levelled(sound, rate, MODEL_RATE)
    for attempt in _ATTEMPTS:
        found = _search(at_model_rate, words, pronunciations, attempt)
        if found and _mean_score(found) >= POOREST_SCORE:
            alignment = _alignment(found, attempt.padding, duration)
            if _share_in_words(alignment, sound, rate) >= LEAST_SHARE:
                return alignment
    raise InputError(
        f"the transcript {transcript[:40]!r} does not match the sound ({duration:.1f} s); "
        "give the words that are said in this clip"
    )


def _search(
    sound: NDArray[np.float64],
    words: list[str],
    pronunciations: dict[str, tuple[str, ...]],
    attempt: _Attempt,
) -> list[_Word]:
    """Return the words and fillers of both passes; [] if the search finds no way through."""
    rng = np.random.default_rng(0)
    n = round(attempt.padding * MODEL_RATE)
    padded = np.pad(sound, n) + rng.normal(0.0, attempt.noise, len(sound) + 2 * n)
    padded[n : n + len(sound)] = sound
    pcm = np.round(np.clip(padded, -1, 1) * 32767).astype("<i2").tobytes()
    decoder = _decoder(attempt.beam)
    for word, phones in pronunciations.items():
        if decoder.lookup_word(word) is None:
            decoder.add_word(word, " ".join(phones))
    decoder.set_align_text(" ".join(words))
    try:
        _decode(decoder, pcm)
        if decoder.hyp() is None:
            return []
        decoder.set_alignment()
        _decode(decoder, pcm)
    except RuntimeError:  # the end of the words or of their phones was not reached
        return []
    return [
        _Word(word.name, [_Phone(p.name, p.start, p.duration, p.score) for p in word])
        for word in decoder.get_alignment() or ()
    ]


@lru_cache(maxsize=len(_ATTEMPTS))
def _decoder(beam: float) -> Any:
    """Return a decoder; loading its dictionary takes longer than aligning a clip.

    The beam between words stays at its default: wider ones keep the search from ending.
    """
    import pocketsphinx

    return pocketsphinx.Decoder(
        lm=None, loglevel="FATAL", beam=beam, pbeam=beam, samprate=MODEL_RATE
    )


def _decode(decoder: Any, pcm: bytes) -> None:
    decoder.start_utt()
    decoder.process_raw(pcm, full_utt=True)
    decoder.end_utt()


def _is_filler(word: _Word) -> bool:
    return word.label[0] in "<[+" or normalise_label(word.label) == SIL


def _mean_score(words: list[_Word]) -> float:
    """Return the mean score of a frame in which a word is said."""
    said = [phone for word in words if not _is_filler(word) for phone in word.phones]
    n_frames = sum(phone.n_frames for phone in said)
    return sum(phone.score for phone in said) / n_frames if n_frames else -np.inf


def _alignment(words: list[_Word], padding: float, duration: float) -> Alignment:
    """Return `words` in the time of the sound without padding."""
    first = (WINDOW - FRAME) / 2 - padding  # halfway between the centres of frames -1 and 0

    def segment(label: str, phones: list[_Phone]) -> Segment:
        start = first + phones[0].start * FRAME
        end = first + (phones[-1].start + phones[-1].n_frames) * FRAME
        return Segment(label, max(round(start, 4), 0.0), min(round(end, 4), duration))

    said = [word for word in words if not _is_filler(word)]
    phones = [segment(normalise_label(p.label), [p]) for word in said for p in word.phones]
    spoken = [segment(re.sub(r"\(\d+\)$", "", word.label), word.phones) for word in said]
    inside = [s for s in phones if s.start < s.end]
    return Alignment(cover(inside, duration), tuple(s for s in spoken if s.start < s.end), duration)


def _share_in_words(alignment: Alignment, sound: NDArray[np.float64], rate: int) -> float:
    """Return the share of the energy of the sound's derivative that lies within words."""
    energy = np.diff(sound, prepend=sound[0]) ** 2
    within = sum(energy[int(w.start * rate) : int(w.end * rate)].sum() for w in alignment.words)
    return float(within / energy.sum())
