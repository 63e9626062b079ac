import numpy as np
import pytest
from commands import SMALL, trained_model
from pairs import write_landmarks

from mmmgpu.aam import features
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
    aam = features_named("aam", landmarks=tmp_path, **given | {"options": {"parameters": 4}})
    assert aam == AamFeatures(tmp_path, "numpy", {"parameters": 4})
    assert aam.facts() != AamFeatures(tmp_path, "numpy").facts()
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
    drawn = []
    monkeypatch.setattr("mmmgpu.comparison_features._write", lambda *given: None)
    monkeypatch.setattr(
        "mmmgpu.comparison_features.reconstructed_frames",
        lambda model, path, analysed, *, backend: drawn.append(analysed),
    )
    eye.render(clips[2], y, tmp_path / "none.mp4")
    np.testing.assert_array_equal(drawn[0].alpha, seen.alpha)
    np.testing.assert_allclose(drawn[0].beta, seen.beta, atol=1e-9)


def test_features_of_an_appearance_model_are_shown_as_faces(world, clips, tmp_path):
    write_landmarks(world)
    source = AamFeatures(world.alignments, "warp", {"parameters": 30})
    eye = source.learn(clips[:2], tmp_path, 0)
    y = eye.features(clips[2])
    assert y.shape == (clips[2].info.frames, 30)
    np.testing.assert_array_equal(y, features(eye.aam, clips[2].path, world.alignments))
    eye.render(clips[2], y, tmp_path / "reality.mp4")
    eye.render(clips[2], np.zeros_like(y), tmp_path / "still.mp4")
    info = probe(tmp_path / "reality.mp4")
    assert (info.frames, info.has_sound) == (clips[2].info.frames, True)
    shown, still, real = (
        np.array(list(read_frames(name)), np.float32)
        for name in (tmp_path / "reality.mp4", tmp_path / "still.mp4", clips[2].path)
    )
    moved = np.abs(shown - still) > 8
    assert moved.mean() > 0.001
    assert np.abs(shown - real)[moved].mean() < 0.5 * np.abs(still - real)[moved].mean()
