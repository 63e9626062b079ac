import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from worlds import FPS, RATE, texture

import mmmgpu.corpus_steps
from mmmgpu import load
from mmmgpu.analysis import analyze, prepare_analysis
from mmmgpu.backends import get_backend
from mmmgpu.dynamics import trajectory
from mmmgpu.errors import InputError
from mmmgpu.files import TEMPORARY
from mmmgpu.models import project_on_simplex, trajectories
from mmmgpu.synthesis import synthesize
from mmmgpu.tracks import crops, track_clip
from mmmgpu.training import Options, train
from mmmgpu.video_writing import write_video
from mmmgpu.videos import read_frames

pytestmark = pytest.mark.usefixtures("kept")

OPTIONS = Options(prototypes=6, seed=2)
CHILD = """
import sys
from mmmgpu.training import Options, train
out, folder, count, *clips = sys.argv[1:]
train(clips, folder, out, options=Options(prototypes=int(count), seed=2))
"""


@pytest.fixture(scope="module")
def trained(world, tmp_path_factory):
    """The path of a model trained without interruption, and the model."""
    out = tmp_path_factory.mktemp("model") / "person ü.mmm"
    return out, train(world.clips, world.alignments, out, options=OPTIONS)


def child(out, world, *, prototypes=6, clips=None):
    """A process that trains."""
    names = [str(clip) for clip in clips or world.clips]
    folder = str(names and os.path.dirname(names[0]))
    command = [sys.executable, "-c", CHILD, str(out), folder, str(prototypes), *names]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def test_a_person_is_learned(world, trained):
    out, model = trained
    assert [p.name for p in out.parent.iterdir()] == [out.name]  # nothing else is left
    basis = model.basis
    h, w = basis.region.shape
    assert basis.images.shape == (6, h, w, 3)
    assert basis.flows.shape == (6, h, w, 2)
    np.testing.assert_array_equal(basis.flows[basis.reference], 0)
    assert np.abs(basis.flows).max() > 1
    assert model.fps == FPS
    assert model.frame_size == (144, 160)
    assert len(set(model.sources)) == 6
    assert model.alpha.trained.mean.shape[1] == 5
    assert model.beta.trained.mean.shape[1] == 6
    assert set(model.alpha.trained.labels) == {
        label for sentence in world.sentences for label in sentence.split()
    } | {"SIL"}
    assert model.notes["clips"] == [clip.name for clip in world.clips]
    assert model.notes["skipped"] == {}
    assert model.notes["frames"] == sum(len(motion) for motion in world.motions)
    assert model.calm.data.tobytes() in {clip.read_bytes() for clip in world.clips}
    assert load(out).sources == model.sources
    assert set(model.dynamics) == {"hmm", "brand", "slds", "dpds"}
    for pair in model.dynamics.values():
        assert [trajectory(one, ["SIL"]).shape for one in pair] == [(1, 5), (1, 6)]
        assert pair[0].labels == model.alpha.trained.labels


def test_prototypes_are_the_frames_that_are_named(world, trained):
    model = trained[1]
    for (name, t), picture in zip(model.sources, model.prototype_frames, strict=True):
        clip = next(c for c in world.clips if c.name == name)
        np.testing.assert_array_equal(next(read_frames(clip, start=t, stop=t + 1)), picture)
    x, y, w, h = model.basis.region.box
    frame = model.prototype_frames[model.basis.reference][y : y + h, x : x + w]
    np.testing.assert_allclose(  # the reference is seen through the identity
        model.basis.images[model.basis.reference], frame / 255, atol=1e-3
    )


def test_the_reference_is_at_rest(world, trained):
    """Its mouth is about as closed as that of silence."""
    model = trained[1]
    name, t = model.sources[model.basis.reference]
    i = [clip.name for clip in world.clips].index(name)
    jaw = world.motions[i].values[:, 0]
    assert jaw[t] < np.quantile(np.concatenate([m.values[:, 0] for m in world.motions]), 0.5)


def test_frames_of_the_corpus_are_made_again(world, trained):
    model, kernels = trained[1], get_backend("warp")
    analyzer = prepare_analysis(model.basis, kernels)
    track = track_clip(world.clips[1], model.reference)
    errors = []
    for image in list(crops(world.clips[1], track, model.basis.region))[::6]:
        alpha, beta = analyze(analyzer, image)
        made = next(synthesize(model.basis, [alpha], [beta], backend="numpy"))
        weight = model.basis.w_t[..., None]
        errors.append(float((weight * (made - image) ** 2).sum() / (3 * weight.sum())))
    assert -10 * np.log10(np.mean(errors)) > 28


def test_silence_keeps_the_mouth_still(trained):
    model = trained[1]
    alpha, beta = trajectories(model, ["SIL"] * 20)
    np.testing.assert_allclose(alpha, np.broadcast_to(alpha[0], alpha.shape), atol=1e-6)
    assert project_on_simplex(beta).sum(axis=1) == pytest.approx(1)


