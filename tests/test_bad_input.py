"""Whatever is given: status 1, one line that says what, where and what to do, nothing left behind.

And the odd input that is no bad one: turned, variable, grey and quiet video, strange file names.
"""

import errno
import functools
import json
import os
import pickle
import signal
import subprocess
import sys
import time
from fractions import Fraction

import hmms
import numpy as np
import pytest
from commands import assert_refused, run_command, trained_model
from media import cut, encode, encode_sound, set_display_matrix, tone
from safetensors import safe_open
from safetensors.numpy import save_file

from mmmgpu import aligner, reconstruction, training
from mmmgpu.model_files import VERSION, load
from mmmgpu.sounds import write_wav
from mmmgpu.tensor_files import HEADER
from mmmgpu.videos import probe, read_frames
from mmmgpu.voices import say

N_ODD = 20  # frames of an odd video


@pytest.fixture
def mmmgpu(capfd):
    return lambda *args: run_command(capfd, *args)


@pytest.fixture(scope="session")
def model(world):
    return trained_model(world)


@pytest.fixture(scope="module")
def frames(world):
    """The first frames of a real clip."""
    return list(read_frames(world.clips[0], stop=N_ODD))


@pytest.fixture(scope="module")
def region(model):
    return ",".join(str(n) for n in load(model).reference.region.box)


@pytest.fixture
def out(tmp_path):
    """A folder for results, which a refusal must leave empty."""
    folder = tmp_path / "out"
    folder.mkdir()
    return folder


@pytest.fixture
def use(mmmgpu, model, region, tmp_path, out):
    """The ways a clip is used; each runs a command on it."""

    def aligned(clip):
        (tmp_path / f"{clip.stem}.lab").write_text("0.0 0.3 SIL\n0.3 0.6 AA\n")
        return ("--alignments", tmp_path)

    def transcribed(clip):
        (tmp_path / f"{clip.stem}.txt").write_text("some words")
        return ("--transcripts", tmp_path)

    return {
        "train": lambda clip, *more: mmmgpu(
            "train", clip, *aligned(clip), "--out", out / "m.mmm", *more
        ),
        "evaluate": lambda clip: mmmgpu("evaluate", model, clip, *aligned(clip)),
        "reconstruct": lambda clip: mmmgpu("reconstruct", model, clip, "--out", out / "r.mkv"),
        "background": lambda clip: mmmgpu(
            *("speak", model, "--text", "hello", "--background", clip, "--out", out / "s.mp4")
        ),
        "audio": lambda clip: mmmgpu(
            *("speak", model, "--audio", clip, "--transcript", "some words"),
            *("--out", out / "s.mp4"),
        ),
        "align": lambda clip: mmmgpu("align", clip, *transcribed(clip), "--out", out),
    }


CLIP_USES = ("train", "evaluate", "reconstruct", "background", "audio", "align")


def empty(folder, frames):
    (folder / "empty.mp4").write_bytes(b"")
    return folder / "empty.mp4", "is empty"


def truncated(folder, frames):
    return cut(encode(folder / "cut.mkv", frames), 0.6), "truncated"


def text(folder, frames):
    (folder / "text.mp4").write_text("This is no video.\n" * 40)
    return folder / "text.mp4", "not a readable video"


def noise(folder, frames):
    (folder / "noise.mp4").write_bytes(np.random.default_rng(0).bytes(5000))
    return folder / "noise.mp4", "not a readable video"


def missing(folder, frames):
    return folder / "missing.mp4", "no such file"


@pytest.mark.parametrize("command", CLIP_USES)
@pytest.mark.parametrize("make", [missing, empty, truncated, text, noise])
def test_unreadable_clip(use, command, make, tmp_path, frames, out):
    clip, words = make(tmp_path, frames)
    needs_sound = command in ("audio", "align") and make is truncated
    assert_refused(use[command](clip), clip, "no sound" if needs_sound else words)
    assert list(out.iterdir()) == []


