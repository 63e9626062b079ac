import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from mmmgpu.adaptation_folds import METHODS, adapt_models
from mmmgpu.errors import InputError
from mmmgpu.gdlr import (
    RULES,
    Descent,
    bounded_metrics,
    descend_means,
    paper_metrics,
    standard_units,
)
from mmmgpu.linear_adaptation import map_means, regress_means
from mmmgpu.phonemes import PhonemeModels, Utterance
from mmmgpu.regression_classes import class_rows
from mmmgpu.reselection import carry
from mmmgpu.trajectories import factor_system, lay_out_utterances, synthesize_trajectory

PHONES = ("AA", "AE", "AH", "B", "IH", "IY", "M", "P", "S", "SIL", "T", "W")
CLASSES = (("AA", "AE", "AH"), ("B", "M", "P"), ("IH", "IY"), ("S", "T"), ("SIL",), ("W",))
UNHEARD = ("AE", "IH", "M", "P", "T")  # never in the adaptation clips
SMOOTHNESS = 1.0
D = 4


def first_person(rng):
    shape = (len(PHONES), D)
    variance = rng.uniform(0.1, 1.0, size=shape)
    return PhonemeModels(PHONES, rng.normal(size=shape), variance, np.full(len(PHONES), 50))


def second_person(models, rng):
    """The truth: R_true of each class on the means of the first person."""
    mean = models.mean.copy()
    for members in CLASSES:
        own = [models.labels.index(label) for label in members]
        M = 0.6 * np.eye(D) + 0.15 * rng.normal(size=(D, D))
        mean[own] = mean[own] @ M.T + rng.normal(size=D)
    return replace(models, mean=mean)


def spoken(models, rng, n_clips, phones=PHONES, noise=0.2):
    clips = []
    for _ in range(n_clips):
        middle = [str(rng.choice([p for p in phones if p != "SIL"])) for _ in range(14)]
        labels = [p for p in ["SIL", *middle, "SIL"] for _ in range(rng.integers(2, 6))]
        y = synthesize_trajectory(models, labels, smoothness=SMOOTHNESS)
        clips.append(Utterance(y + noise * rng.normal(size=y.shape), labels))
    return clips


@pytest.fixture(scope="module")
def world():
    """The first person's models, 5 clips of the second person, and 15 held out."""
    rng = np.random.default_rng(0)
    models = first_person(rng)
    truth = second_person(models, rng)
    heard = [p for p in PHONES if p not in UNHEARD]
    return models, truth, spoken(truth, rng, 5, heard), spoken(truth, rng, 15)


def adapt(models, clips, method="gdlr", seed=0, **options):
    options = {"classes": CLASSES, "smoothness": SMOOTHNESS, "order": 4} | options
    return adapt_models(models, clips, method=method, rng=np.random.default_rng(seed), **options)


def clip_errors(models, clips, smoothness=SMOOTHNESS):
    follow = partial(synthesize_trajectory, models, smoothness=smoothness)
    return np.array([np.mean((follow(u.labels) - u.z) ** 2) for u in clips])


def test_the_methods():
    assert METHODS == ("none", "shift", "map", "mllr", "gdlr")


@pytest.mark.parametrize("method", ["shift", "map", "mllr", "gdlr"])
def test_adaptation_brings_held_out_trajectories_nearer(world, method):
    models, truth, clips, held_out = world
    adapted = adapt(models, clips, method)
    gain = clip_errors(models, held_out) - clip_errors(adapted.models, held_out)
    assert gain.mean() > 4 * gain.std(ddof=1) / np.sqrt(len(gain))
    assert clip_errors(adapted.models, held_out).mean() > clip_errors(truth, held_out).mean()
    np.testing.assert_array_equal(adapted.models.variance, models.variance)


