import json
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from test_reconstruction import make_person, write_clip
from worlds import POSTURES, hold, make_model, say, sentence_motion

from mmmgpu.alignments import write_textgrid
from mmmgpu.corpora import open_corpus
from mmmgpu.errors import InputError
from mmmgpu.evaluation import evaluate, measure_reconstruction
from mmmgpu.models import project_on_simplex, trajectories
from mmmgpu.performer import landmarks
from mmmgpu.reconstruction import Analysed, analyse_clip
from mmmgpu.tracks import Track
from mmmgpu.video_writing import write_video
from mmmgpu.videos import read_frames

LABELS = ["SIL", "SIL", "AA", "UW", "IY"]


def save_landmarks(folder, name, face, motion):
    points = [landmarks(face, motion, t) for t in range(len(motion.pose))]
    np.savez(folder / f"{name}.npz", points=np.array(points, np.float32))


# ---- reconstructions ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def still(face_and_basis, tmp_path_factory):
    """A clip of `POSTURES` with the landmarks beside it; the head keeps still."""
    face, motion = face_and_basis[0], hold(*POSTURES)
    clip = write_clip(tmp_path_factory.mktemp("still") / "still.mkv", face, motion)
    save_landmarks(clip.parent, "still", face, motion)
    return clip


def measured(model, clip, made):
    count = len(POSTURES)
    poses = np.stack([np.eye(3)] * count)
    track = Track(poses, np.ones(count, bool), np.ones(count), np.ones(3), np.zeros(3), 0.0)
    analysed = Analysed(track, np.zeros((count, 4)), np.zeros((count, 5)))
    return measure_reconstruction(model, clip, made, analysed, labels=LABELS, landmarks=clip.parent)


def changed(clip, out, change):
    """A copy of `clip` in which `change(t, frame)` has been done to every frame."""
    frames = [frame.copy() for frame in read_frames(clip)]
    for t, frame in enumerate(frames):
        change(t, frame)
    write_video(out, frames, fps=25, lossless=True)
    return out


def test_a_copy_is_perfect(basis, still):
    result = measured(make_model(basis), still, still)
    part = {"psnr_db": 99.0, "psnr_of_mean_error_db": 99.0, "worst_frame_db": 99.0}
    for name in ("speech", "silence"):
        assert result[name].pop("ssim") == pytest.approx(1, abs=1e-12)
        assert result[name] == pytest.approx(part)
    assert result["least_cover_in_hull"] > 0.5
    del result["speech"], result["silence"], result["least_cover_in_hull"]
    assert result == {"clip": "still.mkv", "frames": 5, "pixels_changed_outside_cover": 0}


def test_errors_count_where_they_are(basis, still, tmp_path):
    def worse(t, frame):
        frame[0, :3] ^= 1  # far outside the cover
        if t >= 2:
            frame[...] ^= 1 if t < 4 else 2

    made = changed(still, tmp_path / "worse.mkv", worse)
    result = measured(make_model(basis), still, made)
    db = [20 * np.log10(255), 20 * np.log10(255), 20 * np.log10(255 / 2)]
    assert result["silence"]["psnr_db"] == 99
    assert result["speech"]["psnr_db"] == pytest.approx(np.mean(db))
    assert result["speech"]["worst_frame_db"] == pytest.approx(db[2])
    assert result["speech"]["psnr_of_mean_error_db"] == pytest.approx(10 * np.log10(255**2 / 2))
    assert 0.9 < result["speech"]["ssim"] < 1
    assert result["pixels_changed_outside_cover"] > 3 * 5000
    few = changed(still, tmp_path / "few.mkv", lambda t, f: np.add(f[0, :2], 1, out=f[0, :2]))
    result = measured(make_model(basis), still, few)
    assert result["pixels_changed_outside_cover"] == 2 * 5
    assert result["speech"]["psnr_db"] == 99


def test_a_clip_all_silent_has_no_speech(basis, still, monkeypatch):
    monkeypatch.setitem(globals(), "LABELS", ["SIL"] * 5)
    result = measured(make_model(basis), still, still)
    assert "speech" not in result
    assert "silence" in result


# ---- synthesis ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def person(face_and_basis, still):
    return make_person(face_and_basis, still)