@pytest.mark.parametrize("command", ["train", "audio", "align"])
def test_video_without_sound(use, command, tmp_path, frames, out):
    clip = encode(tmp_path / "silent.mkv", frames)
    assert_refused(use[command](clip), clip, "no sound", "give ")
    assert list(out.iterdir()) == []


@pytest.mark.parametrize("command", ["train", "evaluate", "reconstruct", "align"])
@pytest.mark.parametrize(("seconds", "word"), [(0.2, "shorter"), (1.4, "longer")])
def test_sound_of_another_length(use, command, seconds, word, tmp_path, frames, out):
    clip = encode_sound(tmp_path / "odd.mkv", tone(seconds, 8000), 8000, frames=frames)
    assert_refused(use[command](clip), clip, word, "0.80 s", "cut them")
    assert list(out.iterdir()) == []


@pytest.mark.parametrize(("seconds", "word"), [(0.3, "shorter"), (2.0, "longer")])
def test_sound_of_another_length_than_its_phones(mmmgpu, model, seconds, word, tmp_path, out):
    write_wav(tmp_path / "a.wav", tone(seconds, 8000)[:, 0], 8000)
    (tmp_path / "a.lab").write_text("0.0 0.5 SIL\n0.5 1.0 AA\n")
    spoken = ("--audio", tmp_path / "a.wav", "--alignment", tmp_path / "a.lab")
    ended = mmmgpu("speak", model, *spoken, "--out", out / "s.mp4")
    assert_refused(ended, tmp_path / "a.wav", word, "1.00 s")
    assert list(out.iterdir()) == []


@pytest.mark.parametrize("command", ["train", "evaluate", "reconstruct", "background"])
def test_clip_of_one_frame(use, command, tmp_path, frames, out):
    clip = encode(tmp_path / "one.mkv", frames[:1])
    assert_refused(use[command](clip), clip, "1 frame", "longer clip")
    assert list(out.iterdir()) == []


@pytest.mark.parametrize("command", ["train", "evaluate", "reconstruct", "background"])
def test_no_head(use, command, tmp_path, frames, out, region):
    """In a corpus of several the clip is left out: see test_cli."""
    rng = np.random.default_rng(1)
    nobody = [rng.integers(0, 256, frames[0].shape, np.uint8) for _ in frames]
    clip = encode(tmp_path / "nobody.mkv", nobody)
    more = ("--region", region) if command == "train" else ()
    assert_refused(use[command](clip, *more), clip, "head", "leave this clip out")
    assert [p for p in out.iterdir() if p.name != "m.mmm.work"] == []


def test_region_outside_the_picture(use, world, out):
    ended = use["train"](world.clips[0], "--region", "100,100,90,90")
    assert_refused(ended, "--region 100,100,90,90", "144 x 160")


BAD_ALIGNMENTS = {
    "overlapping": ("0.0 0.5 SIL\n0.4 0.9 AA\n", "overlaps"),
    "reversed": ("0.0 0.5 SIL\n0.9 0.5 AA\n", "ends before it starts"),
    "NaN": ("0.0 0.5 SIL\n0.5 nan AA\n", "no finite number"),
    "negative": ("-0.5 0.5 SIL\n", "before 0 s"),
    "no alignment": ("once upon a time\n", "expected 'start end label'"),
    "empty": ("", "is empty"),
}


@pytest.mark.parametrize("command", ["train", "evaluate", "speak"])
@pytest.mark.parametrize("fault", BAD_ALIGNMENTS)
def test_bad_alignment(mmmgpu, world, model, command, fault, tmp_path, out):
    clip = world.clips[0]
    lab = tmp_path / f"{clip.stem}.lab"
    lab.write_text(BAD_ALIGNMENTS[fault][0])
    args = {
        "train": ("train", clip, "--alignments", tmp_path, "--out", out / "m.mmm"),
        "evaluate": ("evaluate", model, clip, "--alignments", tmp_path),
        "speak": ("speak", model, "--audio", clip, "--alignment", lab, "--out", out / "s.mp4"),
    }
    assert_refused(mmmgpu(*args[command]), lab, BAD_ALIGNMENTS[fault][1])
    assert list(out.iterdir()) == []


