import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
import pytest

from mmmgpu.errors import InputError
from mmmgpu.phones import CMU_PHONES, SIL, VOWELS
from mmmgpu.voices import _Event, _onset, say, transcribe

SENTENCE = "Please put a big cup of tea, Bob, by the happy zebra. Thank you!"


@pytest.fixture(scope="module")
def speech():
    return say(SENTENCE)


def energy(speech, segment):
    """Mean square of the sound within `segment`."""
    start, end = round(segment.start * speech.rate), round(segment.end * speech.rate)
    return float((speech.samples[start:end].astype(float) ** 2).mean())


def test_phones_cover_the_sound_exactly(speech):
    phones = speech.alignment.phones
    assert speech.rate == 22050
    assert (phones[0].start, phones[-1].end) == (0.0, len(speech.samples) / speech.rate)
    assert all(a.end == b.start for a, b in pairwise(phones))
    assert {p.label for p in phones} <= CMU_PHONES


def test_samples_are_float32_and_in_range(speech):
    assert speech.samples.dtype == np.float32
    assert 0.1 < np.abs(speech.samples).max() <= 1


def test_every_word_is_there_in_order_and_begins_and_ends_with_a_phone(speech):
    words = [w.label for w in speech.alignment.words]
    assert words == [
        "Please",
        "put",
        "a",
        "big",
        "cup",
        "of",
        "tea",
        "Bob",
        "by",
        "the",
        "happy",
        "zebra",
        "Thank",
        "you",
    ]
    starts = {p.start for p in speech.alignment.phones}
    ends = {p.end for p in speech.alignment.phones}
    assert {w.start for w in speech.alignment.words} <= starts
    assert {w.end for w in speech.alignment.words} <= ends


def test_pauses_are_quiet_and_vowels_loud(speech):
    pauses = [energy(speech, p) for p in speech.alignment.phones if p.label == SIL]
    vowels = [energy(speech, p) for p in speech.alignment.phones if p.label in VOWELS]
    assert len(pauses) >= 4
    assert max(pauses) < 1e-6
    assert min(vowels) > 1e-4


def test_the_closure_of_a_stop_belongs_to_the_stop(speech):
    phones = speech.alignment.phones
    stops = [(a, b) for a, b in pairwise(phones) if b.label in "PTK" and a.label in VOWELS]
    assert len(stops) >= 3
    for vowel, stop in stops:
        last = vowel._replace(start=vowel.end - 0.005)
        first = stop._replace(end=stop.start + 0.005)
        assert energy(speech, first) < 1e-6 < energy(speech, last)


def test_onset_moves_over_silence_only_between_two_sounds():
    samples = np.r_[np.full(400, 500), np.zeros(200), np.full(400, 500)].astype(np.int16)
    word = (1, 0, 1)
    for before, here, want in (("a", "p", 400), ("", "p", 600), ("a", "", 600)):
        events = [_Event(before, 0, word), _Event(here, 600, word)]
        assert _onset(events, 1, samples, 22050) == want
    assert _onset([_Event("a", 410, word), _Event("p", 600, word)], 1, samples, 22050) == 600
    assert _onset([_Event("a", 0, word), _Event("p", 450, word)], 1, samples, 22050) == 450


def test_the_same_text_gives_the_same_samples_from_any_thread(speech):
    with ThreadPoolExecutor(4) as pool:
        others = list(pool.map(say, ["Something else before.", SENTENCE, SENTENCE, SENTENCE]))
    for other in others[1:]:
        np.testing.assert_array_equal(other.samples, speech.samples, strict=True)
        assert other.alignment == speech.alignment
    assert len(others[0].samples) != len(speech.samples)


def test_slower_speech_is_longer_and_has_the_same_phones(speech):
    slow, fast = say(SENTENCE, rate_wpm=80), say(SENTENCE, rate_wpm=400)
    assert slow.alignment.duration > 1.5 * speech.alignment.duration > 3 * fast.alignment.duration
    spoken = [[p.label for p in s.alignment.phones if p.label != SIL] for s in (slow, fast)]
    assert spoken[0] == spoken[1]


def test_phones_are_those_of_the_words():
    said = say("big cup").alignment
    assert [p.label for p in said.phones if p.label != SIL] == ["B", "IH", "G", "K", "AH", "P"]


@pytest.mark.parametrize(
    ("voice", "text", "n_words"),
    [
        ("ru", "Привет, мир", 2),
        ("de", "Guten Tag, schöne Welt", 4),
        ("fr", "Ça va très bien", 4),
        ("en-gb", "Hello there", 2),
    ],
)
def test_other_languages_get_the_nearest_phones(voice, text, n_words):
    said = say(text, voice=voice)
    assert {p.label for p in said.alignment.phones} <= CMU_PHONES
    assert [w.label for w in said.alignment.words] == text.replace(",", "").split()
    assert len(said.alignment.words) == n_words
    inside = [p for p in said.alignment.phones if p.label == SIL]
    assert max(energy(said, p) for p in inside) < 1e-6


def test_a_long_text_is_said_to_its_end():
    said = say(" ".join([SENTENCE] * 40))
    assert len(said.alignment.words) == 40 * 14
    assert said.alignment.words[-1].label == "you"


def test_odd_characters_do_no_harm():
    odd = say("Hello\0 \ud800wor\u200bld\n[[p]] <b>bold</b> 42%").alignment
    assert odd.words[0].label == "Hello"
    assert odd.duration > 1


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("", {}, "nothing to say in the text ''"),
        (" ...! ", {}, "nothing to say"),
        ("hi", {"voice": "xx-nope"}, "espeak-ng has no voice 'xx-nope'"),
        ("hi", {"rate_wpm": 401}, "rate_wpm must be 80 to 400, got 401"),
        ("hi", {"rate_wpm": 0}, "rate_wpm must be 80 to 400, got 0"),
    ],
)
def test_what_cannot_be_said_is_an_input_error(text, options, message):
    with pytest.raises(InputError, match=message):
        say(text, **options)


def test_a_missing_extra_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "espeakng_loader", None)
    with pytest.raises(InputError, match=r"pip install 'mmmgpu\[tts\]'"):
        say("hello")


def test_a_library_that_cannot_be_loaded_is_one_line(monkeypatch, tmp_path):
    import espeakng_loader

    broken = tmp_path / "libespeak-ng.so"
    broken.write_bytes(b"not a library")
    monkeypatch.setattr(espeakng_loader, "get_library_path", lambda: str(broken))
    with pytest.raises(InputError, match=r"espeak-ng failed .*reinstall") as caught:
        say("hello")
    assert "\n" not in str(caught.value)


def test_transcribe():
    assert transcribe("church") == ("CH", "ER", "CH")


def test_importing_loads_no_optional_library():
    code = "import sys, mmmgpu.voices, mmmgpu.aligner, mmmgpu.pronunciation; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True)
    assert not {"espeakng_loader", "pocketsphinx", "scipy", "av"} & set(done.stdout.split())