@pytest.fixture(scope="module")
def clips(face_and_basis, tmp_path_factory):
    """Two clips of half a second, with their alignments and true landmarks beside them."""
    face = face_and_basis[0]
    folder = tmp_path_factory.mktemp("clips")
    for i, sentence in enumerate(("AA M UW", "M AE P")):
        alignment = say(sentence, phone=0.1, silence=0.12)
        motion = sentence_motion(face, alignment, np.random.default_rng(i))
        clip = write_clip(folder / f"clip {i}.mkv", face, motion)
        write_textgrid(alignment, clip.with_suffix(".TextGrid"))
        save_landmarks(folder, clip.stem, face, motion)
    save_landmarks(folder, "postures", face, hold(*POSTURES))
    return sorted(folder.glob("*.mkv"))


@pytest.fixture(scope="module")
def result(person, clips):
    folder = clips[0].parent
    return evaluate(person, clips, folder, landmarks=folder, backend="numpy")


def numbers(value):
    if isinstance(value, dict):
        return [n for inner in value.values() for n in numbers(inner)]
    return [value] if isinstance(value, int | float) else []


def test_every_number_is_finite_json(result):
    assert result == json.loads(json.dumps(result, allow_nan=False))
    assert set(result) == {"clips", "alpha", "beta", "lips"}
    assert result["clips"] == ["clip 0.mkv", "clip 1.mkv"]
    assert len(numbers(result)) > 80
    assert np.isfinite(numbers(result)).all()


def test_errors_are_the_root_mean_squares(person, clips, result):
    """Clip by clip, and then the mean of the clips."""
    rms = defaultdict(list)
    for clip in open_corpus(clips, clips[0].parent):
        analysed = analyse_clip(person, clip.path, backend="numpy")
        speech = np.array([label != "SIL" for label in clip.labels])
        assert 0 < speech.sum() < len(speech)
        for kind in ("pooled", "trained"):
            made = trajectories(person, clip.labels, kind=kind)
            real = analysed.alpha, analysed.beta
            for stream, y, z in zip(("alpha", "beta"), made, real, strict=True):
                rms[stream, "all", kind].append(np.sqrt(((y - z) ** 2).sum() / y.size))
                rms[stream, "speech", kind].append(np.sqrt(((y - z)[speech] ** 2).mean()))
        miss = project_on_simplex(made[1]) - analysed.beta
        rms["simplex"].append(np.sqrt((miss**2).mean()))
    simplex = rms.pop("simplex")
    for (stream, part, kind), values in rms.items():
        entry = result[stream][part]["rms"][kind]
        assert entry["mean"] == pytest.approx(np.mean(values), rel=1e-9)
        assert entry["clips"] == 2
    entry = result["beta"]["all"]["rms_trained_on_simplex"]
    assert entry["mean"] == pytest.approx(np.mean(simplex), rel=1e-9)


def test_the_gain_is_pooled_minus_trained(result):
    for stream in ("alpha", "beta"):
        for part in ("all", "speech"):
            entry = result[stream][part]
            gain = entry["rms"]["pooled"]["mean"] - entry["rms"]["trained"]["mean"]
            assert entry["rms_gain"]["mean"] == pytest.approx(gain)


def test_the_analysed_lips_are_where_they_are(result):
    """True landmarks of the performer: analysis follows them, a made-up model does not."""
    lips = result["lips"]
    assert 0 < lips["distance_px_speech"]["analysed"]["mean"] < 1.5
    for kind in ("pooled", "trained"):
        assert lips["distance_px_speech"][kind]["mean"] > 1.5
    gain = lips["distance_px_speech"]["pooled"]["mean"]
    gain -= lips["distance_px_speech"]["trained"]["mean"]
    assert lips["distance_gain_px"]["mean"] == pytest.approx(gain)
    assert lips["opening_all"]["analysed"]["correlation"] > 0.8
    assert 0.4 < lips["opening_all"]["analysed"]["variance_ratio"] < 1.6


def test_clips_of_the_training_are_told(person, clips):
    known = replace(person, notes={"clips": ["clip 0.mkv", "other.mkv"]})
    result = evaluate(known, clips[:1], clips[0].parent, backend="numpy")
    assert result["also_in_training"] == ["clip 0.mkv"]
    assert "lips" not in result
    assert result["alpha"]["all"]["rms"]["pooled"]["half_width_95"] is None


def test_another_frame_rate_is_refused(basis, clips):
    with pytest.raises(InputError, match=r"clip 0\.mkv: has 25 frames/s, the model 29\.97"):
        evaluate(make_model(basis), clips[:1], clips[0].parent)


def test_missing_landmarks_are_named(person, clips, tmp_path):
    (tmp_path / "postures.npz").write_bytes(clips[0].with_name("postures.npz").read_bytes())
    with pytest.raises(InputError, match=r"clip 0\.npz: no landmarks"):
        evaluate(person, clips[:1], clips[0].parent, landmarks=tmp_path, backend="numpy")