def test_gdlr_is_nearest_and_moves_phones_that_were_never_heard(world):
    models, truth, clips, held_out = world
    heard = spoken(truth, np.random.default_rng(6), 15, [p for p in PHONES if p not in UNHEARD])
    by = {m: adapt(models, clips, m).models for m in METHODS}
    found = {m: clip_errors(own, heard).mean() for m, own in by.items()}
    assert min(found, key=found.get) == "gdlr"
    found = {m: clip_errors(own, held_out).mean() for m, own in by.items()}
    assert found["gdlr"] < 0.4 * found["none"]
    assert found["gdlr"] < 0.8 * found["map"]
    adapted = adapt(models, clips)
    rows = [PHONES.index(label) for label in UNHEARD]
    off = [np.linalg.norm(m.mean[rows] - truth.mean[rows]) for m in (models, adapted.models)]
    assert off[1] < 0.85 * off[0]
    kept = adapt(models, clips, "map").models
    np.testing.assert_array_equal(kept.mean[rows], models.mean[rows])


def test_gdlr_does_the_same_in_other_units_and_about_another_origin(world):
    models, _, clips, _ = world
    moved = replace(models, mean=7 + 0.01 * models.mean, variance=1e-4 * models.variance)
    far = [Utterance(7 + 0.01 * u.z, u.labels) for u in clips]
    near, other = adapt(models, clips), adapt(moved, far, smoothness=1e4 * SMOOTHNESS)
    assert other.constants == near.constants
    np.testing.assert_allclose(other.models.mean, 7 + 0.01 * near.models.mean, rtol=1e-9)


def test_candidates_are_judged_by_what_their_errors_are_worth(world):
    """One direction alone counts here; the others are noise."""
    models, _, clips, _ = world
    noise = np.random.default_rng(8)
    clips = [Utterance(u.z + noise.normal(size=u.z.shape) * [0, 0, 4, 4], u.labels) for u in clips]
    direction = np.array([1.0, -1, 0, 0])
    plain = adapt(models, clips, "gdlr")
    seen = adapt(models, clips, "gdlr", weights=np.outer(direction, direction))
    squares = 0.0
    for left_out in clips:
        rest = [u for u in clips if u is not left_out]
        mean = candidate_mean(models, rest, "gdlr", seen.constants)
        y = synthesize_trajectory(
            replace(models, mean=mean), left_out.labels, smoothness=SMOOTHNESS
        )
        squares += float(np.sum(((left_out.z - y) @ direction) ** 2))
    best, frames = seen.candidates.index(seen.constants), sum(len(u.z) for u in clips)
    assert seen.validation[best] == pytest.approx(squares / frames)
    assert seen.validation[best] <= 1.01 * seen.validation.min()
    assert seen.constants != plain.constants
    np.testing.assert_array_equal(seen.training, plain.training)


def test_none_changes_nothing(world):
    models, _, clips, _ = world
    adapted = adapt(models, clips, "none")
    np.testing.assert_array_equal(adapted.models.mean, models.mean)
    assert adapted.constants == {}
    assert adapted.training.shape == adapted.validation.shape == (1,)
    np.testing.assert_allclose(adapted.training, adapted.validation, rtol=1e-12)


@pytest.mark.parametrize("method", METHODS)
def test_curves_are_errors_of_candidates_fitted_on_all_and_on_the_other_clips(world, method):
    models, _, clips, _ = world
    adapted = adapt(models, clips, method)
    candidates = len(adapted.candidates)
    assert adapted.training.shape == adapted.validation.shape == (candidates,)
    alike = np.flatnonzero(adapted.validation <= 1.01 * adapted.validation.min())
    best = int(min(alike, key=lambda i: adapted.training[i]))
    assert adapted.constants == adapted.candidates[best]
    json.dumps(adapted.candidates, allow_nan=False)
    values = sum(u.z.size for u in clips)
    assert adapted.values == values
    total = clip_errors(adapted.models, clips) @ [u.z.size for u in clips]
    np.testing.assert_allclose(adapted.training[best] * values, total, rtol=1e-9)
    # validation of one candidate by hand, each clip left out in turn
    left_out = 0.0
    for i, clip in enumerate(clips):
        rest = [u for k, u in enumerate(clips) if k != i]
        mean = candidate_mean(models, rest, method, adapted.constants)
        left_out += clip_errors(replace(models, mean=mean), [clip])[0] * clip.z.size
    np.testing.assert_allclose(adapted.validation[best] * values, left_out, rtol=1e-9)


