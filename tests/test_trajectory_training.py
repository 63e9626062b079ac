from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from mmmgpu.errors import InputError
from mmmgpu.phonemes import PhonemeModels, Utterance, pool
from mmmgpu.trajectories import scaled_smoothness, synthesize_trajectory
from mmmgpu.trajectory_training import (
    choose_constants,
    fit_stream,
    remove_offsets,
    train_phonemes,
)

PHONES = ("SIL", "aa", "b", "iy", "s", "w")
TRUE_SMOOTHNESS = 3.0


def true_models(rng, n_dims):
    shape = (len(PHONES), n_dims)
    variance = rng.uniform(0.05, 2.0, size=shape)
    return PhonemeModels(PHONES, rng.normal(size=shape), variance, np.ones(len(PHONES), int))


def random_labels(rng):
    middle = [str(rng.choice(PHONES[1:])) for _ in range(7)]
    return [p for p in ["SIL", *middle, "SIL"] for _ in range(rng.integers(1, 6))]


def synthetic_clips(rng, n_clips, n_dims=2, noise=0.1):
    """Clips drawn from models that are known: what Eq. 3 gives, and noise."""
    truth = true_models(rng, n_dims)
    clips = []
    for _ in range(n_clips):
        labels = random_labels(rng)
        y = synthesize_trajectory(truth, labels, smoothness=TRUE_SMOOTHNESS)
        clips.append(Utterance(y + noise * rng.normal(size=y.shape), labels))
    return truth, clips


def error(models, clips, smoothness, order=4):
    return np.mean(
        np.concatenate(
            [
                synthesize_trajectory(models, u.labels, smoothness=smoothness, order=order) - u.z
                for u in clips
            ]
        )
        ** 2
    )


def test_training_finds_the_trajectories_of_known_models():
    rng = np.random.default_rng(0)
    _, clips = synthetic_clips(rng, 50, noise=0.05)
    train, held_out = clips[:35], clips[35:]
    pooled = pool(train)
    smoothness = np.full(2, TRUE_SMOOTHNESS)
    trained, history = train_phonemes(
        train, pooled, smoothness=smoothness, ridge=0.01, iterations=150
    )
    noise = 0.05**2
    assert error(pooled, held_out, smoothness) > 10 * noise
    assert error(trained, held_out, smoothness) < 1.5 * noise
    np.testing.assert_allclose(
        history.training.mean(axis=1)[[0, -1]],
        # each clip weighs by its frames in both
        [error(pooled, train, smoothness), error(trained, train, smoothness)],
        rtol=1e-9,
    )


def test_history_never_rises_without_a_ridge():
    _, clips = synthetic_clips(np.random.default_rng(1), 10)
    models = pool(clips)
    lam = scaled_smoothness(models, 1.0)
    _, history = train_phonemes(clips, models, smoothness=lam, ridge=0.0, iterations=15)
    assert history.training.shape == (16, 2)
    assert (np.diff(history.training, axis=0) <= 1e-12).all()


def test_a_heavy_ridge_keeps_the_pooled_estimates():
    _, clips = synthetic_clips(np.random.default_rng(2), 8)
    models = pool(clips)
    lam = scaled_smoothness(models, 1.0)
    kept, _ = train_phonemes(clips, models, smoothness=lam, ridge=1e9)
    np.testing.assert_allclose(kept.mean, models.mean, atol=1e-5)
    np.testing.assert_allclose(kept.variance, models.variance, rtol=1e-5)
    free, _ = train_phonemes(clips, models, smoothness=lam, ridge=1.0)
    assert abs(free.mean - models.mean).max() > 0.1


