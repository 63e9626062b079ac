"""The command line where all goes well: what each command takes, shows and writes."""

import json
import subprocess
import sys

import hmms
import numpy as np
import pytest
from commands import assert_refused, run_command, trained_model
from media import encode, still

from mmmgpu import __version__, hmm_aligner
from mmmgpu.alignments import read_alignment
from mmmgpu.commands import endings
from mmmgpu.commands.options import LibraryDefault
from mmmgpu.errors import InputError
from mmmgpu.hmm_training import ROUNDS
from mmmgpu.model_files import load
from mmmgpu.sounds import read_sound, resample, write_wav
from mmmgpu.training import Options
from mmmgpu.videos import probe, read_frames
from mmmgpu.voices import say

COMMANDS = ("demo", "align", "train", "reconstruct", "speak", "evaluate")
COMMANDS += ("mark", "transfer", "adapt", "aam", "track", "bench", "compare", "info")
SLOW = {"av", "cv2", "matplotlib", "numpy", "rich", "scipy", "sklearn", "warp"}


@pytest.fixture
def mmmgpu(capfd):
    return lambda *args: run_command(capfd, *args)


@pytest.fixture(scope="session")
def model(world):
    return trained_model(world)


def test_help_names_every_command(mmmgpu):
    ended = mmmgpu("--help")
    assert ended.status == 0
    assert all(f"\n  {name} " in ended.out for name in (*COMMANDS, "study"))
    assert "..." not in ended.out.partition("Commands:")[2]  # no summary is cut


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example_and_machine_readable_results(mmmgpu, command):
    ended = mmmgpu(command, "--help")
    assert ended.status == 0
    assert f"mmmgpu {command}" in ended.out.partition("Example")[2]
    assert "--json FILE" in ended.out


def test_help_shows_the_defaults_of_the_library(mmmgpu):
    words = " ".join(mmmgpu("train", "--help").out.split())
    assert f"[default: {Options().prototypes}; x>=2]" in words
    assert LibraryDefault("mmmgpu.training", "Options", "prototypes")() == Options().prototypes


def test_version(mmmgpu):
    assert mmmgpu("--version").out == f"mmmgpu {__version__}\n"


def test_starting_loads_no_slow_library():
    program = "import sys, mmmgpu.cli; print(*{m.partition('.')[0] for m in sys.modules})"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert SLOW & set(done.stdout.decode().split()) == set()
    assert "typer" in done.stdout.decode().split()