@pytest.mark.parametrize("command", ["train", "evaluate"])
def test_alignment_that_ends_after_the_clip(mmmgpu, world, model, command, tmp_path, out):
    clip = world.clips[0]
    lab = tmp_path / f"{clip.stem}.lab"
    lab.write_text("0.0 1.0 SIL\n1.0 9.5 AA\n")
    first = {"train": ("train",), "evaluate": ("evaluate", model)}[command]
    last = {"train": ("--out", out / "m.mmm"), "evaluate": ()}[command]
    ended = mmmgpu(*first, clip, "--alignments", tmp_path, *last)
    assert_refused(ended, lab, "ends at 9.50 s", "give the alignment of this clip")


def test_no_alignment_of_a_clip(mmmgpu, world, tmp_path, out):
    args = ("--alignments", tmp_path, "--out", out / "m.mmm")
    ended = mmmgpu("train", world.clips[0], *args)
    assert_refused(ended, world.clips[0], "no alignment", "run mmmgpu align")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    speech = say("seven blue boats")
    path = tmp_path_factory.mktemp("recording") / "voice.wav"
    write_wav(path, speech.samples, speech.rate)
    return path


WRONG_WORDS = "we hold these truths to be self evident that all men are created equal"


def test_transcript_that_does_not_match(mmmgpu, model, recording, tmp_path, out):
    (tmp_path / "voice.txt").write_text(WRONG_WORDS)
    ended = mmmgpu("align", recording, "--transcripts", tmp_path, "--out", out)
    assert ended.status == 1
    assert f"mmmgpu: error: {recording}: the transcript 'we hold" in ended.err
    spoken = ("--audio", recording, "--transcript", WRONG_WORDS, "--out", out / "s.mp4")
    assert_refused(mmmgpu("speak", model, *spoken), "does not match the sound")
    assert list(out.iterdir()) == []


@pytest.mark.parametrize(
    ("content", "words"),
    [(None, "cannot be read"), (b"\xff\xfe\x00\xd8", "UTF-8"), (b"a line\n", "NAME<tab>")],
)
def test_bad_transcripts(mmmgpu, recording, world, tmp_path, out, content, words):
    place = tmp_path / "said.tsv"
    if content is not None:
        place.write_bytes(content)
    clips = (recording, world.clips[0])
    ended = mmmgpu("align", *clips, "--transcripts", place, "--out", out)
    assert_refused(ended, place, words)


@pytest.fixture
def by_hmms(mmmgpu, tmp_path, out):
    """Align a good clip of a made-up language and another, NAME.*, with its transcript."""
    samples, _ = hmms.utter("mása so", np.random.default_rng(0))
    (tmp_path / "words.dict").write_text(hmms.LEXICON, encoding="utf-8")
    sounds = {"good": samples, "short": samples[:1600], "silent": np.zeros(16000)}
    for name, sound in sounds.items():
        write_wav(tmp_path / f"{name}.wav", sound, hmms.RATE)
        (tmp_path / f"{name}.txt").write_text("mása so", encoding="utf-8")

    def run(clip, text=None, *, dictionary="words.dict"):
        clip = tmp_path / clip
        if text is not None:
            clip.with_suffix(".txt").write_text(text, encoding="utf-8")
        args = ("--transcripts", tmp_path, "--dictionary", tmp_path / dictionary)
        clips = (tmp_path / "good.wav", clip)
        return mmmgpu("align", *clips, *args, "--out", out, "--aligner", "hmm")

    return run


