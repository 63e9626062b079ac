import numpy as np
import pytest

from mmmgpu import performances
from mmmgpu.alignments import read_alignment
from mmmgpu.errors import InputError
from mmmgpu.parallel import CancelledError
from mmmgpu.performances import SENTENCES, Stage, make_corpus, padded, perform, say_sentence
from mmmgpu.performer import articulate, landmarks, performer, render
from mmmgpu.phones import CMU_PHONES
from mmmgpu.sounds import read_sound
from mmmgpu.videos import probe, read_frames
from mmmgpu.voices import say

SMALL = Stage(size=(64, 64), silence=0.1, pace=300)


@pytest.fixture(scope="module")
def speech():
    return say_sentence("Hi Bob.", SMALL)


@pytest.fixture(scope="module")
def face():
    return performer(3, size=(64, 64))


def test_silence_around_speech_moves_everything():
    said = say("Hi Bob.")
    later = padded(said, 0.25, 0.5)
    rate, n = said.rate, len(said.samples)
    late = round(0.25 * rate)
    np.testing.assert_array_equal(later.samples[late : late + n], said.samples)
    assert not later.samples[:late].any()
    assert not later.samples[late + n :].any()
    assert later.alignment.duration == len(later.samples) / rate
    before = [p for p in said.alignment.phones if p.label != "SIL"]
    after = [p for p in later.alignment.phones if p.label != "SIL"]
    assert [p.label for p in after] == [p.label for p in before]
    shifts = [b.start - a.start for a, b in zip(before, after, strict=True)]
    np.testing.assert_allclose(shifts, late / rate, rtol=0, atol=1e-9)
    assert [w.label for w in later.alignment.words] == ["Hi", "Bob"]
    assert later.alignment.phones[0].label == later.alignment.phones[-1].label == "SIL"


def test_a_performance_is_the_rendered_motion_with_its_truth(tmp_path, face, speech):
    clip = tmp_path / "a clip.mp4"
    motion = perform(face, speech, clip, rng=np.random.default_rng(5), noise=False)
    n = int(np.ceil(speech.alignment.duration * 25))
    expected = articulate(face, speech.alignment.phones, n, 25.0, np.random.default_rng(5))
    np.testing.assert_array_equal(motion.values, expected.values)
    frames, truth = list(read_frames(clip)), list(render(face, expected))
    assert (probe(clip).fps, len(frames)) == (25, n)
    error = np.mean([np.abs(a.astype(int) - b).mean() for a, b in zip(frames, truth, strict=True)])
    assert error < 4  # of 255, by H.264
    with np.load(tmp_path / "a clip.npz") as arrays:
        for t in (0, n - 1):
            want = landmarks(face, expected, t)
            np.testing.assert_allclose(arrays["points"][t], want, rtol=0, atol=1e-4)
        assert arrays["points"].dtype == np.float32
    read = read_alignment(tmp_path / "a clip.TextGrid")
    assert [p.label for p in read.phones] == [p.label for p in speech.alignment.phones]


def test_the_sound_is_in_the_clip(tmp_path, face, speech):
    clip = tmp_path / "clip.mp4"
    perform(face, speech, clip, rng=np.random.default_rng(5))
    samples, rate = read_sound(clip)
    n = min(len(samples), len(speech.samples))
    assert rate == speech.rate
    assert np.corrcoef(samples[:n], speech.samples[:n])[0, 1] > 0.95


def test_noise_makes_frames_differ(tmp_path, face, speech):
    silence = slice(0, 2)
    still, grainy = (tmp_path / name for name in ("still.mp4", "grainy.mp4"))
    for clip in (still, grainy):
        rng = np.random.default_rng(5)
        perform(face, speech, clip, rng=rng, noise=clip == grainy)
    a, b = (np.array(list(read_frames(clip))[silence], int) for clip in (still, grainy))
    assert 0.2 < np.abs(a - b).mean() < 3


def test_a_cancelled_performance_leaves_no_video(tmp_path, face, speech):
    with pytest.raises(CancelledError):
        perform(
            face, speech, tmp_path / "x.mp4", rng=np.random.default_rng(0), cancelled=lambda: True
        )
    assert not list(tmp_path.glob("*.mp4"))


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corpus")
    make_corpus(folder, seed=3, sentences=("Hi Bob.", "Oh no."), stage=SMALL)
    return folder


def test_a_corpus_has_sound_text_alignment_and_truth_of_every_clip(corpus):
    suffixes = (".TextGrid", ".mp4", ".npz", ".txt")
    names = {f"sentence-0{i}{suffix}" for i in (1, 2) for suffix in suffixes}
    assert {path.name for path in corpus.iterdir()} == names | {"sentences.json"}
    assert (corpus / "sentence-02.txt").read_text() == "Oh no.\n"


def test_a_killed_corpus_continues_with_the_same_result(tmp_path, corpus, monkeypatch):
    sentences = ("Hi Bob.", "Oh no.")

    def killed(face, speech, path, **options):
        if path.stem == "sentence-02":
            raise KeyboardInterrupt
        return perform(face, speech, path, **options)

    with monkeypatch.context() as patch:
        patch.setattr(performances, "perform", killed)
        with pytest.raises(KeyboardInterrupt):
            make_corpus(tmp_path, seed=3, sentences=sentences, stage=SMALL)
    first, second = (tmp_path / f"sentence-0{i}.mp4" for i in (1, 2))
    before = first.stat().st_mtime_ns
    assert not second.exists()
    assert make_corpus(tmp_path, seed=3, sentences=sentences, stage=SMALL) == (first, second)
    assert first.stat().st_mtime_ns == before
    for clip in (first, second):
        assert clip.read_bytes() == (corpus / clip.name).read_bytes()


@pytest.mark.parametrize("record", ["{", "[]"])
def test_clips_of_another_call_are_made_anew(tmp_path, record):
    (clip,) = make_corpus(tmp_path, seed=3, sentences=("Hi.",), stage=SMALL)
    before = clip.read_bytes()
    make_corpus(tmp_path, seed=4, sentences=("Hi.",), stage=SMALL)
    assert clip.read_bytes() != before
    (tmp_path / "sentences.json").write_text(record)
    clip.write_bytes(b"of unknown origin")
    make_corpus(tmp_path, seed=3, sentences=("Hi.",), stage=SMALL)
    assert clip.read_bytes() == before


def test_without_a_voice_the_remedy_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(performances, "is_installed", lambda: False)
    with pytest.raises(InputError, match=r"pip install 'mmmgpu\[tts\]'"):
        make_corpus(tmp_path / "corpus", seed=3, sentences=("Hi.",), stage=SMALL)
    assert not (tmp_path / "corpus").exists()


def test_the_sentences_hold_every_phone_several_times():
    alignment = say(" ".join(SENTENCES)).alignment
    said = [phone.label for phone in alignment.phones]
    assert {label for label in CMU_PHONES if said.count(label) < 3} == set()