@pytest.mark.parametrize(
    "args",
    [
        (),
        ("sing",),
        ("train", "a.mp4"),
        ("train", "a.mp4", "--alignments", ".", "--out", "m.mmm", "--region", "1,2,3"),
        ("train", "a.mp4", "--alignments", ".", "--out", "m.mmm", "--flow", "magic"),
        ("train", "a.mp4", "--alignments", ".", "--out", "m.mmm", "--prototypes", "many"),
        ("speak", "m.mmm", "--out", "a.mp4"),
        ("speak", "m.mmm", "--out", "a.mp4", "--text", "hello", "--audio", "a.wav"),
        ("speak", "m.mmm", "--out", "a.mp4", "--from-trajectory", "t", "--articulation", "1.2"),
        ("speak", "m.mmm", "--out", "a.mp4", "--from-trajectory", "t", "--trajectory", "dpds"),
        ("reconstruct", "m.mmm", "a.mp4", "--out", "b.mkv", "--landmarks", "."),
        ("align", "a.mp4", "--transcripts", ".", "--out", "b", "--aligner", "ear"),
        ("align", "a.mp4", "--transcripts", ".", "--out", "b", "--dictionary", "d"),
        ("align", "a.mp4", "--transcripts", ".", "--out", "b", "--breath"),
    ],
)
def test_wrong_usage_is_status_2(mmmgpu, args, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ended = mmmgpu(*args)
    assert ended.status == 2
    assert "Usage: mmmgpu" in ended.out + ended.err
    assert list(tmp_path.iterdir()) == []


def test_info_of_the_machine(mmmgpu, tmp_path):
    ended = mmmgpu("info", "--json", tmp_path / "info.json")
    facts = json.loads((tmp_path / "info.json").read_text())
    assert ended.status == 0
    assert facts["mmmgpu"] == __version__
    assert facts["backends"]["warp"]["loads"]
    assert "warp:cpu" in facts["backends"]["warp"]["devices"]
    assert facts["packages"][""]["numpy"] == np.__version__
    assert facts["packages"]["align"].keys() == {"kaldi-native-fbank", "pocketsphinx"}
    assert "warp:cpu" in ended.out


def test_info_says_why_a_backend_does_not_load(mmmgpu, tmp_path, monkeypatch):
    def refuse(name):
        raise InputError(f"no {name}\nhere")

    monkeypatch.setattr("mmmgpu.backends.get_backend", refuse)
    ended = mmmgpu("info", "--json", tmp_path / "info.json")
    facts = json.loads((tmp_path / "info.json").read_text())
    assert facts["backends"]["opencl"] == {"loads": False, "reason": "no opencl here"}
    assert "does not load: no opencl here" in ended.out


def test_info_of_a_model(mmmgpu, model, tmp_path):
    ended = mmmgpu("info", model, "--json", tmp_path / "model.json")
    facts = json.loads((tmp_path / "model.json").read_text())
    person = load(model)
    assert ended.status == 0
    assert [(p["clip"], p["frame"]) for p in facts["prototypes"]] == list(person.sources)
    assert facts["region"]["box"] == list(person.reference.region.box)
    assert facts["alpha"]["constants"] == vars(person.alpha.constants)
    assert facts["notes"] == person.notes
    assert person.sources[person.basis.reference][0] in ended.out


def test_train_skips_a_clip_without_the_head(mmmgpu, world, tmp_path):
    """A folder and a file as CLIPs; the model's own account of itself as results."""
    folder = tmp_path / "some clips"
    folder.mkdir()
    for clip in world.clips[:2]:
        (folder / clip.name).write_bytes(clip.read_bytes())
    (folder / "notes.txt").write_text("no video")
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 256, still(160, 144).shape, np.uint8) for _ in range(30)]
    nobody = encode(tmp_path / "nobody.mkv", noise)
    (tmp_path / "nobody.lab").write_text("0.0 1.0 SIL\n")
    for clip in world.clips[:2]:
        textgrid = clip.with_suffix(".TextGrid")
        (tmp_path / textgrid.name).write_bytes(textgrid.read_bytes())
    box = ",".join(str(n) for n in load(trained_model(world)).reference.region.box)
    out = tmp_path / "new" / "p.mmm"
    args = (folder, nobody, "--alignments", tmp_path, "--prototypes", 5, "--region", box)
    report = tmp_path / "report.html"
    outputs = ("--out", out, "--json", tmp_path / "results.json", "--report", report)
    ended = mmmgpu("train", *args, *outputs, "--seed", 3)
    assert ended.status == 0
    assert "nobody.mkv" in report.read_text()
    assert ended.err.count("warning: skipped: ") == 1
    assert "nobody.mkv" in ended.err
    assert list(out.parent.iterdir()) == [out]
    facts = json.loads((tmp_path / "results.json").read_text())
    assert facts["notes"]["clips"] == [clip.name for clip in world.clips[:2]]
    assert facts["notes"]["skipped"].keys() == {"nobody.mkv"}
    assert facts["notes"]["seed"] == 3
    assert len(facts["prototypes"]) == 5


def test_reconstruct(mmmgpu, world, model, tmp_path):
    out, results = tmp_path / "back.mkv", tmp_path / "results.json"
    clip = world.clips[2]
    ended = mmmgpu("reconstruct", model, clip, "--out", out, "--lossless", "--json", results)
    assert ended.status == 0
    before, after = probe(clip), probe(out)
    assert (after.frames, after.width, after.height, after.fps) == (
        before.frames,
        before.width,
        before.height,
        before.fps,
    )
    assert json.loads(results.read_text())["frames"] == before.frames
    assert str(out.name) in ended.out


def test_reconstruct_measures_against_landmarks(mmmgpu, world, model, tmp_path):
    from mmmgpu.performer import landmarks

    clip, motion = world.clips[2], world.motions[2]
    points = np.stack([landmarks(world.face, motion, t) for t in range(len(motion))])
    np.savez(tmp_path / f"{clip.stem}.npz", points=points)
    measured = ("--landmarks", tmp_path, "--alignments", world.alignments)
    args = ("--out", tmp_path / "b.mkv", "--lossless", "--json", tmp_path / "results.json")
    ended = mmmgpu("reconstruct", model, clip, *measured, *args)
    assert ended.status == 0
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["pixels_changed_outside_cover"] == 0
    assert results["speech"]["psnr_db"] > 20