@pytest.mark.parametrize(
    ("clip", "text", "words"),
    [
        ("silent.mkv", "so", "has no sound; give a file with sound"),
        ("silent.wav", None, "the sound is silent"),
        (
            "short.wav",
            None,
            "takes at least 0.18 s to say but the sound lasts 0.10 s; give the words",
        ),
        ("short.wav", " ...\n", "the transcript has no words; give what is said"),
        ("short.wav", "so, ugo", "'ugo' is not in the dictionary {}; add it there"),
    ],
)
def test_one_bad_clip_among_those_to_learn_from(by_hmms, clip, text, words, tmp_path, out, frames):
    encode(tmp_path / "silent.mkv", frames)
    ended = by_hmms(clip, text)
    assert ended.status == 1
    (line,) = [line for line in ended.err.splitlines() if "error: " in line]
    assert line.startswith(f"mmmgpu: error: {tmp_path / clip}: ")
    assert words.format(tmp_path / "words.dict") in line
    assert [p.name for p in out.iterdir()] == ["good.TextGrid"]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "cannot be read"),
        (b"so s o\nso\n", "a.dict:2: expected 'word PHONE PHONE ...'"),
        (b"\xff\xfe\x00\xd8", "UTF-8"),
        (b"", "holds no word"),
    ],
)
def test_bad_dictionary(by_hmms, tmp_path, out, content, words):
    if content is not None:
        (tmp_path / "a.dict").write_bytes(content)
    assert_refused(by_hmms("short.wav", dictionary="a.dict"), tmp_path / "a.dict", words)
    assert list(out.iterdir()) == []


def test_no_clip_to_learn_from(by_hmms, tmp_path, out):
    (tmp_path / "good.txt").write_text("")
    ended = by_hmms("short.wav")
    assert (ended.status, ended.out) == (1, "")
    assert ended.err.count("mmmgpu: error: ") == 2
    assert list(out.iterdir()) == []


def retold(model, path, *, header=str, tensor="w_f", change=np.copy):
    """The model at `model` with the text of its header and one tensor changed."""
    with safe_open(str(model), framework="numpy") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        text = file.metadata()[HEADER]
    tensors[tensor] = np.ascontiguousarray(change(tensors[tensor]))
    save_file(tensors, str(path), metadata={HEADER: header(text)})
    return path


def told(**facts):
    """A change of a header that makes it say `facts`."""
    return lambda text: json.dumps({**json.loads(text), **facts})


def with_nan(array):
    array = array.copy()
    array.flat[0] = np.nan
    return array


def pickled(path):
    path.write_bytes(pickle.dumps({"weights": [1, 2, 3]}))
    return path


UNREADABLE = "truncated, damaged or not a model"
BAD_MODELS = {
    "truncated": (lambda m, p: cut(retold(m, p), 0.5), UNREADABLE),
    "empty": (lambda m, p: cut(retold(m, p), 0), UNREADABLE),
    "pickle": (lambda m, p: pickled(p), UNREADABLE),
    "newer": (lambda m, p: retold(m, p, header=told(version=VERSION + 1)), "update mmmgpu"),
    "of others": (lambda m, p: retold(m, p, header=told(format="x")), "not a mmmgpu model"),
    "bad header": (lambda m, p: retold(m, p, header=lambda text: "{"), "not a mmmgpu model"),
    "wrong shape": (
        lambda m, p: retold(m, p, tensor="flows", change=lambda a: a[:, 1:]),
        "tensor flows must be",
    ),
    "wrong type": (
        lambda m, p: retold(m, p, tensor="w_t", change=lambda a: a.astype("f8")),
        "tensor w_t must be",
    ),
    "NaN": (
        lambda m, p: retold(m, p, tensor="alpha.trained.mean", change=with_nan),
        "tensor alpha.trained.mean holds NaN",
    ),
    "missing": (lambda m, p: p, "no such model file"),
}


def test_a_model_told_anew_is_good(mmmgpu, model, tmp_path):
    assert mmmgpu("info", retold(model, tmp_path / "again.mmm")).status == 0


@pytest.mark.parametrize("fault", BAD_MODELS)
def test_bad_model(mmmgpu, model, fault, tmp_path, world, out):
    make, words = BAD_MODELS[fault]
    bad = make(model, tmp_path / "bad.mmm")
    assert_refused(mmmgpu("info", bad), bad, words)
    assert_refused(mmmgpu("speak", bad, "--text", "hi", "--out", out / "s.mp4"), bad, words)
    assert list(out.iterdir()) == []


