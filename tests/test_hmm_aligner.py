import os
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hmms import LEXICON, RATE, SENTENCES, utter
from scipy.stats import norm

from mmmgpu import hmm_aligner, hmm_training
from mmmgpu.alignments import read_alignment
from mmmgpu.errors import InputError
from mmmgpu.hmm_aligner import align, make_recording, misfit, suspects, train_hmms
from mmmgpu.lexicons import look_up, read_lexicon
from mmmgpu.phone_networks import BREATH
from mmmgpu.phones import SIL
from mmmgpu.pronunciation import look_up_english
from mmmgpu.sounds import read_sound
from mmmgpu.voices import say


@pytest.fixture(scope="module")
def lexicon(tmp_path_factory):
    path = tmp_path_factory.mktemp("lexicon") / "a.dict"
    path.write_text(LEXICON, encoding="utf-8")
    return read_lexicon(path)


@pytest.fixture(scope="module")
def foreign(lexicon):
    """Sentences of a made-up language: recordings, and the phones as they were made."""
    rng = np.random.default_rng(0)
    sounds = [utter(sentence, rng) for sentence in SENTENCES]
    words = [look_up(sentence, lexicon, "a.dict") for sentence in SENTENCES]
    recordings = [make_recording(s, RATE, w) for (s, _), w in zip(sounds, words, strict=True)]
    return recordings, [phones for _, phones in sounds]


@pytest.fixture(scope="module")
def trained(foreign):
    return train_hmms(foreign[0])


def spoken(alignment):
    return [p for p in alignment.phones if p.label != SIL]


def test_a_language_is_learned_from_six_sentences(foreign, trained):
    errors = []
    for recording, phones in zip(*foreign, strict=True):
        found = spoken(align(trained.hmms, recording))
        assert [p.label for p in found] == [label for label, _, _ in phones]
        errors += [np.subtract(p[1:], truth[1:]) for p, truth in zip(found, phones, strict=True)]
    assert np.median(np.abs(errors)) < 0.01
    assert np.abs(errors).max() < 0.03


def test_words_and_phones_agree_and_phones_cover_the_clip(foreign, trained):
    for recording, sentence in zip(foreign[0], SENTENCES, strict=True):
        found = align(trained.hmms, recording)
        words = [word.strip(".,!").lower() for word in sentence.split()]
        assert [w.label for w in found.words] == words
        assert (found.phones[0].start, found.phones[-1].end) == (0.0, recording.duration)
        assert all(a.end == b.start for a, b in pairwise(found.phones))
        starts, ends = ({p[i] for p in spoken(found)} for i in (1, 2))
        assert {w.start for w in found.words} <= starts
        assert {w.end for w in found.words} <= ends


def test_the_likelihood_rises_between_splits(trained):
    gains = np.diff(trained.log_likelihoods)
    after_split = np.cumsum(hmm_training.ROUNDS)[:-1] - 1
    assert (np.delete(gains, after_split) > 0).all()
    assert trained.facts["phones"] == sorted([SIL, "a", "i", "m", "o", "s"])
    assert len(trained.facts["log_likelihoods"]) == sum(hmm_training.ROUNDS)


def same(a, b):
    names = ("weights", "means", "variances", "stay")
    return all(getattr(a, n).tobytes() == getattr(b, n).tobytes() for n in names)


def test_the_same_bits_again_and_after_an_interruption(foreign, trained, tmp_path):
    class Killed(Exception):
        pass

    counted = []

    def advance(n):
        counted.append(n)
        if sum(counted) > 7.5 * len(foreign[0]):
            raise Killed

    with pytest.raises(Killed):
        train_hmms(foreign[0], folder=tmp_path, advance=advance)
    rest = []
    again = train_hmms(foreign[0], folder=tmp_path, advance=rest.append)
    assert rest[0] == 7 * len(foreign[0])
    assert sum(rest) == sum(hmm_training.ROUNDS) * len(foreign[0])
    assert again.log_likelihoods == trained.log_likelihoods
    assert same(again.hmms, trained.hmms)


def test_a_misfit_is_how_much_better_other_phones_explain_the_frames(lexicon, trained):
    samples, _ = utter("Mása so", np.random.default_rng(6), pause=0.5)
    words = look_up("Osim so", lexicon, "a.dict")  # not what is said
    recording = make_recording(samples, RATE, words)
    found, hmms = align(trained.hmms, recording), trained.hmms
    gaps = []
    for t, x in enumerate(recording.features):
        likely = {
            label: max(
                np.logaddexp.reduce(
                    [
                        np.log(w) + norm.logpdf(x, m, np.sqrt(v)).sum()
                        for w, m, v in zip(
                            hmms.weights[q], hmms.means[q], hmms.variances[q], strict=True
                        )
                        if w > 0
                    ]
                )
                for q in states
            )
            for label, states in hmms.states.items()
        }
        (own,) = [p.label for p in found.phones if p.start <= (t + 0.5) / 100 < p.end]
        if own != SIL:
            gaps.append(max(likely.values()) - likely[own])
    assert 10 < len(gaps) < len(recording.features) - 10  # the others are silent
    assert np.mean(gaps) > 1
    np.testing.assert_allclose(misfit(hmms, recording, found), np.mean(gaps), rtol=1e-6)


def test_other_words_than_are_said_fit_badly(foreign, trained):
    right, wrong = foreign[0][1], foreign[0][5]
    forced = replace(right, words=wrong.words)
    good = misfit(trained.hmms, right, align(trained.hmms, right))
    bad = misfit(trained.hmms, forced, align(trained.hmms, forced))
    assert good < 2
    assert bad > good + 10


