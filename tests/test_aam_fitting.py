from dataclasses import replace

import numpy as np
import oracles_aam as oracles
import pytest
from drawn_aams import random_features
from numpy.testing import assert_allclose, assert_array_equal

from mmmgpu import aam_fitting
from mmmgpu.aam_fitting import compose, match, prepare_fitting, warp_jacobian
from mmmgpu.aam_rendering import _texture_picture, render_face
from mmmgpu.appearances import (
    aligned,
    read_texture,
    reduce_picture,
    reduce_points,
    see,
    synthesize_shape,
)
from mmmgpu.backends import get_backend
from mmmgpu.errors import InputError
from mmmgpu.shapes import place

WARP = get_backend("warp", 1)


@pytest.fixture(scope="module")
def fitter(drawn):
    return prepare_fitting(drawn.aam)


def rms(a, b):
    """Root mean square distance of points (N, 2)."""
    return float(np.sqrt(((a - b) ** 2).sum(axis=1).mean()))


def pixel_places(mesh, vertices):
    """Where the pixels of a mesh go with its vertices, (P, 2)."""
    pixels = mesh.pixels
    corners = vertices[mesh.triangles[pixels.index]]
    return (pixels.barycentric[..., None] * corners).sum(axis=1)


def test_the_jacobian_is_that_of_central_differences(drawn, fitter):
    mesh, step = drawn.aam.mesh, 1e-3
    jacobian = warp_jacobian(mesh.pixels, mesh.triangles, fitter.directions)
    assert jacobian.shape == (len(mesh.pixels.index), 2, len(fitter.directions))
    for d, direction in enumerate(fitter.directions):
        ahead, behind = (pixel_places(mesh, mesh.vertices + s * step * direction) for s in (1, -1))
        assert_allclose(jacobian[..., d], (ahead - behind) / (2 * step), atol=1e-6)


def test_the_similarities_turn_enlarge_and_shift(drawn, fitter):
    vertices = drawn.aam.mesh.vertices
    first = fitter.directions[:4].reshape(4, -1)
    assert_allclose(first @ first.T, np.eye(4), atol=1e-9)
    moved = place(np.array([1.001, 0.002, 0.3, -0.2]), vertices) - vertices
    assert_allclose(first.T @ (first @ moved.ravel()), moved.ravel(), atol=1e-9)