@pytest.fixture
def no_long_work(monkeypatch):
    """An output is looked at before anything that takes long."""

    def begin(*args, **kwargs):
        raise AssertionError("the long work has begun")

    for module, name in ((training, "train"), (reconstruction, "reconstruct")):
        # defaults are still read from the real one's signature
        monkeypatch.setattr(module, name, functools.wraps(getattr(module, name))(begin))
    monkeypatch.setattr(aligner, "align_speech", begin)


@pytest.mark.parametrize("command", ["train", "reconstruct", "align"])
def test_output_below_a_file(mmmgpu, world, model, recording, command, tmp_path, no_long_work):
    (tmp_path / "file").write_text("mine")
    out = tmp_path / "file" / "out.mkv"
    clip = world.clips[0]
    args = {
        "train": ("train", clip, "--alignments", world.alignments, "--out", out),
        "reconstruct": ("reconstruct", model, clip, "--out", out),
        "align": ("align", recording, "--transcripts", tmp_path, "--out", out),
    }
    assert_refused(mmmgpu(*args[command]), tmp_path / "file", "choose another name")
    assert (tmp_path / "file").read_text() == "mine"


def test_output_folder_that_may_not_be_written(mmmgpu, world, out, monkeypatch, no_long_work):
    """Root may write anywhere, so the answer of the system is made up."""
    really_open = os.open

    def refuse(path, flags, *args, **kwargs):
        if flags & os.O_CREAT and str(out) in str(path):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return really_open(path, flags, *args, **kwargs)

    monkeypatch.setattr(os, "open", refuse)
    args = ("--alignments", world.alignments, "--out", out / "m.mmm")
    ended = mmmgpu("train", world.clips[0], *args)
    assert_refused(ended, out / "m.mmm", "permission denied", "choose a folder")


def test_output_that_is_a_folder_or_an_input(mmmgpu, model, world, tmp_path):
    (tmp_path / "x.mp4").mkdir()
    ended = mmmgpu("speak", model, "--text", "hi", "--out", tmp_path / "x.mp4")
    assert_refused(ended, tmp_path / "x.mp4", "it is a folder")
    before = world.clips[0].read_bytes()
    ended = mmmgpu("reconstruct", model, world.clips[0], "--out", world.clips[0])
    assert_refused(ended, world.clips[0], "would replace what is read")
    assert world.clips[0].read_bytes() == before


def test_output_that_is_no_video(mmmgpu, model, out):
    ended = mmmgpu("speak", model, "--text", "hi", "--out", out / "x.gif")
    assert_refused(ended, out / "x.gif", ".mp4")


@pytest.mark.parametrize("command", ["train", "speak", "align"])
def test_full_disk(mmmgpu, model, world, recording, command, tmp_path, out, monkeypatch):
    def full(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    (tmp_path / "voice.txt").write_text("seven blue boats")
    clip = world.clips[0]
    args = {
        "train": ("train", clip, "--alignments", world.alignments, "--out", out / "m.mmm"),
        "speak": ("speak", model, "--text", "hi", "--out", out / "s.mp4"),
        "align": ("align", recording, "--transcripts", tmp_path, "--out", out),
    }
    monkeypatch.setattr(os, "fsync", full)
    ended = mmmgpu(*args[command])
    assert ended.status == 1
    assert ended.err.count("mmmgpu: error: ") == 1
    assert "the disk is full: free some space" in ended.err
    assert [path for path in out.rglob("*") if path.is_file()] == []


@pytest.mark.skipif(sys.platform == "win32", reason="needs limits on the size of files")
@pytest.mark.parametrize("command", ["train", "speak", "own background"])
def test_no_room_for_the_rest_of_a_file(model, world, command, out):
    """The system refuses in the middle of a file, in a library's own code or in a worker."""
    spoken = ("speak", model, "--text", "hi", "--out", "s.mkv")
    args = {
        "train": ("train", world.clips[0], "--alignments", world.alignments, "--out", "m.mmm"),
        "speak": (*spoken, "--lossless", "--background", world.clips[0]),
        "own background": spoken,
    }
    limited = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000)); "
    done = start(*args[command], before=limited, cwd=out)
    _, err = done.communicate()
    assert done.returncode == 1
    assert "Traceback" not in err
    assert err.count("mmmgpu: error: ") == 1
    assert "cannot write" in err
    assert "defect" not in err
    left = {path.name for path in out.rglob("*") if path.is_file()}
    assert left <= {"fingerprint"}