def test_a_clip_is_suspect_if_it_is_far_from_all_others():
    usual = [0.9, 1.0, 1.1, 1.2, 0.8, 1.3, 0.7]
    assert not suspects([*usual, 1.9]).any()
    assert suspects([*usual, 3.0]).tolist() == [False] * 7 + [True]
    assert not suspects([*usual, -3.0]).any()
    assert not suspects([*usual[:6], 3.0]).any()  # too few to say what is usual
    assert not suspects([1.0] * 9).any()


def test_a_breath_in_a_pause_is_told_from_silence(lexicon):
    rng = np.random.default_rng(1)
    recordings, breaths = [], []
    for sentence in SENTENCES:
        samples, phones = utter(sentence, rng, pause=0.6)
        begin, n = phones[-1][2] + 0.2, round(0.25 * RATE)
        samples[round(begin * RATE) :][:n] += rng.normal(0, 0.03, n)
        recordings.append(make_recording(samples, RATE, look_up(sentence, lexicon, "a.dict")))
        breaths.append((begin, begin + 0.25))
    trained = train_hmms(recordings, breath=True)
    for recording, truth in zip(recordings, breaths, strict=True):
        phones = align(trained.hmms, recording).phones
        assert [p.label for p in phones[-3:]] == [SIL, BREATH, SIL]
        assert np.abs(np.subtract(phones[-2][1:], truth)).max() < 0.04
        assert min(p.end - p.start for p in phones if p.label == BREATH) > 0.0999


def test_english_needs_no_dictionary():
    texts = (
        "bin blue at three soon",
        "lay red by two now",
        "set green with nine again",
        "place white in five please",
        "bin red by two soon",
        "lay blue in nine now",
    )
    speech = [say(text) for text in texts]
    recordings = [
        make_recording(s.samples, s.rate, look_up_english(text))
        for s, text in zip(speech, texts, strict=True)
    ]
    hmms = train_hmms(recordings).hmms
    errors = []
    for recording, truth in zip(recordings, speech, strict=True):
        pairs = zip(align(hmms, recording).words, truth.alignment.words, strict=True)
        errors += [np.subtract(a[1:], b[1:]) for a, b in pairs]
    assert np.median(np.abs(errors)) < 0.02


def test_one_clip_of_one_word_works(lexicon):
    samples, _ = utter("mása", np.random.default_rng(2))
    recording = make_recording(samples, RATE, look_up("mása", lexicon, "a.dict"))
    found = align(train_hmms([recording]).hmms, recording)
    assert [w.label for w in found.words] == ["mása"]
    assert [p.label for p in spoken(found)] == ["m", "a", "s", "a"]


@pytest.mark.parametrize(
    ("seconds", "text", "message"),
    [
        (1.0, "", "the transcript has no words; give what is said"),
        (
            0.2,
            "mása ìmo",
            r"the transcript \(2 words\) takes at least 0\.21 s to say but the sound",
        ),
    ],
)
def test_a_clip_that_cannot_be_learned_from(lexicon, seconds, text, message):
    samples, _ = utter("mása", np.random.default_rng(3))
    words = look_up(text, lexicon, "a.dict")
    with pytest.raises(InputError, match=message):
        make_recording(samples[: round(seconds * RATE)], RATE, words)


def test_the_shortest_possible_clip_is_aligned(lexicon, trained):
    samples, _ = utter("mása", np.random.default_rng(3))
    recording = make_recording(samples[: round(0.12 * RATE)], RATE, look_up("mása", lexicon, ""))
    assert len(recording.features) == 4 * hmm_training.STATES
    assert len(spoken(align(trained.hmms, recording))) == 4


def test_a_clip_that_needs_too_much_memory_is_refused(lexicon, monkeypatch):
    samples, _ = utter("mása", np.random.default_rng(4))
    words = look_up("mása", lexicon, "a.dict")
    states = 4 * 3 + 2 * (3 + 10 + 3)  # of the word, and of two pauses
    cells = len(make_recording(samples, RATE, words).features) * states
    monkeypatch.setattr(hmm_aligner, "LARGEST", cells)
    make_recording(samples, RATE, words)
    monkeypatch.setattr(hmm_aligner, "LARGEST", cells - 1)
    with pytest.raises(InputError, match=r"too long to be aligned in one piece; cut it"):
        make_recording(samples, RATE, words)


@pytest.mark.real
def test_word_boundaries_of_real_speech():
    """44 of the 175 clips of GRID speaker 1, learned from these alone; see docs/alignment.md."""
    folder = os.environ.get("MMMGPU_DATA")
    if not folder:
        pytest.skip("MMMGPU_DATA names no folder of real video")
    clips = sorted((Path(folder) / "grid-s1").glob("*.mpg"))[::4]
    recordings = [
        make_recording(*read_sound(c), look_up_english(c.with_suffix(".txt").read_text()))
        for c in clips
    ]
    hmms = train_hmms(recordings).hmms
    errors = []
    for clip, recording in zip(clips, recordings, strict=True):
        theirs = read_alignment(clip.with_suffix(".align")).words
        pairs = zip(align(hmms, recording).words, theirs, strict=True)
        errors += [np.subtract(a[1:], b[1:]) for a, b in pairs]
    assert np.median(np.abs(errors)) <= 0.03
    assert np.percentile(np.abs(errors), 90) <= 0.08
