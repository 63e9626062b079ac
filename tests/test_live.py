import io
import itertools
import subprocess
import sys
import weakref

import numpy as np
import pytest
from commands import assert_refused, run_command, trained_model
from test_speaking import person

from mmmgpu import backgrounds
from mmmgpu.compositing import composite_matched
from mmmgpu.errors import InputError
from mmmgpu.live import live, live_coordinates
from mmmgpu.model_files import load
from mmmgpu.models import moved_by, project_on_simplex
from mmmgpu.speaking import focused, scale_about, silent_mouth
from mmmgpu.synthesis import synthesize
from mmmgpu.videos import probe, read_frames

__all__ = ["person"]  # a fixture

LABELS = ["SIL", "AA", "AA", "M", "SIL", "M", "AA"]
STREAMING = ("hmm", "slds", "dpds")


def listening(labels):
    """An iterator over `labels` and the list of those that were taken."""
    taken = []

    def take():
        for label in labels:
            taken.append(label)
            yield label

    return take(), taken


@pytest.mark.parametrize("movement", STREAMING)
@pytest.mark.parametrize("factor", [1.0, 0.6])
def test_coordinates_are_those_of_the_whole_sentence(person, movement, factor):
    said = ["SIL", "AA", "B", "M"]  # B is not known
    alpha, beta = live_coordinates(person, said, movement=movement, articulation=factor)
    got = list(zip(alpha, beta, strict=True))
    wanted = moved_by(person, said, movement)
    wanted = [scale_about(y, n, factor) for y, n in zip(wanted, silent_mouth(person), strict=True)]
    np.testing.assert_allclose([a for a, _ in got], wanted[0], rtol=0, atol=1e-12)
    focussed = focused(project_on_simplex(wanted[1]))
    np.testing.assert_allclose([b for _, b in got], focussed, rtol=0, atol=1e-12)


def test_frames_are_the_mouth_on_the_model_s_own_background(person):
    basis, track = person.basis, person.calm.track
    frames = list(live(person, LABELS, movement="dpds"))
    alpha, beta = live_coordinates(person, LABELS, movement="dpds", articulation=1.0)
    images = synthesize(basis, alpha, beta, backend="numpy")
    shown = itertools.cycle([0, 1, 2, 1])  # the calm clip has three frames
    behind = frames_of_calm(person)
    for i, (frame, image, t) in enumerate(zip(frames, images, shown, strict=False)):
        rng = np.random.default_rng(i)
        given = behind[t], image, basis.cover, track.poses[t], track, basis.region, rng
        wanted = composite_matched(*given)
        assert np.abs(frame.astype(int) - wanted).max() <= 1
    assert len(frames) == len(LABELS)
    assert np.abs(frames[1].astype(int) - frames[3]).max() > 20  # the mouth moves


def frames_of_calm(model):
    """The frames of the clip that the model brings along."""
    data = io.BytesIO(model.calm.data.tobytes())
    import av

    with av.open(data) as media:
        return [frame.to_ndarray(format="rgb24") for frame in media.decode(video=0)]


@pytest.mark.parametrize("movement", STREAMING)
def test_a_frame_comes_before_the_next_label_is_taken(person, movement):
    labels, taken = listening(itertools.cycle(LABELS))
    frames = live(person, labels, movement=movement)
    assert taken == []
    for n in range(1, 10):
        next(frames)
        assert len(taken) == n
    frames.close()


@pytest.mark.parametrize("movement", STREAMING)
def test_what_is_past_is_not_kept(person, movement):
    class Label(str):
        pass

    given = []

    def labels():
        for text in itertools.cycle(LABELS):
            label = Label(text)
            given.append(weakref.ref(label))
            yield label

    pairs = zip(
        *live_coordinates(person, labels(), movement=movement, articulation=1.0), strict=True
    )
    seen = [tuple(map(weakref.ref, next(pairs))) for _ in range(1000)]
    assert sum(r() is not None for r in given) <= 120  # `tee` frees them by the block
    assert sum(r() is not None for pair in seen for r in pair) <= 4


def test_frames_that_were_shown_are_not_kept(person, monkeypatch):
    monkeypatch.setattr(backgrounds, "BYTES_KEPT", 1)
    frames = live(person, itertools.cycle(LABELS), movement="hmm")
    shown = [weakref.ref(next(frames)) for _ in range(15)]
    assert sum(r() is not None for r in shown) <= 1
    frames.close()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"movement": "brand"}, "'brand' needs the labels that follow.*dpds, hmm, slds"),
        ({"movement": "egp02"}, "'egp02' needs the labels that follow"),
        ({"movement": "magic"}, "'magic': the model has only"),
        ({"articulation": 2.0}, r"between 0\.5 and 1\.5"),
    ],
)
def test_what_cannot_be_done_is_said_before_a_label_is_taken(person, options, words):
    labels, taken = listening(LABELS)
    with pytest.raises(InputError, match=words):
        live(person, labels, **options)
    assert taken == []


# ---- the command ------------------------------------------------------------------------------


def test_the_command_answers_each_line_with_a_frame(world):
    path = trained_model(world)
    width, height = load(path).frame_size
    command = [sys.executable, "-m", "mmmgpu", "live", str(path), "--trajectory", "hmm"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe) as process:
        frames = []
        for label in ("SIL", "AA", "XX", "M"):
            process.stdin.write(f"{label}\n".encode())
            process.stdin.flush()
            frames.append(process.stdout.read(3 * width * height))  # before the next label
        process.stdin.close()
        assert process.stdout.read() == b""
        said = process.stderr.read().decode()
        assert process.wait(60) == 0
    assert [len(frame) for frame in frames] == [3 * width * height] * 4
    assert frames[0] != frames[1]
    assert f"{width} x {height} pixels, rgb24, 25 a second" in said
    assert "the model has not seen XX" in said


def give(monkeypatch, data):
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(data)))


def test_the_command_writes_a_video(world, tmp_path, monkeypatch, capfd):
    give(monkeypatch, b"SIL\nAA\nM\n")
    out = tmp_path / "live.mkv"
    ended = run_command(capfd, "live", trained_model(world), "--out", out, "--lossless")
    assert (ended.status, ended.out) == (0, "")
    assert probe(out).frames == 3
    given = list(live(load(trained_model(world)), ["SIL", "AA", "M"]))
    np.testing.assert_array_equal(list(read_frames(out)), given)


@pytest.mark.parametrize(
    ("data", "words"),
    [(b"SIL\n\nAA\n", ("line 2", "empty")), (b"", ("no labels", "standard input"))],
)
def test_bad_labels_leave_no_video(world, tmp_path, monkeypatch, capfd, data, words):
    give(monkeypatch, data)
    out = tmp_path / "live.mkv"
    ended = run_command(capfd, "live", trained_model(world), "--out", out)
    assert_refused(ended, *words)
    assert list(tmp_path.iterdir()) == []


def test_labels_that_are_no_text_have_a_stand_in(world, tmp_path, monkeypatch, capfd):
    give(monkeypatch, b"SIL\n\xff\xfe\n")
    ended = run_command(capfd, "live", trained_model(world), "--out", tmp_path / "live.mp4")
    assert ended.status == 0
    assert "has not seen" in ended.err