def test_evaluate(mmmgpu, world, model, tmp_path):
    clips, results = world.clips[2:], tmp_path / "results.json"
    report = tmp_path / "report.html"
    args = ("--alignments", world.alignments, "--json", results, "--report", report)
    ended = mmmgpu("evaluate", model, *clips, *args)
    assert ended.status == 0
    assert "95 %" in report.read_text()
    facts = json.loads(results.read_text())
    assert facts["clips"] == [clip.name for clip in clips]
    assert facts["alpha"]["all"]["rms"]["trained"]["mean"] > 0
    assert "alpha, all, rms, trained" in ended.out


def test_speak_text_and_its_trajectory_again(mmmgpu, model, tmp_path):
    """What is saved and rendered again is the same video; stand-ins are told once."""
    saved = ("--save-trajectory", tmp_path / "t.csv", "--json", tmp_path / "results.json")
    first = mmmgpu("speak", model, "--text", "My joy!", "--out", tmp_path / "a.mkv", *saved)
    assert first.status == 0
    assert first.err.count("mmmgpu: warning: ") == 1
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["words"] == ["My", "joy"]
    known = load(model).alpha.trained.labels
    assert results["stand_ins"].keys() == {p[0] for p in results["phones"]} - set(known)
    assert results["stand_ins"].keys() >= {"JH", "OY"}
    spoken = ("--from-trajectory", tmp_path / "t.csv", "--audio", tmp_path / "a.mkv")
    second = mmmgpu("speak", model, *spoken, "--out", tmp_path / "b.mkv")
    assert second.status == 0
    pairs = zip(read_frames(tmp_path / "a.mkv"), read_frames(tmp_path / "b.mkv"), strict=True)
    # the CSV rounds to six figures, and both videos are compressed
    assert max(float(np.abs(a.astype(int) - b).mean()) for a, b in pairs) < 0.5


def test_speak_by_another_movement(mmmgpu, model, tmp_path):
    spoken = ("speak", model, "--text", "My joy!", "--out", tmp_path / "a.mkv")
    ended = mmmgpu(*spoken, "--trajectory", "dpds", "--save-trajectory", tmp_path / "dpds.csv")
    assert ended.status == 0
    assert ended.err.count("mmmgpu: warning: ") == 1
    assert mmmgpu(*spoken, "--save-trajectory", tmp_path / "egp02.csv").status == 0
    assert (tmp_path / "dpds.csv").read_bytes() != (tmp_path / "egp02.csv").read_bytes()
    (tmp_path / "a.mkv").unlink()
    assert_refused(mmmgpu(*spoken, "--trajectory", "rnn"), "'rnn'", "egp02, brand, dpds, hmm, slds")
    assert not (tmp_path / "a.mkv").exists()


def test_speak_audio_with_alignment_and_a_late_sound(mmmgpu, world, model, tmp_path):
    clip, out = world.clips[2], tmp_path / "a.mkv"
    spoken = ("--audio", clip, "--alignment", clip.with_suffix(".TextGrid"))
    told = ("--background", world.clips[1], "--sync", "0.2", "--lossless")
    ended = mmmgpu("speak", model, *spoken, *told, "--out", out)
    assert ended.status == 0
    assert probe(out).frames == probe(clip).frames
    real, rate = read_sound(clip)
    heard, _ = read_sound(out)
    late = round(0.2 * rate)
    assert np.abs(heard[:late]).max() == 0
    np.testing.assert_allclose(heard[late : len(real)], real[: len(real) - late], rtol=0, atol=1e-4)


def test_speak_audio_with_transcript(mmmgpu, model, tmp_path):
    speech = say("put the red ball on the table")
    write_wav(tmp_path / "voice.wav", speech.samples, speech.rate)
    (tmp_path / "said.txt").write_text("Put the red ball on the table.")
    spoken = ("--audio", tmp_path / "voice.wav", "--transcript", f"@{tmp_path / 'said.txt'}")
    json_file = tmp_path / "results.json"
    ended = mmmgpu("speak", model, *spoken, "--out", tmp_path / "a.mp4", "--json", json_file)
    assert ended.status == 0
    assert json.loads(json_file.read_text())["words"][:3] == ["put", "the", "red"]


@pytest.fixture(scope="module")
def voices(tmp_path_factory):
    """Two recordings with their transcripts, which are also rows of one file."""
    folder = tmp_path_factory.mktemp("voices")
    texts = {"one": "seven blue boats", "two": "a cup of green tea"}
    for name, text in texts.items():
        speech = say(text)
        write_wav(folder / f"{name}.wav", speech.samples, speech.rate)
        (folder / f"{name}.txt").write_text(text)
    (folder / "all.tsv").write_text("".join(f"{n}.wav\t{t}\n" for n, t in texts.items()))
    return folder


