"""The border of the public operations: shapes, batches, errors, and inputs left alone."""

import inspect

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mmmgpu import operations
from mmmgpu.errors import InputError

ONES = np.ones((2, 4, 5, 3), np.float32)
FLOW = np.zeros((2, 4, 5, 2), np.float32)
POINTS = np.ones((2, 7, 2), np.float32)
MESH = {
    "triangles": np.array([[0, 1, 2], [2, 3, 6]], np.int32),
    "index": np.array([0, 1, 1, 0, 1], np.int32),
    "barycentric": np.full((5, 3), 1 / 3, np.float32),
}

CALLS = {
    "forward_warp": {"field": ONES, "flow": FLOW},
    "fill_holes": {"field": ONES, "weight": ONES[..., 0]},
    "blend": {"images": ONES, "weights": ONES[..., 0, 0, :2]},
    "normal_equations": {"images": ONES, "wanted": ONES[0]},
    "sample": {"field": ONES, "points": POINTS},
    "distance_scan": {"queries": ONES[0], "corpus": ONES[1], "weights": ONES[0, 0, :, 0]},
    "evaluate_rbf": {
        "points": POINTS,
        "centres": POINTS[0],
        "weights": POINTS[1],
        "affine": ONES[0, :2, 0],
    },
    "piecewise_warp": {"field": ONES, "vertices": POINTS, **MESH},
}
SCALARS = {"evaluate_rbf": {"sharpness": 0.1}}
ARGUMENTS = [(name, argument) for name, call in CALLS.items() for argument in call]
WHOLE = {"triangles": 7, "index": 2}  # numbers, and what they are below
REAL = [(name, argument) for name, argument in ARGUMENTS if argument not in WHOLE]


def call(name, backend="numpy", **changed):
    given = {**CALLS[name], **SCALARS.get(name, {}), **changed}
    return getattr(operations, name)(**given, backend=backend)


def first(result):
    return result[0] if isinstance(result, tuple) else result


@pytest.mark.parametrize(("name", "argument"), REAL)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e39])
def test_values_that_are_not_finite_name_the_argument(name, argument, bad):
    spoilt = CALLS[name][argument].astype(np.float64)
    spoilt.flat[-1] = bad
    with pytest.raises(InputError, match=rf"^{argument} holds NaN or infinite values"):
        call(name, **{argument: spoilt})


@pytest.mark.parametrize("argument", WHOLE)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -1, 0.5, None, 1e39])
def test_whole_numbers_out_of_range_name_the_argument(argument, bad):
    spoilt = MESH[argument].astype(np.float64)
    spoilt.flat[-1] = WHOLE[argument] if bad is None else bad
    says = "must hold whole numbers from 0 to" if np.isfinite(spoilt).all() else "holds NaN"
    with pytest.raises(InputError, match=rf"^{argument} {says}"):
        call("piecewise_warp", **{argument: spoilt})


@pytest.mark.parametrize(("name", "argument"), ARGUMENTS)
def test_a_wrong_shape_names_the_argument_and_both_shapes(name, argument):
    with pytest.raises(InputError, match=rf"^{argument} must have shape \(.+\), got \(\)"):
        call(name, **{argument: np.float32(1)})


@pytest.mark.parametrize(("name", "argument"), ARGUMENTS)
@pytest.mark.parametrize("bad", ["text", [[1], [1, 2]], np.ones(3, complex)])
def test_what_is_not_a_number_names_the_argument(name, argument, bad):
    with pytest.raises(InputError, match=rf"^{argument} "):
        call(name, **{argument: bad})


@pytest.mark.parametrize("name", CALLS)
def test_inputs_are_unchanged_and_results_are_new(backend, name):
    given = {k: v.copy() for k, v in CALLS[name].items()}
    result = first(call(name, backend, **given))
    result[...] = 7
    for argument, array in given.items():
        assert_array_equal(array, CALLS[name][argument])


@pytest.mark.parametrize("name", CALLS)
def test_read_only_strided_and_float64_inputs_are_welcome(backend, name):
    def awkward(array):
        wide = np.repeat(array.astype(np.float64), 2, axis=0)[::2]
        wide.flags.writeable = False
        return wide

    given = {k: awkward(v) for k, v in CALLS[name].items()}
    assert_array_equal(first(call(name, backend, **given)), first(call(name, backend)))


@pytest.mark.parametrize("lead", [(), (1,), (2, 3), (2, 1, 2), (0,), (3, 0)])
def test_the_batch_axes_may_have_any_shape(backend, lead):
    rng = np.random.default_rng(0)
    field = rng.normal(0, 1, (*lead, 4, 5, 3)).astype(np.float32)
    flow = rng.normal(0, 1, (*lead, 4, 5, 2)).astype(np.float32)
    weights = rng.random((*lead, 6))
    warped, weight = operations.forward_warp(field, flow, backend=backend)
    filled = operations.fill_holes(field, weight + 1, backend=backend)
    sampled = operations.sample(field, flow, backend=backend)
    blended = operations.blend(np.ones((6, 4, 5, 3)), weights, backend=backend)
    mapped = call("evaluate_rbf", backend, points=flow)
    vertices = flow.reshape(*lead, 20, 2)
    read = call("piecewise_warp", backend, field=field, vertices=vertices)
    assert read.shape == (*lead, 5, 3)
    assert mapped.shape == flow.shape
    assert warped.shape == filled.shape == sampled.shape == blended.shape == field.shape
    assert weight.shape == field.shape[:-1]
    for index in np.ndindex(lead):
        one, w = operations.forward_warp(field[index], flow[index], backend=backend)
        assert_array_equal(warped[index], one)
        assert_array_equal(weight[index], w)
        assert_array_equal(
            sampled[index], operations.sample(field[index], flow[index], backend=backend)
        )
        assert_array_equal(mapped[index], call("evaluate_rbf", backend, points=flow[index]))
        one = call("piecewise_warp", backend, field=field[index], vertices=vertices[index])
        assert_array_equal(read[index], one)