def start(*args, before="", cwd=None):
    """``mmmgpu ARGS...`` in a process of its own, where Ctrl-C works in any case."""
    program = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
        f"{before}from mmmgpu.cli import main; main()"
    )
    return subprocess.Popen(
        [sys.executable, "-c", program, *map(str, args)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=cwd,
    )


def interrupt_when(condition, process):
    """Send SIGINT once `condition()` holds; return status, outputs and how long the end took."""
    while not condition():
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    begin = time.monotonic()
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=20)
    return process.returncode, out, err, time.monotonic() - begin


def test_interrupted_training_keeps_its_steps(world, out):
    steps = out / "m.mmm.work"
    process = start("train", *world.clips, "--alignments", world.alignments, "--out", out / "m.mmm")
    status, said, err, seconds = interrupt_when(lambda: list(steps.glob("track-*.npz")), process)
    assert (status, said) == (130, "")
    assert seconds < 2  # what is promised, not how fast it is
    assert "Traceback" not in err
    assert err.count("mmmgpu: interrupted; ") == 1
    assert "the same command continues" in err
    assert [path.name for path in out.iterdir()] == ["m.mmm.work"]
    assert {path.suffix for path in steps.iterdir()} == {"", ".npz"}
    assert not any(path.name.startswith(".") for path in steps.iterdir())


def test_interrupted_video_is_not_left(world, model, out):
    process = start("speak", model, "--text", "word " * 400, "--out", out / "s.mp4")
    status, said, err, seconds = interrupt_when(lambda: list(out.glob(".mmmgpu-*")), process)
    assert (status, said) == (130, "")
    assert seconds < 2
    assert err.count("mmmgpu: interrupted; ") == 1
    assert "Traceback" not in err
    assert list(out.iterdir()) == []


def test_interrupt_inside_a_library(out):
    """A main thread that never comes back to Python is ended by the watching thread."""
    stuck = (
        "import hashlib, pathlib; import mmmgpu.cli as c; "
        "c.app = lambda: (pathlib.Path('ready').touch(), busy()); "
        "busy = lambda: hashlib.pbkdf2_hmac('sha256', b'', b'', 10 ** 9); "
    )
    process = start(before=stuck, cwd=out)
    status, _, err, seconds = interrupt_when((out / "ready").exists, process)
    assert (status, seconds < 2) == (130, True)
    assert err.count("mmmgpu: interrupted; ") == 1


# ---- odd, but not bad -----------------------------------------------------------------------


def rotated(path, frames):
    """Turned by a quarter, with a matrix that turns it back."""
    turned = [np.ascontiguousarray(np.rot90(frame)) for frame in frames]
    clip = encode(path / "rotated.mp4", turned, codec="libx264", pixels="yuv420p")
    set_display_matrix(clip, 0, 1, -1, 0)
    return clip


def variable(path, frames):
    ticks = np.cumsum([0, *(40 if t % 3 else 60 for t in range(len(frames) - 1))])
    return encode(path / "variable.mkv", frames, ticks=ticks.tolist(), clock=1000)


def ntsc(path, frames):
    rate = Fraction(30000, 1001)
    return encode(path / "ntsc.mp4", frames, codec="libx264", pixels="yuv420p", rate=rate)


def grey(path, frames):
    return encode(path / "grey.mkv", frames, pixels="gray")


