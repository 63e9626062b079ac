import json

import numpy as np
import oracles_aam as oracles
import pytest
from drawn_aams import PARAMETERS
from numpy.testing import assert_allclose, assert_array_equal

from mmmgpu import aam_training
from mmmgpu.aam_training import fit_aam
from mmmgpu.appearances import aligned, fit_light, read_texture, reduce_picture, take_light_off
from mmmgpu.backends import get_backend
from mmmgpu.errors import InputError


@pytest.fixture(scope="module")
def few(drawn, tmp_path_factory):
    """The model of 12 frames of the drawn person, and their aligned shapes and textures."""
    aam = fit_aam(drawn.clips, drawn.folder, parameters=5, frames=12)
    total = [len(drawn.points(clip)) for clip in drawn.clips]
    frames = [int(i * sum(total) / 12) for i in range(12)]
    shapes, textures = [], []
    for t in frames:
        clip = 0
        while t >= total[clip]:
            t, clip = t - total[clip], clip + 1
        points = drawn.points(drawn.clips[clip])[t]
        picture = reduce_picture(drawn.frame(drawn.clips[clip], t), 1)
        texture = read_texture(aam.mesh, picture, points, get_backend("numpy"))
        textures.append(take_light_off(texture, fit_light(texture, aam.texture_mean)))
        shapes.append(aligned(aam, points[None])[0][0])
    return aam, np.array(shapes), np.array(textures)


def assert_same_modes(actual, desired, least=0.999):
    """Equal up to sign."""
    assert (np.abs((actual * desired).sum(axis=1)) > least).all()


def test_the_mean_shape_and_texture_are_means(few):
    aam, shapes, textures = few
    assert_allclose(shapes.mean(axis=0), aam.mesh.vertices, atol=0.02)
    assert_allclose(textures.mean(axis=0), aam.texture_mean, atol=0.002)


def test_lights_are_taken_off_and_the_mean_keeps_that_of_the_mean_picture():
    rng = np.random.default_rng(0)
    plain = rng.uniform(0.2, 0.8, (60, 3)) + 0.05 * rng.normal(size=(9, 60, 3))
    gain, offset = rng.uniform(0.5, 1.5, (9, 1, 3)), rng.uniform(-0.2, 0.2, (9, 1, 3))
    textures = np.asarray(gain * plain + offset, np.float32)
    picture = textures.mean(axis=0)
    mean = aam_training._in_one_light(textures, [str(i) for i in range(9)])
    assert_allclose(fit_light(mean, picture), [[1, 0]] * 3, atol=1e-3)
    for texture in textures:
        assert_allclose(fit_light(texture, mean), [[1, 0]] * 3, atol=0.01)


def test_modes_are_those_of_a_full_svd(few):
    aam, shapes, textures = few
    s = (shapes - aam.mesh.vertices).reshape(12, -1)
    g = (textures - textures.mean(axis=0)).reshape(12, -1).astype(np.float64)
    k = min(3, len(aam.shape_modes))
    modes, variance = oracles.svd_components(s - s.mean(axis=0))
    assert_same_modes(aam.shape_modes[:k].reshape(k, -1), modes[:k], 0.99)
    assert_allclose(aam.shape_variance[:k], variance[:k], rtol=0.02)
    modes, variance = oracles.svd_components(g)
    assert_same_modes(aam.texture_modes[:3].reshape(3, -1), modes[:3])
    assert_allclose(aam.texture_variance[:3], variance[:3], rtol=0.01)
    both = np.concatenate([aam.weight * (s - s.mean(axis=0)), g], axis=1)
    modes, variance = oracles.svd_components(both)
    n = len(aam.variance)
    own = [m.reshape(n, -1) for m in (aam.modes_of_shape, aam.modes_of_texture)]
    assert_same_modes(np.concatenate(own, axis=1)[:3], modes[:3], 0.99)
    assert_allclose(aam.variance[:3], variance[:3], rtol=0.02)
    assert_allclose(aam.share, variance[:n].sum() / variance.sum(), rtol=0.01)


def test_shape_and_texture_weigh_the_same(few):
    aam, shapes, textures = few
    s, g = shapes - shapes.mean(axis=0), textures - textures.mean(axis=0)
    assert_allclose(aam.weight**2 * (s**2).sum(), (g**2).sum(), rtol=0.02)


def test_a_share_of_variance_gives_as_many_parameters_as_it_needs(drawn):
    found = {
        share: fit_aam(drawn.clips[:1], drawn.folder, variance=share, frames=20)
        for share in (0.5, 0.95)
    }
    assert all(aam.share >= share for share, aam in found.items())
    assert len(found[0.5].variance) < len(found[0.95].variance) < 20
    fewer = fit_aam(
        drawn.clips[:1], drawn.folder, parameters=len(found[0.95].variance) - 1, frames=20
    )
    assert fewer.share < 0.95


