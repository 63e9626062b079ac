"""The door to appearance models: whole clips in, features and frames out."""

import shutil

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmmgpu.aam import complete_clip, features, reconstruct, see_clip
from mmmgpu.appearances import synthesize_shape
from mmmgpu.errors import InputError
from mmmgpu.pictures import psnr
from mmmgpu.shapes import place
from mmmgpu.videos import read_frames


@pytest.fixture(scope="module")
def seen(drawn):
    return see_clip(drawn.aam, drawn.held_out, drawn.folder)


def test_every_frame_has_features(drawn, seen):
    c = features(drawn.aam, drawn.held_out, drawn.folder)
    assert c.dtype == np.float64
    assert c.shape == (len(drawn.points(drawn.held_out)), len(drawn.aam.variance))
    assert_array_equal(c, seen.features)


def test_features_of_the_clips_learned_from_vary_as_the_model_says(drawn):
    c = np.concatenate([features(drawn.aam, clip, drawn.folder) for clip in drawn.clips])
    assert_allclose(c.mean(axis=0) / np.sqrt(drawn.aam.variance), 0, atol=0.05)
    assert_allclose(c.var(axis=0), drawn.aam.variance, rtol=0.05)


def test_features_and_poses_give_the_landmarks_back(drawn, seen):
    made = place(seen.poses, synthesize_shape(drawn.aam, seen.features))
    miss = np.sqrt(((made - drawn.points(drawn.held_out)) ** 2).sum(axis=2).mean(axis=1))
    assert miss.mean() < 0.5


def test_backends_see_the_same(drawn, seen, backend):
    other = see_clip(drawn.aam, drawn.held_out, drawn.folder, backend=backend)
    plain = see_clip(drawn.aam, drawn.held_out, drawn.folder, backend="numpy")
    scale = np.sqrt(drawn.aam.variance)
    assert_allclose(other.features / scale, plain.features / scale, atol=1e-3)


def test_a_clip_is_reconstructed_from_its_features(drawn, seen):
    real = list(read_frames(drawn.held_out))
    made = list(reconstruct(drawn.aam, seen.features, drawn.held_out, drawn.folder))
    assert len(made) == len(real)
    everywhere = np.ones(real[0].shape[:2], bool)
    scores = [psnr(a, b, everywhere) for a, b in zip(real, made, strict=True)]
    assert np.mean(scores) > 30


@pytest.mark.parametrize(
    "change", [lambda c: c[1:], lambda c: c[:, 1:], lambda c: c * np.nan, lambda c: c[0]]
)
def test_features_of_another_clip_are_refused(drawn, seen, change):
    with pytest.raises(InputError, match=r"features for .*clip 3\.mkv must be finite, of shape"):
        list(reconstruct(drawn.aam, change(seen.features), drawn.held_out, drawn.folder))


def test_a_clip_with_other_landmarks_than_the_models_is_refused(drawn, tmp_path):
    from dataclasses import replace

    with pytest.raises(InputError, match=r"has 103 landmarks a frame, the model was made of 38"):
        complete_clip(replace(drawn.aam, rows=None), drawn.held_out, drawn.folder)


def test_a_clip_with_some_frames_labelled_is_no_complete_one(drawn, tmp_path):
    import json
    from dataclasses import replace

    points = drawn.points(drawn.held_out)[3].tolist()
    value = {"format": "mmmgpu-landmarks", "version": 1, "frames": [{"frame": 3, "points": points}]}
    (tmp_path / f"{drawn.held_out.stem}.json").write_text(json.dumps(value))
    with pytest.raises(InputError, match="only 1 of 45 frames have landmarks"):
        complete_clip(replace(drawn.aam, rows=None), drawn.held_out, tmp_path)


def test_landmarks_of_another_length_are_refused(drawn, tmp_path):
    other = tmp_path / f"{drawn.held_out.stem}.npz"
    shutil.copy(drawn.folder / f"{drawn.held_out.stem}.npz", other)
    with np.load(other) as arrays:
        points = arrays["points"][:-1]
    np.savez(other, points=points)
    with pytest.raises(InputError, match=r"must hold points of shape \(45, 103 or more, 2\)"):
        features(drawn.aam, drawn.held_out, tmp_path)