def test_a_killed_training_continues_to_the_same_bytes(world, trained, tmp_path, monkeypatch):
    out = tmp_path / "again.mmm"
    work = tmp_path / "again.mmm.work"
    process = child(out, world)
    deadline = time.monotonic() + 120
    while not list(work.glob("analysis-*.npz")) and time.monotonic() < deadline:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert not out.exists()
    done = {path.name for path in work.glob("*.npz")}
    assert len([name for name in done if name.startswith("track-")]) == 4
    assert any(name.startswith("analysis-") for name in done)

    asked = []
    share_out = mmmgpu.corpus_steps.share_out

    def watched(prepare, shared, items, **options):
        asked.append(len(items))
        share_out(prepare, shared, items, **options)

    monkeypatch.setattr(mmmgpu.corpus_steps, "share_out", watched)
    train(world.clips, world.alignments, out, options=OPTIONS)
    assert asked[:2] == [0, 0]  # nothing is tracked or looked at again
    assert asked[2] < 8  # nor all analysed: stretches, two of each clip
    assert out.read_bytes() == trained[0].read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == [out.name]


def test_an_interrupt_leaves_no_half_written_step(world, tmp_path, monkeypatch):
    """The moment is chosen here: a process that tracks is killed over a file it writes."""
    work = tmp_path / "m.mmm.work"

    def killed(*_, **__):
        (work / f"{TEMPORARY}0.npz").write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(mmmgpu.corpus_steps, "share_out", killed)
    with pytest.raises(KeyboardInterrupt):
        train(world.clips, world.alignments, tmp_path / "m.mmm", options=OPTIONS)
    assert [path.name for path in work.iterdir()] == ["fingerprint"]


def copies(world, folder, count):
    """`count` clips with alignments in `folder`: those of the world, again and again."""
    clips = []
    for i in range(count):
        clip = world.clips[i % len(world.clips)]
        clips.append(folder / f"{i}.mkv")
        shutil.copy(clip, clips[-1])
        shutil.copy(clip.with_suffix(".TextGrid"), clips[-1].with_suffix(".TextGrid"))
    return clips


def test_a_clip_without_a_head_is_left_out(world, tmp_path, capsys):
    clips = copies(world, tmp_path, 3)
    wall = [(255 * texture(160, 144, seed=9)).astype(np.uint8)] * len(world.motions[2])
    noise = 0.1 * np.random.default_rng(0).standard_normal(int(len(wall) / FPS * RATE))
    sound = (noise.astype(np.float32), RATE)
    write_video(clips[2], wall, fps=FPS, sound=sound, lossless=True)
    model = train(clips, tmp_path, tmp_path / "a.mmm", options=Options(prototypes=4))
    assert list(model.notes["skipped"]) == ["2.mkv"]
    assert "head of the reference was found in 0 of" in model.notes["skipped"]["2.mkv"]
    assert model.notes["clips"] == ["0.mkv", "1.mkv"]
    assert {name for name, _ in model.sources} <= {"0.mkv", "1.mkv"}
    said = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    assert len(said) == 1
    assert "2.mkv" in said[0]


def peak(world, folder, count):
    """Most memory [MiB] of a training with `count` clips, the largest of its processes."""
    folder.mkdir()
    process = child(folder / "a.mmm", world, prototypes=4, clips=copies(world, folder, count))
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    said = process.stderr.read()
    process.stderr.close()
    assert process.returncode == 0, said
    return usage.ru_maxrss / 1024


def test_memory_does_not_grow_with_the_clips(world, tmp_path):
    few, many = (peak(world, tmp_path / str(count), count) for count in (2, 6))
    more = 4 * len(world.motions[0])  # frames, each 67 KiB as bytes and more as a region
    assert many - few < 6 + more * 2 / 1024


def test_bad_corpora_are_refused_before_any_work(world, tmp_path):
    clips = copies(world, tmp_path, 2)
    mute = [next(read_frames(clips[0]))] * len(world.motions[1])
    write_video(clips[1], mute, fps=FPS, lossless=True)
    with pytest.raises(InputError, match=r"1\.mkv: has no sound"):
        train(clips, tmp_path, tmp_path / "a.mmm")
    write_video(clips[1], mute, fps=24, lossless=True)
    with pytest.raises(InputError, match=r"1\.mkv: has 24 frames/s .*25"):
        train(clips, tmp_path, tmp_path / "a.mmm")
    assert not (tmp_path / "a.mmm.work").exists()
    assert not (tmp_path / "a.mmm").exists()


def test_too_many_prototypes_are_refused(world, tmp_path):
    clips = copies(world, tmp_path, 1)
    with pytest.raises(InputError, match=r"45 usable frames .* 46 prototypes; .*--prototypes"):
        train(clips, tmp_path, tmp_path / "a.mmm")