def test_dimensions_are_trained_apart_and_their_scale_does_not_matter():
    _, clips = synthetic_clips(np.random.default_rng(3), 8, n_dims=3)
    scale = np.array([0.1, 1.0, 30.0])
    scaled_clips = [replace(u, z=u.z[:, ::-1] * scale) for u in clips]

    def train(utterances):
        models = pool(utterances)
        lam = scaled_smoothness(models, 1.0)
        return train_phonemes(utterances, models, smoothness=lam, iterations=10)[0]

    one, other = train(clips), train(scaled_clips)
    np.testing.assert_allclose(other.mean, one.mean[:, ::-1] * scale, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(other.variance, one.variance[:, ::-1] * scale**2, rtol=1e-4)


def test_a_dimension_that_never_moves_stays_still():
    _, clips = synthetic_clips(np.random.default_rng(4), 6)
    clips = [replace(u, z=u.z * [1, 0]) for u in clips]
    stream = fit_stream(clips, rng=np.random.default_rng(0), folds=2)
    y = synthesize_trajectory(stream.trained, clips[0].labels, smoothness=stream.smoothness)
    np.testing.assert_array_equal(y[:, 1], 0)
    assert np.isfinite(y).all()


def test_offsets_of_clips_are_found_and_taken_away():
    rng = np.random.default_rng(5)
    _, clips = synthetic_clips(rng, 30)
    offsets = rng.normal(scale=3, size=(30, 2))
    offsets -= np.average(offsets, axis=0, weights=[len(u.z) for u in clips])
    moved = [replace(u, z=u.z + c) for u, c in zip(clips, offsets, strict=True)]
    level = remove_offsets(moved, rounds=30)
    left = [(u.z - clean.z).mean(axis=0) for u, clean in zip(level, clips, strict=True)]
    spread = np.std(left, axis=0)
    assert (spread < 0.35 * offsets.std(axis=0)).all()
    frames = np.concatenate([u.z for u in level])
    np.testing.assert_allclose(
        frames.mean(axis=0), np.concatenate([u.z for u in moved]).mean(axis=0), rtol=1e-9
    )


def test_a_single_clip_keeps_its_level():
    _, clips = synthetic_clips(np.random.default_rng(6), 1)
    np.testing.assert_allclose(remove_offsets(clips)[0].z, clips[0].z, atol=1e-12)


def test_fit_lowers_the_error_of_clips_never_seen():
    rng = np.random.default_rng(7)
    _, clips = synthetic_clips(rng, 40, noise=0.2)
    train, held_out = clips[:25], clips[25:]
    stream = fit_stream(train, rng=np.random.default_rng(0), folds=3)
    order = stream.constants.order
    before = error(stream.pooled, held_out, stream.smoothness, order)
    assert error(stream.trained, held_out, stream.smoothness, order) < 0.6 * before
    assert stream.validation[stream.constants.iterations] == stream.validation.min()


def test_constants_depend_on_the_seed_alone_and_come_from_the_grids():
    _, clips = synthetic_clips(np.random.default_rng(8), 6)
    grids = {"orders": (2, 4), "smoothness": (0.3, 3.0), "ridges": (1.0, 30.0), "iterations": 9}

    def choose():
        return choose_constants(clips, rng=np.random.default_rng(3), folds=3, **grids)

    (constants, curve), (again, curve_again) = choose(), choose()
    assert constants == again
    np.testing.assert_array_equal(curve, curve_again)
    assert constants.order in grids["orders"]
    assert constants.smoothness in grids["smoothness"]
    assert constants.ridge in grids["ridges"]
    assert constants.iterations == curve.argmin()


def test_smoothness_is_chosen_by_the_clips_left_out():
    """Noise about still means asks for more smoothing than clean, sharp movement does."""
    rng = np.random.default_rng(9)
    levels = dict(zip(PHONES, rng.normal(size=len(PHONES)), strict=True))

    def chosen(noise, sharpness):
        clips = []
        for _ in range(10):
            labels = random_labels(rng)
            z = np.array([[sharpness * levels[p]] for p in labels])
            clips.append(Utterance(z + noise * rng.normal(size=z.shape), labels))
        found, _ = choose_constants(clips, rng=np.random.default_rng(0), iterations=3)
        return found.smoothness

    assert chosen(noise=0.05, sharpness=1.0) == 0.1
    truth = true_models(rng, 1)
    smooth = [
        Utterance(synthesize_trajectory(truth, labels, smoothness=300.0), labels)
        for labels in (random_labels(rng) for _ in range(10))
    ]
    found, _ = choose_constants(smooth, rng=np.random.default_rng(0), orders=(4,), iterations=3)
    assert found.smoothness >= 3.0


def test_one_clip_is_cut_for_the_folds():
    rng = np.random.default_rng(10)
    truth = true_models(rng, 2)
    labels = [p for _ in range(4) for p in random_labels(rng)]
    clip = Utterance(synthesize_trajectory(truth, labels, smoothness=1.0), labels)
    choose = partial(choose_constants, orders=(2,), ridges=(3.0, 30.0), iterations=6)
    constants, curve = choose([clip], rng=np.random.default_rng(0))
    assert curve.shape == (7,)
    assert np.isfinite(curve).all()
    runs = np.cumsum([0, *(a != b for a, b in pairwise(labels))])
    again, curve_again = choose([replace(clip, segments=runs)], rng=np.random.default_rng(0))
    assert again == constants
    np.testing.assert_array_equal(curve_again, curve)


def test_a_single_segment_is_too_little():
    clip = Utterance(np.zeros((9, 2)), ["SIL"] * 9)
    with pytest.raises(InputError, match="give more speech"):
        fit_stream([clip], rng=np.random.default_rng(0))


def test_progress_counts_up_and_can_stop_the_job():
    _, clips = synthetic_clips(np.random.default_rng(11), 4)
    models = pool(clips)
    lam = scaled_smoothness(models, 1.0)
    calls = []
    train_phonemes(
        clips, models, smoothness=lam, iterations=2, progress=lambda *call: calls.append(call)
    )
    assert calls == [(1, 2), (2, 2)]

    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_phonemes(clips, models, smoothness=lam, iterations=2, progress=stop)


def test_arguments_are_left_as_they_were():
    _, clips = synthetic_clips(np.random.default_rng(12), 4)
    models = pool(clips)
    before = [u.z.copy() for u in clips], models.mean.copy(), models.variance.copy()
    train_phonemes(remove_offsets(clips), models, smoothness=np.ones(2), iterations=5)
    for u, z in zip(clips, before[0], strict=True):
        np.testing.assert_array_equal(u.z, z)
    np.testing.assert_array_equal(models.mean, before[1])
    np.testing.assert_array_equal(models.variance, before[2])