def test_batch_axes_broadcast(backend):
    rng = np.random.default_rng(0)
    field = rng.normal(0, 1, (2, 1, 4, 5, 3)).astype(np.float32)
    flow = rng.normal(0, 1, (3, 4, 5, 2)).astype(np.float32)
    warped, _ = operations.forward_warp(field, flow, backend=backend)
    for i, j in np.ndindex(2, 3):
        one, _ = operations.forward_warp(field[i, 0], flow[j], backend=backend)
        assert_array_equal(warped[i, j], one)


@pytest.mark.parametrize(("fields", "sets"), [((), (3,)), ((3,), (1,)), ((1,), (3,)), ((3,), (3,))])
def test_points_and_fields_broadcast(backend, fields, sets):
    rng = np.random.default_rng(0)
    field = rng.normal(0, 1, (*fields, 4, 5, 2)).astype(np.float32)
    points = rng.uniform(0, 4, (*sets, 6, 2)).astype(np.float32)
    sampled = operations.sample(field, points, backend=backend)
    assert sampled.shape == (3, 6, 2)
    every = np.broadcast_to(field, (3, 4, 5, 2)), np.broadcast_to(points, (3, 6, 2))
    for b, (f, p) in enumerate(zip(*every, strict=True)):
        assert_array_equal(sampled[b], operations.sample(f, p, backend=backend))


def test_batch_axes_that_do_not_broadcast_are_named():
    with pytest.raises(InputError, match=r"field \(2,\), flow \(3,\)"):
        call("forward_warp", flow=np.zeros((3, 4, 5, 2)))


def test_scans_and_blends_of_nothing(backend):
    nothing = np.ones((0, 5, 3))
    assert call("distance_scan", backend, queries=nothing).shape == (0, 4)
    assert call("distance_scan", backend, corpus=nothing).shape == (4, 0)
    assert_array_equal(call("blend", backend, images=ONES[:0], weights=np.ones((2, 0))), 0 * ONES)
    gram, right = call("normal_equations", backend, images=ONES[:0])
    assert (gram.shape, right.shape) == ((0, 0), (0,))
    gram, right = call("normal_equations", backend, images=ONES[:, :0], wanted=ONES[0, :0])
    assert_array_equal(np.vstack([gram, right]), np.zeros((3, 2)))


def test_a_field_without_a_valid_pixel_is_an_error_that_says_which(backend):
    weight = np.ones((3, 4, 5))
    weight[1] = 0.2
    with pytest.raises(InputError, match=r"weight: field 1 of the batch has no pixel"):
        operations.fill_holes(np.ones((3, 4, 5, 2)), weight, threshold=0.25, backend=backend)


def test_a_weight_at_the_threshold_is_valid(backend):
    field = np.arange(6, dtype=np.float32).reshape(1, 6, 1)
    weight = np.array([[0.25, 0.25, 0.2499, 1, 1, 0.25]])
    filled = operations.fill_holes(field, weight, threshold=0.25, backend=backend)
    assert_array_equal((filled != field)[..., 0], [[False, False, True, False, False, False]])


def test_a_threshold_that_is_not_finite_is_an_error():
    with pytest.raises(InputError, match="threshold must be a finite number, got nan"):
        call("fill_holes", threshold=np.nan)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -0.1, 1e39])
def test_a_sharpness_that_makes_no_gaussians_is_an_error(bad):
    with pytest.raises(InputError, match="sharpness must be a finite number, at least 0, got"):
        call("evaluate_rbf", sharpness=bad)


@pytest.mark.parametrize("argument", ["centres", "weights"])
def test_every_centre_needs_a_weight(argument):
    with pytest.raises(InputError, match=r"weights must have shape \(\d, 2\), got \(\d, 2\)"):
        call("evaluate_rbf", **{argument: POINTS[0, :6]})


def test_without_centres_the_map_is_affine(backend):
    none = np.zeros((0, 2))
    mapped = call("evaluate_rbf", backend, points=[[2, 3]], centres=none, weights=none)
    assert_array_equal(mapped, [[6, 6]])


def test_points_must_have_the_batch_axes_of_the_field():
    with pytest.raises(InputError, match=r"points must have shape .* got \(2,\)"):
        call("sample", points=np.ones(2))


@pytest.mark.parametrize("name", CALLS)
def test_options_are_keyword_only(name):
    parameters = inspect.signature(getattr(operations, name)).parameters.values()
    assert all((p.kind == p.KEYWORD_ONLY) == (p.default is not p.empty) for p in parameters)