def test_what_is_learned_from_is_bounded_and_spread(drawn, monkeypatch):
    read = {}
    frames = aam_training.read_chosen_frames

    def noted(path, chosen):
        read[path] = len(chosen)
        return frames(path, chosen)

    monkeypatch.setattr(aam_training, "read_chosen_frames", noted)
    aam = fit_aam(drawn.clips, drawn.folder, parameters=4, frames=9)
    assert aam.notes["frames"] == sum(read.values()) == 9
    assert sorted(read) == sorted(drawn.clips)
    assert max(read.values()) - min(read.values()) <= 1


def test_the_whole_is_counted_in_the_notes(drawn):
    assert drawn.aam.notes["clips"] == [clip.name for clip in drawn.clips]
    assert drawn.aam.notes["frames"] == sum(len(drawn.points(clip)) for clip in drawn.clips)
    assert len(drawn.aam.variance) == PARAMETERS
    assert drawn.aam.reduction == 1


def test_the_same_clips_give_the_same_model(drawn, backend):
    one, two = (
        fit_aam(drawn.clips[:1], drawn.folder, parameters=3, frames=8, backend=name)
        for name in (backend, "numpy")
    )
    again = fit_aam(drawn.clips[:1], drawn.folder, parameters=3, frames=8, backend=backend)
    assert_array_equal(again.modes_of_texture, one.modes_of_texture)
    assert_array_equal(again.modes_of_shape, one.modes_of_shape)
    assert_allclose(one.texture_mean, two.texture_mean, atol=1e-5)
    assert_allclose(one.modes_of_texture, two.modes_of_texture, atol=1e-3)


def test_large_faces_are_reduced(drawn, monkeypatch):
    monkeypatch.setattr(aam_training, "LARGEST", len(drawn.aam.mesh.pixels.index) / 2)
    small = fit_aam(drawn.clips[:1], drawn.folder, parameters=3, frames=8)
    assert small.reduction == 2
    assert len(small.mesh.pixels.index) < len(drawn.aam.mesh.pixels.index) / 2.5


def test_frames_labelled_by_hand_are_enough(drawn, tmp_path):
    clip = drawn.clips[0]
    points = drawn.points(clip)
    listed = [{"frame": t, "points": points[t].tolist()} for t in range(2, 40, 4)]
    value = {"format": "mmmgpu-landmarks", "version": 1, "frames": listed}
    (tmp_path / f"{clip.stem}.json").write_text(json.dumps(value))
    aam = fit_aam([clip], tmp_path, parameters=4, rows=None)
    assert aam.notes["frames"] == len(listed)
    assert aam.rows is None


def spoilt(drawn, folder, change):
    """Landmarks of the first clip, changed, in `folder`."""
    clip = drawn.clips[0]
    with np.load(drawn.folder / f"{clip.stem}.npz") as arrays:
        points = arrays["points"].copy()
    change(points)
    np.savez(folder / f"{clip.stem}.npz", points=points)
    return clip


def turn_over(points):
    """The chin in frame 7 far above the nose."""
    points[7, [49, 50, 51], 1] -= 60


def test_a_triangle_turned_over_is_named(drawn, tmp_path):
    clip = spoilt(drawn, tmp_path, turn_over)
    with pytest.raises(InputError, match=r"frame 7: the triangle between landmarks .* turned over"):
        fit_aam([clip], tmp_path, parameters=3)


def test_jitter_that_turns_a_triangle_a_little_is_none(drawn, tmp_path):
    def jitter(points):
        points += np.random.default_rng(0).normal(0, 0.1, points.shape)

    clip = spoilt(drawn, tmp_path, jitter)
    assert len(fit_aam([clip], tmp_path, parameters=3).variance) == 3


def freeze(points):
    points[:] = points[0]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"parameters": 0}, "parameters must be at least 1"),
        ({"parameters": 3, "variance": 0.9}, "parameters and variance: .* give one of them"),
        ({"variance": 0.0}, "variance must be a share"),
        ({"variance": 1.2}, "variance must be a share"),
        ({"variance": float("nan")}, "variance must be a share"),
        ({"frames": 1}, "frames must be at least 2"),
        (
            {"parameters": 46},
            r"45 labelled frame\(s\) are too few for 46 parameters; give more clips",
        ),
        ({"parameters": 6, "frames": 6}, r"6 labelled frame\(s\) are too few for 6 parameters"),
    ],
)
def test_options_that_cannot_be_are_named(drawn, options, says):
    with pytest.raises(InputError, match=says):
        fit_aam(drawn.clips[:1], drawn.folder, **options)


def test_landmarks_that_never_move_make_no_model(drawn, tmp_path):
    clip = spoilt(drawn, tmp_path, freeze)
    with pytest.raises(InputError, match="the landmarks never move"):
        fit_aam([clip], tmp_path, parameters=2)


def test_landmarks_beside_the_face_are_named(drawn, tmp_path):
    def aside(points):
        points[20] = points[20] * 0.05 + (2, 2)

    clip = spoilt(drawn, tmp_path, aside)
    with pytest.raises(InputError, match=r"clip 0\.mkv, frame 20: what lies between the landmarks"):
        fit_aam([clip], tmp_path, parameters=2)
