import os
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from mmmgpu.aligner import _ATTEMPTS, align_speech
from mmmgpu.alignments import read_alignment
from mmmgpu.errors import InputError
from mmmgpu.phones import SIL
from mmmgpu.voices import say

TEXT = "She had your dark suit in greasy wash water all year."


@pytest.fixture(scope="module")
def speech():
    return say(TEXT)


def spoken(alignment):
    return [p for p in alignment.phones if p.label != SIL]


def test_words_and_phones_are_where_the_synthesiser_put_them(speech):
    found = align_speech(speech.samples, speech.rate, TEXT)
    assert found.duration == speech.alignment.duration
    assert [w.label for w in found.words] == TEXT.lower().strip(".").split()
    error = np.subtract([w[1:] for w in found.words], [w[1:] for w in speech.alignment.words])
    assert np.median(np.abs(error)) < 0.015
    assert np.abs(error).max() < 0.08
    assert abs(np.median(error)) < 0.004  # no bias: it would be -0.005 without the half window


def test_phones_cover_the_clip(speech):
    phones = align_speech(speech.samples, speech.rate, TEXT).phones
    assert (phones[0].start, phones[-1].end) == (0.0, speech.alignment.duration)
    assert all(a.end == b.start for a, b in pairwise(phones))


def test_silence_before_moves_everything_by_as_much(speech):
    early = align_speech(speech.samples, speech.rate, TEXT)
    rng = np.random.default_rng(0)
    quiet = rng.normal(0, 1e-4, speech.rate).astype(np.float32)
    late = align_speech(np.r_[quiet, speech.samples], speech.rate, TEXT)
    moved = [b.start - a.start for a, b in zip(spoken(early), spoken(late), strict=True)]
    assert np.median(moved) == pytest.approx(1.0, abs=0.011)


def test_loudness_and_rate_of_the_sound_hardly_matter(speech):
    from mmmgpu.sounds import resample

    want = spoken(align_speech(speech.samples, speech.rate, TEXT))
    other = resample(speech.samples * np.float32(0.01), speech.rate, 48_000)
    got = spoken(align_speech(other, 48_000, TEXT))
    errors = [a.start - b.start for a, b in zip(want, got, strict=True)]
    assert np.median(np.abs(errors)) <= 0.0101


def test_the_same_input_gives_the_same_alignment_whatever_came_before(speech):
    first = align_speech(speech.samples, speech.rate, TEXT)
    other = say("Good morning, glorbo!")
    align_speech(other.samples, other.rate, "Good morning glorbo")
    assert align_speech(speech.samples, speech.rate, TEXT) == first


def test_words_that_are_in_no_dictionary_are_aligned():
    text = "My friend glorbo has two zibbles now"
    speech = say(text)
    found = align_speech(speech.samples, speech.rate, text)
    assert [w.label for w in found.words] == text.lower().split()


def test_numbers_and_punctuation_are_said():
    speech = say("I have twenty one apples, don't I?")
    found = align_speech(speech.samples, speech.rate, "I have 21 apples \u2014 don\u2019t I?")
    assert [w.label for w in found.words] == ["i", "have", "twenty", "one", "apples", "don't", "i"]


@pytest.mark.parametrize(
    "transcript",
    [
        "Please call Stella and ask her to bring these things with her from the store",
        "My father measured the thick rope and we pushed it over the edge of the boat",
        "no",
    ],
)
def test_a_transcript_of_other_words_is_refused(speech, transcript):
    with pytest.raises(InputError, match=r"does not match the sound .* give the words"):
        align_speech(speech.samples, speech.rate, transcript)


def test_other_settings_are_tried_before_giving_up(speech, monkeypatch):
    import mmmgpu.aligner

    search, tried = mmmgpu.aligner._search, []

    def fails_twice(sound, words, pronunciations, attempt):
        tried.append(attempt)
        return search(sound, words, pronunciations, attempt) if len(tried) > 2 else []

    monkeypatch.setattr(mmmgpu.aligner, "_search", fails_twice)
    align_speech(speech.samples, speech.rate, TEXT)
    assert tuple(tried) == _ATTEMPTS[:3]


@pytest.mark.parametrize(
    ("samples", "rate", "transcript", "message"),
    [
        (np.zeros(16000), 16000, "hello", "the sound is silent"),
        (np.zeros(0), 16000, "hello", r"samples must be mono, shape \(N,\)"),
        (np.zeros((100, 2)), 16000, "hello", r"samples must be mono, shape \(N,\)"),
        (np.full(100, np.nan), 16000, "hello", "NaN or infinity"),
        (np.ones(100), 0, "hello", "rate must be > 0"),
        (np.ones(100), 16000, " ...", r"the transcript ' \.\.\.' has no words"),
        (np.ones(1), 48000, "hello", "the sound is silent or too short"),
        (np.ones(100), 16000, "hello", "does not match the sound"),
    ],
)
def test_what_cannot_be_aligned_is_an_input_error(samples, rate, transcript, message):
    with pytest.raises(InputError, match=message):
        align_speech(samples, rate, transcript)


def test_noise_is_not_speech():
    noise = np.random.default_rng(0).normal(0, 0.1, 48_000)
    with pytest.raises(InputError, match="does not match the sound"):
        align_speech(noise, 16_000, "bin blue at f three soon")


@pytest.fixture(scope="module")
def grid():
    folder = os.environ.get("MMMGPU_DATA")
    if not folder:
        pytest.skip("MMMGPU_DATA names no folder of real video")
    return Path(folder) / "grid-s1"


def real_clip(folder, name):
    from mmmgpu.sounds import read_sound

    samples, rate = read_sound(folder / f"{name}.mpg", rate=16_000)
    return samples, rate, (folder / f"{name}.txt").read_text()


@pytest.mark.real
def test_real_speech_agrees_with_other_aligners(grid):
    starts, words = [], []
    for clip in sorted(grid.glob("*.mpg"))[::12]:
        found = align_speech(*real_clip(grid, clip.stem))
        theirs = spoken(read_alignment(clip.with_suffix(".TextGrid")))
        assert [p.label for p in spoken(found)] == [p.label for p in theirs]
        starts += [a.start - b.start for a, b in zip(spoken(found), theirs, strict=True)]
        grid_words = read_alignment(clip.with_suffix(".align")).words
        words += [a.start - b.start for a, b in zip(found.words, grid_words, strict=True)]
    assert np.median(np.abs(starts)) <= 0.01
    assert np.percentile(np.abs(starts), 95) <= 0.04
    assert np.median(np.abs(words)) <= 0.03


@pytest.mark.real
def test_sentences_without_a_word_in_common_are_refused(grid):
    clips = [real_clip(grid, clip.stem) for clip in sorted(grid.glob("*.mpg"))[::4]]
    pairs = [
        (sound, other[2])
        for sound, other in zip(clips, clips[len(clips) // 2 :], strict=False)
        if not set(sound[2].split()) & set(other[2].split())
    ]
    assert len(pairs) >= 5
    for (samples, rate, _), transcript in pairs:
        with pytest.raises(InputError, match="does not match the sound"):
            align_speech(samples, rate, transcript)