def quiet(path, frames):
    """Mono sound of 8 bits."""
    samples = tone(len(frames) / 25, 8000)
    recipe = {"codec": "pcm_u8", "sample_format": "u8"}
    return encode_sound(path / "quiet.mkv", samples, 8000, frames=frames, **recipe)


@pytest.mark.parametrize("make", [rotated, variable, ntsc, grey, quiet])
def test_odd_video_works(mmmgpu, model, make, tmp_path, frames):
    clip, out = make(tmp_path, frames), tmp_path / "out.mkv"
    ended = mmmgpu("reconstruct", model, clip, "--out", out, "--lossless")
    assert ended.status == 0
    given, made = probe(clip), probe(out)
    assert (made.width, made.height) == (144, 160)
    assert (made.fps, made.frames, made.has_sound) == (given.fps, given.frames, given.has_sound)
    first, last = next(read_frames(out)), next(read_frames(clip))
    assert np.abs(first[:20].astype(int) - last[:20]).max() == 0  # upright, above the mouth


def test_training_on_odd_videos(mmmgpu, tmp_path, frames, region, world):
    """Turned, grey, with mono sound of 8 bits: none hinders training."""
    grey_frames = [np.repeat(f.mean(axis=2, keepdims=True), 3, axis=2) for f in frames]
    clips = [
        quiet(tmp_path, [f.astype(np.uint8) for f in grey_frames]),
        rotated(tmp_path, frames),
        grey(tmp_path, frames),
    ]
    for clip in clips:
        clip.with_suffix(".lab").write_text("0.0 0.3 SIL\n0.3 0.8 AA\n")
    args = ("--alignments", tmp_path, "--region", region, "--prototypes", 3)
    ended = mmmgpu("train", *clips, *args, "--out", tmp_path / "m.mmm")
    assert ended.status == 0
    assert load(tmp_path / "m.mmm").notes["skipped"] == {}


@pytest.mark.parametrize("name", ["two words.mkv", "vidéo 視頻 ☺.mkv", "-x.mkv", "-x.mkv#./"])
def test_odd_names_work(mmmgpu, model, frames, name, tmp_path, monkeypatch):
    """A leading dash behind -- and behind ./ ; results may have such names as well."""
    monkeypatch.chdir(tmp_path)
    name, _, above = name.partition("#")
    encode(tmp_path / name, frames)
    (tmp_path / f"m {name}").write_bytes(model.read_bytes())
    before = ("--",) if name.startswith("-") and not above else ()
    out = f"--out=./out of {name}"
    ended = mmmgpu("reconstruct", out, f"--json={name}.json", *before, f"m {name}", above + name)
    assert ended.status == 0
    assert probe(tmp_path / f"out of {name}").frames == N_ODD
    assert (tmp_path / f"{name}.json").is_file()


def test_folder_without_video(mmmgpu, model, tmp_path):
    ended = mmmgpu("evaluate", model, tmp_path, "--alignments", tmp_path)
    assert_refused(ended, tmp_path, "no video in this folder")


def test_unknown_backend(mmmgpu, model, out):
    ended = mmmgpu("speak", model, "--text", "hi", "--out", out / "s.mp4", "--backend", "abacus")
    assert_refused(ended, "'abacus'", "choose one of")


def test_trajectory_of_another_model(mmmgpu, model, tmp_path, out):
    (tmp_path / "t.csv").write_text("time,phone,alpha0,beta0,beta1\n0,SIL,0,1,0\n")
    spoken = ("--from-trajectory", tmp_path / "t.csv", "--out", out / "s.mp4")
    assert_refused(mmmgpu("speak", model, *spoken), tmp_path / "t.csv", "columns")


def test_same_clip_twice(mmmgpu, world, tmp_path, out):
    copy = tmp_path / world.clips[0].name
    copy.write_bytes(world.clips[0].read_bytes())
    args = ("--alignments", world.alignments, "--out", out / "m.mmm")
    ended = mmmgpu("train", world.clips[0], copy, *args)
    assert_refused(ended, copy.name, "rename one")