@pytest.mark.parametrize("transcripts", [".", "all.tsv"])
def test_align_keeps_what_is_newer(mmmgpu, voices, tmp_path, transcripts):
    out, results = tmp_path / "out", tmp_path / "results.json"
    sounds = [voices / "one.wav", voices / "two.wav"]
    args = ("--transcripts", voices / transcripts, "--out", out, "--json", results)
    assert mmmgpu("align", *sounds, *args).status == 0
    assert sorted(p.name for p in out.iterdir()) == ["one.TextGrid", "two.TextGrid"]
    (out / "two.TextGrid").unlink()
    before = (out / "one.TextGrid").stat().st_mtime_ns
    assert mmmgpu("align", *sounds, *args).status == 0
    facts = json.loads(results.read_text())
    assert [clip["status"] for clip in facts["clips"]] == ["kept", "aligned"]
    assert (out / "one.TextGrid").stat().st_mtime_ns == before


def test_align_goes_on_after_a_failure(mmmgpu, voices, tmp_path):
    (tmp_path / "three.wav").write_bytes((voices / "one.wav").read_bytes())
    (tmp_path / "two.txt").write_text((voices / "two.txt").read_text())
    sounds = (tmp_path / "three.wav", voices / "two.wav")
    out = tmp_path / "out"
    ended = mmmgpu("align", *sounds, "--transcripts", tmp_path, "--out", out)
    assert ended.status == 1
    assert ended.err.count("mmmgpu: error: ") == 1
    assert "holds no transcript of three" in ended.err
    assert [p.name for p in out.iterdir()] == ["two.TextGrid"]


def test_align_one_clip_with_its_text(mmmgpu, voices, tmp_path):
    args = ("--transcripts", voices / "one.txt", "--out", tmp_path)
    assert mmmgpu("align", voices / "one.wav", *args).status == 0
    assert (tmp_path / "one.TextGrid").is_file()


@pytest.fixture(scope="module")
def foreign(tmp_path_factory):
    """Recordings of a made-up language in odd formats, with transcripts and a dictionary."""
    folder = tmp_path_factory.mktemp("foreign")
    (folder / "words.dict").write_text(hmms.LEXICON, encoding="utf-8")
    rng, truth = np.random.default_rng(0), {}
    formats = zip(hmms.SENTENCES, (8000, 16000, 22050, 44100, 48000, 96000), strict=True)
    for i, (sentence, rate) in enumerate(formats):
        samples, phones = hmms.utter(sentence, rng)
        sound = resample(samples.astype(np.float32), hmms.RATE, rate)
        channels = sound if i % 2 else np.stack([sound, sound], axis=1)
        name = f"{i} {rate}"
        write_wav(folder / f"{name}.wav", channels, rate)
        (folder / f"{name}.txt").write_text(sentence, encoding="utf-8")
        truth[name] = phones
    return folder, truth


def test_align_by_models_of_the_clips_themselves(mmmgpu, foreign, tmp_path):
    folder, truth = foreign
    out, results = tmp_path / "out", tmp_path / "results.json"
    args = ("--transcripts", folder, "--out", out, "--aligner", "hmm", "--json", results)
    args = (*args, "--dictionary", folder / "words.dict")
    clips = sorted(folder.glob("*.wav"))
    ended = mmmgpu("align", *clips, *args)
    assert ended.status == 0
    facts = json.loads(results.read_text())
    assert [clip["status"] for clip in facts["clips"]] == ["aligned"] * len(clips)
    assert facts["training"]["phones"] == ["SIL", "a", "i", "m", "o", "s"]
    assert sorted(p.stem for p in out.iterdir()) == sorted(truth)  # no unfinished training
    errors = []
    for name, phones in truth.items():
        found = [p for p in read_alignment(out / f"{name}.TextGrid").phones if p.label != "SIL"]
        assert [p.label for p in found] == [label for label, _, _ in phones]
        errors += [np.subtract(a[1:], b[1:]) for a, b in zip(found, phones, strict=True)]
    assert np.median(np.abs(errors)) < 0.015

    before = {p.name: p.read_bytes() for p in out.iterdir()}
    assert mmmgpu("align", *clips, *args).status == 0
    assert {p.name: p.read_bytes() for p in out.iterdir()} == before