def test_pixels_of_a_coarse_level_are_means_of_those_below(drawn, fitter):
    aam = drawn.aam
    picture = np.zeros((aam.mesh.shape[0] * aam.mesh.shape[1], 3), np.float32)
    picture[aam.mesh.pixels.place] = aam.texture_mean
    picture = picture.reshape(*aam.mesh.shape, 3)
    level = next(level for level in fitter.levels if level.factor == 2)
    width = level.mesh.shape[1]
    for at, colour in zip(level.mesh.pixels.place[::7], level.mean[::7], strict=True):
        y, x = 2 * (at // width), 2 * (at % width)
        assert_allclose(colour, picture[y : y + 2, x : x + 2].mean(axis=(0, 1)), atol=1e-6)


def slow_images(aam, fitter):
    """Steepest descent images and all that is hidden, one pixel after the other."""
    mesh = aam.mesh
    width = mesh.shape[1]
    number = {int(place): i for i, place in enumerate(mesh.pixels.place)}
    descent = np.zeros((len(number), 3, len(fitter.directions)))
    for at, i in number.items():
        around = [number.get(at + step) for step in (1, -1, width, -width)]
        if None in around or at % width in (0, width - 1):
            continue
        right, left, low, high = (aam.texture_mean[j].astype(float) for j in around)
        corners = mesh.triangles[mesh.pixels.index[i]]
        moved = np.einsum("j,djc->dc", mesh.pixels.barycentric[i], fitter.directions[:, corners])
        descent[i] = np.outer((right - left) / 2, moved[:, 0])
        descent[i] += np.outer((low - high) / 2, moved[:, 1])
    hidden = [mode.ravel() for mode in aam.texture_modes]
    for colour in range(3):
        for picture in (np.ones_like(aam.texture_mean), aam.texture_mean):
            alone = np.zeros_like(aam.texture_mean)
            alone[:, colour] = picture[:, colour]
            hidden.append(alone.ravel())
    return descent.reshape(-1, len(fitter.directions)), np.array(hidden).T


def test_a_step_is_that_of_dense_least_squares(drawn, fitter):
    aam, level = drawn.aam, fitter.levels[-1]
    assert level.factor == 1
    descent, hidden = slow_images(aam, fitter)
    rng = np.random.default_rng(0)
    missed = 0.05 * rng.normal(size=len(descent))
    shape = np.concatenate([np.zeros(4), rng.normal(size=len(aam.shape_modes))])
    prior = np.concatenate([np.zeros(4), aam_fitting.PRIOR / aam.shape_variance])
    desired = oracles.gauss_newton_step(descent, hidden, missed, shape, prior)
    assert_allclose(level.step @ missed + level.pull @ shape, desired, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("step", [(0.3, 0.0), (0.0, -0.3), (-0.2, 0.2)])
def test_one_step_goes_most_of_the_way_at_every_size(drawn, fitter, step):
    """In the mean picture itself, from the mean shape moved a little."""
    mesh = drawn.aam.mesh
    picture = _texture_picture(mesh, drawn.aam.texture_mean, WARP)
    frame = np.rint(255 * picture.clip(0, 1)).astype(np.uint8)
    for level in fitter.levels:
        points = mesh.vertices + np.array(step)
        reduced = reduce_picture(frame, level.factor)
        texture = read_texture(level.mesh, reduced, reduce_points(points, level.factor), WARP)
        new = compose(fitter, points, level.step @ (texture - level.mean).ravel())
        assert rms(new, mesh.vertices) < 0.45 * rms(points, mesh.vertices)


def test_what_modes_and_lights_explain_moves_nothing(drawn, fitter):
    level, aam = fitter.levels[-1], drawn.aam
    seen = aam.texture_mean * (0.2, 0.3, -0.1) + (0.1, 0, 0.4)
    seen = seen + np.tensordot([0.5, -0.3], aam.texture_modes[:2], axes=1)
    assert np.abs(level.step @ seen.ravel()).max() < 1e-4


def test_composing_nothing_changes_nothing(drawn, fitter):
    aam = drawn.aam
    pose = np.array([0.9, 0.2, 30, 40])
    points = place(pose, aam.mesh.vertices + 0.5 * aam.shape_modes[0])
    assert_allclose(compose(fitter, points, np.zeros(len(fitter.directions))), points, atol=1e-9)


@pytest.mark.parametrize("d", range(4))
def test_composing_a_similarity_undoes_it_before_the_warp(drawn, fitter, d):
    """W(p) o W(dp)^-1 carries W(dp)(x) to W(p)(x)."""
    aam, change = drawn.aam, np.zeros(len(fitter.directions))
    change[d] = 0.5
    points = place(np.array([0.9, 0.2, 30, 40]), aam.mesh.vertices)
    moved = aam.mesh.vertices + 0.5 * fitter.directions[d]
    to_points = oracles.similarity(moved, points, np.ones(len(points)))
    desired = oracles.carry(to_points, aam.mesh.vertices)
    assert_allclose(compose(fitter, points, change), desired, atol=0.02)
    assert np.abs(desired - points).max() > 0.05


def test_composing_a_mode_takes_it_away(drawn, fitter):
    aam, change = drawn.aam, np.zeros(len(fitter.directions))
    change[4] = 0.3
    pose = np.array([1.1, -0.1, 5, 6])
    points = place(pose, aam.mesh.vertices + 0.3 * aam.shape_modes[0])
    assert_allclose(compose(fitter, points, change), place(pose, aam.mesh.vertices), atol=0.02)


def test_shapes_stay_within_what_the_model_has_seen(drawn, fitter):
    aam, change = drawn.aam, np.zeros(len(fitter.directions))
    change[4] = -1e3
    (shape,), _ = aligned(aam, compose(fitter, aam.mesh.vertices, change)[None])
    b = np.tensordot(aam.shape_modes, shape - aam.mesh.vertices, axes=2)
    limit = aam_fitting.FARTHEST * np.sqrt(aam.shape_variance)
    assert (np.abs(b) <= 1.1 * limit + 1e-6).all()
    assert np.abs(b[0]) > 0.5 * limit[0]


def starts(drawn, every=6, away=5.0):
    """Frames of the held-out clip with their landmarks, and the mean shape `away` px from there."""
    rng = np.random.default_rng(0)
    truth = drawn.points(drawn.held_out)
    for t in range(0, len(truth), every):
        _, (pose,) = aligned(drawn.aam, truth[t][None])
        angle = rng.uniform(0, 2 * np.pi)
        shift = away * np.array([np.cos(angle), np.sin(angle)])
        yield drawn.frame(drawn.held_out, t), truth[t], place(pose, drawn.aam.mesh.vertices) + shift


def test_a_face_is_found_from_five_pixels_away(drawn, fitter):
    misses = []
    for frame, truth, start in starts(drawn):
        found = match(fitter, frame, start, WARP)
        misses.append(rms(found.shape, truth))
        assert rms(start, truth) > 4
    assert len(misses) >= 7
    assert np.mean(np.array(misses) < 1) >= 0.95


def test_features_of_a_match_are_those_of_its_points(drawn, fitter):
    frame, _, start = next(starts(drawn))
    found = match(fitter, frame, start, WARP)
    again = see(drawn.aam, [frame], found.shape[None], WARP, where="x")
    assert_allclose(found.features, again.features[0], atol=1e-3)
    assert_allclose(found.pose, again.poses[0], atol=1e-6)
    assert_allclose(found.light, again.lights[0], atol=1e-6)


def test_a_picture_made_by_the_model_leaves_nothing_over(drawn, fitter):
    """A frame whose face is the model's own, with its own shape."""
    frame, points = drawn.frame(drawn.held_out, 8), drawn.points(drawn.held_out)[8]
    c = 0.5 * random_features(drawn.aam, 1, seed=3)[0]
    made = render_face(drawn.aam, frame, points, c, WARP, where="x")
    _, (pose,) = aligned(drawn.aam, points[None])
    truth = place(pose, synthesize_shape(drawn.aam, c))
    found = match(fitter, made, truth + np.array([2, -1]), WARP)
    assert found.settled
    assert rms(found.shape, truth) < 0.5
    assert found.residual < 0.03


def test_steps_end_where_they_are_told_to(drawn, fitter, monkeypatch):
    monkeypatch.setattr(aam_fitting, "STEPS", 1)
    frame, _, start = next(starts(drawn))
    assert not match(fitter, frame, start, WARP).settled


def test_a_frame_without_a_face_ends_without_points_gone_astray(drawn, fitter):
    start = drawn.points(drawn.held_out)[0]
    found = match(fitter, np.zeros((160, 144, 3), np.uint8), start, WARP)
    assert np.isfinite(found.shape).all()
    assert np.isfinite(found.features).all()


@pytest.mark.parametrize("bad", [np.zeros((3, 2)), np.full((38, 2), np.nan), np.zeros(76)])
def test_a_start_that_is_none_is_an_error(drawn, fitter, bad):
    with pytest.raises(InputError, match="start must be 38 finite points"):
        match(fitter, drawn.frame(drawn.held_out, 0), bad, WARP)


def test_the_same_match_twice_is_the_same_and_inputs_stay(drawn, fitter):
    frame, _, start = next(starts(drawn))
    kept = frame.copy(), start.copy()
    one, two = (match(fitter, frame, start, WARP) for _ in range(2))
    assert_array_equal(one.shape, two.shape)
    assert_array_equal(frame, kept[0])
    assert_array_equal(start, kept[1])


def test_faces_in_larger_pictures_are_found_in_reduced_ones(drawn):
    """Every pixel four times, and the model told so."""
    fitter = prepare_fitting(replace(drawn.aam, reduction=2))
    frame, truth, start = next(starts(drawn))
    large = frame.repeat(2, axis=0).repeat(2, axis=1)
    found = match(fitter, large, 2 * start + 0.5, WARP)
    plain = match(prepare_fitting(drawn.aam), frame, start, WARP)
    assert_allclose(found.shape, 2 * plain.shape + 0.5, atol=1e-3)
    assert rms(found.shape, 2 * truth + 0.5) < 2


def test_reading_is_done_at_the_level_of_the_picture(drawn, fitter):
    """The mean texture is what a level reads from the mean picture of its size."""
    aam = drawn.aam
    frame = np.zeros((*aam.mesh.shape, 3), np.uint8)
    frame.reshape(-1, 3)[aam.mesh.pixels.place] = np.rint(255 * aam.texture_mean)
    for level in fitter.levels:
        read = read_texture(
            level.mesh, reduce_picture(frame, level.factor), level.mesh.vertices, WARP
        )
        assert_allclose(read, level.mean, atol=0.01)