def candidate_mean(models, clips, method, constants):
    """The means that one candidate gives, by the public functions of each method."""
    line = lay_out_utterances(models, clips)
    z, rows = np.concatenate([u.z for u in clips]), class_rows(models, CLASSES)
    if method == "none":
        return models.mean
    if method == "map":
        return map_means(models, line.phone, z, tau=constants["tau"])
    if method in ("shift", "mllr"):
        return regress_means(models, line.phone, z, rows, **({"shape": "shift"} | constants))
    system = factor_system(line, models, np.full(D, SMOOTHNESS))
    m, s = standard_units(models)
    mean = (models.mean - m) / s
    chosen = {"shape": constants["shape"]}
    metric = next(own for one, own in bounded_metrics(system, mean, rows) if one == chosen)
    path = descend_means(system, mean, (z - m) / s, rows, metric=constants["rate"] * metric)
    return m + s * path[constants["iterations"]]


def test_gdlr_stops_early_where_there_is_little_to_learn():
    """The clips are of the first person: what goes down in training is noise."""
    rng = np.random.default_rng(1)
    models = first_person(rng)
    adapted = adapt(models, spoken(models, rng, 3, noise=1.0))
    training, validation = adapted.training[adapted.path], adapted.validation[adapted.path]
    assert training.shape == validation.shape == (31,)
    assert (np.diff(training) < 0).all()
    assert validation.argmin() <= adapted.iterations < 5
    assert validation[-1] > validation[adapted.iterations]
    assert {own["rate"] for own in adapted.candidates} == set(RULES["bounded"].rates)


def test_a_descent_that_diverges_leaves_the_models_as_they_are(world):
    models, _, clips, _ = world
    descent = Descent("paper", rates=(1e3,), iterations=500)
    adapted = adapt(models, clips, descent=descent)
    assert adapted.iterations == 0
    np.testing.assert_array_equal(adapted.models.mean, models.mean)
    assert 1 < len(adapted.candidates) == len(adapted.training) < 501
    assert np.isfinite([*adapted.training, *adapted.validation]).all()


def test_only_what_every_fold_has_is_chosen_from(world):
    """Two clips off by opposite amounts: each alone diverges at once, both together much later."""
    models, _, _, _ = world
    rng = np.random.default_rng(5)
    labels = [p for p in PHONES for _ in range(4)]
    y = synthesize_trajectory(models, labels, smoothness=SMOOTHNESS)
    off = rng.normal(size=y.shape)
    clips = [Utterance(y + off, labels), Utterance(y - off, labels)]
    descent = Descent("paper", rates=(1e3,), iterations=500)
    together = len(adapt_path(models, clips, descent))
    alone = min(len(adapt_path(models, [u], descent)) for u in clips)
    assert alone < together
    assert len(adapt(models, clips, descent=descent).candidates) == alone


def adapt_path(models, clips, descent):
    system = factor_system(lay_out_utterances(models, clips), models, np.full(D, SMOOTHNESS))
    rows, z = class_rows(models, CLASSES), np.concatenate([u.z for u in clips])
    ((_, metric),) = paper_metrics(system, models.mean, rows)
    metric = descent.rates[0] * metric
    return descend_means(system, models.mean, z, rows, metric=metric, iterations=descent.iterations)