def test_a_transcript_of_other_words_is_said(mmmgpu, foreign, tmp_path):
    folder, rng = tmp_path / "sounds", np.random.default_rng(5)
    folder.mkdir()
    for i in range(9):
        samples, _ = hmms.utter(hmms.SENTENCES[i % 6], rng)
        write_wav(folder / f"{i}.wav", samples.astype(np.float32), hmms.RATE)
        (folder / f"{i}.txt").write_text(hmms.SENTENCES[i % 6], encoding="utf-8")
    (folder / "7.txt").write_text(hmms.SENTENCES[5], encoding="utf-8")
    args = ("--transcripts", folder, "--out", tmp_path / "out", "--aligner", "hmm")
    args += ("--dictionary", foreign[0] / "words.dict", "--json", tmp_path / "facts.json")
    ended = mmmgpu("align", *sorted(folder.glob("*.wav")), *args)
    assert ended.status == 0
    (line,) = [line for line in ended.err.splitlines() if "warning" in line]
    assert f"{folder / '7.wav'}: the sound fits its transcript far worse" in line
    clips = json.loads((tmp_path / "facts.json").read_text())["clips"]
    assert [clip["suspect"] for clip in clips] == [i == 7 for i in range(9)]


def test_align_goes_on_where_its_training_was_killed(mmmgpu, foreign, tmp_path, monkeypatch):
    folder, _ = foreign
    args = ("--transcripts", folder, "--dictionary", folder / "words.dict", "--aligner", "hmm")
    clips = sorted(folder.glob("*.wav"))
    assert mmmgpu("align", *clips, *args, "--out", tmp_path / "whole").status == 0
    wrote, out = hmm_aligner.write_step, tmp_path / "out"
    rounds = []

    def write_five(*step):
        wrote(*step)
        rounds.append(step)
        if len(rounds) == 5:
            raise KeyboardInterrupt

    monkeypatch.setattr(hmm_aligner, "write_step", write_five)
    assert mmmgpu("align", *clips, *args, "--out", out).status == 130
    assert [p.name for p in out.iterdir()] == ["hmm.work"]
    assert mmmgpu("align", *clips, *args, "--out", out).status == 0
    assert len(rounds) == sum(ROUNDS)
    for path in (tmp_path / "whole").iterdir():
        assert (out / path.name).read_bytes() == path.read_bytes()
    assert not (out / "hmm.work").exists()


def test_demo_passes_on_what_it_is_told(mmmgpu, tmp_path, monkeypatch):
    told = {}

    def make_demo(out, *, seed, backend):
        told.update(out=out, seed=seed, backend=backend)
        return {"errors": {"rms": 0.5}}

    monkeypatch.setattr("mmmgpu.demo.make_demo", make_demo)
    args = ("--seed", 4, "--json", tmp_path / "results.json")
    assert mmmgpu("demo", "--out", tmp_path / "d", *args).status == 0
    assert told == {"out": tmp_path / "d", "seed": 4, "backend": "warp"}
    assert json.loads((tmp_path / "results.json").read_text()) == {"errors": {"rms": 0.5}}


class TestGuarded:
    """How exceptions end."""

    @staticmethod
    def ended(error, capsys):
        def command():
            raise error

        with pytest.raises(endings.typer.Exit) as end:
            endings.guarded(command)()
        return end.value.exit_code, capsys.readouterr().err

    def test_input_error_is_one_line(self, capsys):
        ended = self.ended(InputError("a\nb"), capsys)
        assert ended == (1, "mmmgpu: error: a b\n")

    def test_disk_error_names_the_file(self, capsys):
        status, err = self.ended(OSError(28, "No space left on device", "x.mp4"), capsys)
        assert (status, err.startswith("mmmgpu: error: x.mp4: No space left")) == (1, True)

    def test_defect_is_one_line(self, capsys, monkeypatch):
        monkeypatch.delenv("MMMGPU_DEBUG", raising=False)
        status, err = self.ended(KeyError("k"), capsys)
        assert (status, err.count("\n")) == (1, 1)
        assert "KeyError: 'k' (this is a defect, please report it" in err

    def test_defect_shows_its_place_on_request(self, capsys, monkeypatch):
        monkeypatch.setenv("MMMGPU_DEBUG", "1")
        status, err = self.ended(KeyError("k"), capsys)
        assert status == 1
        assert err.startswith("Traceback")

    def test_interrupt(self, capsys):
        assert self.ended(KeyboardInterrupt(), capsys) == (130, "")
