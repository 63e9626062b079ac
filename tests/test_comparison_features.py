import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from commands import SMALL, trained_model

from mmmgpu.comparison_features import (
    AamFeatures,
    MmmFeatures,
    SavedFeatures,
    features_named,
)
from mmmgpu.corpora import open_corpus
from mmmgpu.errors import InputError
from mmmgpu.model_files import load
from mmmgpu.reconstruction import analyse_clip
from mmmgpu.training import Options
from mmmgpu.videos import probe, read_frames


@pytest.fixture(scope="module")
def clips(world):
    return open_corpus(world.clips, world.alignments)


def test_saved_features_are_those_of_the_clips_name(clips, tmp_path):
    y = np.arange(12.0).reshape(6, 2)
    np.savez(tmp_path / f"{clips[0].path.stem}.npz", features=y.astype(np.float32))
    saved = SavedFeatures(tmp_path)
    got = saved.learn(clips, tmp_path, 0).features(clips[0])
    np.testing.assert_array_equal(got, y)
    assert got.dtype == np.float64
    before = saved.facts()
    np.savez(tmp_path / f"{clips[0].path.stem}.npz", features=y[:3])
    assert saved.facts() != before


BAD = {
    "no file": None,
    "no array": lambda path: path.write_bytes(b"features"),
    "another name": lambda path: np.savez(path, points=np.ones(3)),
    "text": lambda path: np.savez(path, features=np.array(["a"])),
    "a pickle": lambda path: np.savez(path, features=np.array([{}], dtype=object)),
}


@pytest.mark.parametrize("fault", BAD)
def test_a_file_without_features_is_named(clips, tmp_path, fault):
    if BAD[fault]:
        BAD[fault](tmp_path / f"{clips[0].path.stem}.npz")
    with pytest.raises(InputError, match=r"clip 0\.npz: no features of .*array 'features'"):
        SavedFeatures(tmp_path).features(clips[0])
    with pytest.raises(InputError, match="no pictures"):
        SavedFeatures(tmp_path).render(clips[0], np.ones((1, 1)), tmp_path / "a.mp4")


def test_names_on_the_command_line(tmp_path):
    given = {"alignments": tmp_path, "options": {"sync": 0.5}, "backend": "numpy"}
    assert features_named("aam", landmarks=tmp_path, **given) == AamFeatures(tmp_path, "numpy")
    mmm = features_named("mmm", landmarks=None, **given)
    assert mmm == MmmFeatures(tmp_path, "numpy", Options(sync=0.5))
    assert features_named(str(tmp_path), landmarks=None, **given) == SavedFeatures(tmp_path)
    with pytest.raises(InputError, match="needs the landmarks"):
        features_named("aam", landmarks=None, **given)
    with pytest.raises(InputError, match=r"nothing: must be aam, mmm, or a folder"):
        features_named(str(tmp_path / "nothing"), landmarks=None, **given)


def test_a_morphable_model_is_trained_on_the_folds_clips_and_shows_others(
    world, clips, tmp_path, monkeypatch
):
    asked = []

    def train(paths, alignments, out, *, options, backend):
        asked.append((paths, alignments, out, options, backend))
        return load(trained_model(world))

    monkeypatch.setattr("mmmgpu.comparison_features.train", train)
    source = MmmFeatures(world.alignments, "warp", SMALL)
    eye = source.learn(clips[:2], tmp_path, 7)
    paths = [clip.path for clip in clips[:2]]
    assert asked == [(paths, world.alignments, tmp_path / "fold-7.mmm", SMALL, "warp")]
    y = eye.features(clips[2])
    seen = analyse_clip(eye.model, clips[2].path)
    np.testing.assert_array_equal(y, np.concatenate([seen.alpha, seen.beta], axis=1))
    eye.render(clips[2], y, tmp_path / "reality.mp4")
    info = probe(tmp_path / "reality.mp4")
    assert (info.frames, info.has_sound) == (clips[2].info.frames, True)
    still = np.tile(y[:1], (len(y), 1))
    eye.render(clips[2], still, tmp_path / "still.mp4")
    x, top, w, h = eye.model.basis.region.box

    def mouths(name):
        frames = read_frames(name)
        return np.array([f[top : top + h, x : x + w] for f in frames], np.float32)

    shown, real = mouths(tmp_path / "reality.mp4"), mouths(clips[2].path)
    assert np.abs(shown - real).mean() < 0.8 * np.abs(mouths(tmp_path / "still.mp4") - real).mean()
    assert source.facts() != MmmFeatures(world.alignments, "warp").facts()


def test_an_appearance_model_is_asked_for_features_and_faces(clips, tmp_path, monkeypatch):
    """The interface that is relied on, with a model that paints frames with its features."""
    asked = []

    def fit_aam(paths, landmarks, *, backend):
        asked.append((list(paths), landmarks, backend))
        return "the model"

    def features(aam, path, landmarks, *, backend):
        assert (aam, landmarks, backend) == ("the model", tmp_path, "numpy")
        return np.full((probe(path).frames, 1), 200.0)

    def complete_clip(aam, path, landmarks):
        return SimpleNamespace(points=np.zeros((probe(path).frames, 3, 2)))

    def render_face(aam, frame, points, c, kernels, *, where):
        assert points.shape == (3, 2)
        assert where.startswith(f"{clips[2].path}: frame ")
        return np.full_like(frame, c[0])

    door = {"fit_aam": fit_aam, "features": features, "complete_clip": complete_clip}
    for name, what in (("aam", door), ("aam_rendering", {"render_face": render_face})):
        module = ModuleType(name)
        vars(module).update(what)
        monkeypatch.setitem(sys.modules, f"mmmgpu.{name}", module)
    eye = AamFeatures(tmp_path, "numpy").learn(clips[:2], tmp_path, 0)
    assert asked == [([clip.path for clip in clips[:2]], tmp_path, "numpy")]
    y = eye.features(clips[2])
    eye.render(clips[2], y, tmp_path / "a.mp4")
    frames = list(read_frames(tmp_path / "a.mp4"))
    assert len(frames) == clips[2].info.frames
    assert np.abs(np.array(frames, np.float32) - 200).max() < 6
    assert probe(tmp_path / "a.mp4").has_sound