def test_full_covariances_are_adapted_too(world):
    models, truth, _, _ = world
    rng = np.random.default_rng(2)
    M = np.eye(D) + 0.3 * rng.normal(size=(D, D))
    one, other = (carry(m, M, covariance="full", floor_share=0.01) for m in (models, truth))
    clips, held_out = spoken(other, rng, 5), spoken(other, rng, 6)
    for method in ("shift", "map", "mllr", "gdlr"):
        adapted = adapt(one, clips, method)
        np.testing.assert_array_equal(adapted.models.covariance, one.covariance)
        gain = clip_errors(one, held_out) - clip_errors(adapted.models, held_out)
        assert (gain > 0).all()


def test_one_clip_is_cut_for_the_folds(world):
    models, truth, _, _ = world
    clip = spoken(truth, np.random.default_rng(3), 1)
    adapted = adapt(models, clip)
    assert adapted.iterations > 0
    np.testing.assert_array_equal(adapt(models, clip).models.mean, adapted.models.mean)


def test_a_phone_without_a_model_counts_as_its_stand_in(world):
    models, _, clips, _ = world
    named = [replace(u, labels=["Z" if p == "S" else p for p in u.labels]) for u in clips]
    one, other = adapt(models, clips), adapt(models, named)
    np.testing.assert_array_equal(one.models.mean, other.models.mean)


def test_a_stand_in_does_not_join_neighbouring_segments(world):
    models, _, _, _ = world
    rng = np.random.default_rng(4)
    labels = list(np.repeat(["SIL", "S", "Z", "B", "SIL"], [6, 4, 4, 5, 6]))
    clip = Utterance(rng.normal(size=(25, D)), labels)
    segments = np.repeat(np.arange(5), [6, 4, 4, 5, 6])
    marked = replace(clip, labels=[p.replace("Z", "S") for p in labels], segments=segments)
    np.testing.assert_array_equal(
        adapt(models, [clip] * 2).training, adapt(models, [marked] * 2).training
    )


def test_progress_counts_the_folds_and_can_stop_the_job(world):
    models, _, clips, _ = world
    calls = []
    adapt(models, clips, "map", progress=lambda *call: calls.append(call), folds=3)
    assert calls == [(1, 4), (2, 4), (3, 4), (4, 4)]

    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        adapt(models, clips, "map", progress=stop)


def test_arguments_are_left_as_they_were(world):
    models, _, clips, _ = world
    before = models.mean.copy(), [u.z.copy() for u in clips]
    for method in METHODS:
        adapt(models, clips, method)
    np.testing.assert_array_equal(models.mean, before[0])
    for u, z in zip(clips, before[1], strict=True):
        np.testing.assert_array_equal(u.z, z)


@pytest.mark.parametrize(
    ("labels", "options", "message"),
    [
        (["SIL"] * 30, {}, "hold no speech; give clips in which the person speaks"),
        (["SIL"] * 9 + ["AA"] * 9 + ["SIL"] * 9, {}, "hold one phone only, 'AA'; give clips"),
        (["SIL", "AA", "B"] * 9, {"method": "cmllr"}, "must be one of none, shift, map, mllr"),
        (["SIL", "AA", "B"] * 9, {"folds": 1}, "folds: must be at least 2, got 1"),
        (["SIL", "AA", "B"] * 9, {"classes": CLASSES[1:]}, "phone 'AA' of the model is in 0"),
        (["SIL", "AA", "B"] * 9, {"smoothness": -1.0}, "smoothness: must be"),
        (["SIL", "AA", "B"] * 9, {"weights": np.eye(3)}, r"weights: must have shape \(4, 4\), got"),
    ],
)
def test_bad_input_is_named(world, labels, options, message):
    models, _, _, _ = world
    with pytest.raises(InputError, match=message):
        adapt(models, [Utterance(np.zeros((len(labels), D)), labels)], **options)


def test_no_clips_and_other_dimensions_are_named(world):
    models, _, _, _ = world
    with pytest.raises(InputError, match="hold no speech"):
        adapt(models, [])
    labels = ["SIL", "AA", "B"] * 9
    with pytest.raises(InputError, match=r"models have 4 dimensions.*with the transferred model"):
        adapt(models, [Utterance(np.zeros((27, 3)), labels)])
