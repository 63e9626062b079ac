from dataclasses import replace

import numpy as np
import oracles_model as oracles
import pytest
from scipy.optimize import minimize
from worlds import POSTURES, hold, mouth_pictures

from mmmgpu.analysis import (
    FLOW_RIDGE,
    STEPS,
    TEXTURE_RIDGE,
    analyze,
    fit_flow,
    prepare_analysis,
    solve_simplex,
    thumbnail,
)
from mmmgpu.analysis import _fit_texture as fit_texture
from mmmgpu.analysis import _refine as refine
from mmmgpu.backends import get_backend
from mmmgpu.backends.planes import planes
from mmmgpu.basis import MOUTH
from mmmgpu.errors import InputError
from mmmgpu.synthesis import HOLE, synthesize


@pytest.fixture(scope="module")
def kernels():
    return get_backend("numpy")


@pytest.fixture(scope="module")
def analyzer(basis, kernels):
    return prepare_analysis(basis, kernels)


def picture(basis, alpha, beta):
    return next(synthesize(basis, [alpha], [beta], backend="numpy"))


def psnr(image, wanted, mask):
    miss = (mask[..., None] * (image.astype(float) - wanted) ** 2).sum() / (3 * mask.sum())
    return -10 * np.log10(max(miss, 1e-12))


def regular(gram):
    return gram + TEXTURE_RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))


def problem(n, rank, seed):
    """A random Gram matrix (n, n) of `rank` and a right-hand side within its range."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, rank))
    return a @ a.T, a @ rng.normal(size=rank)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("n", "rank"), [(1, 1), (2, 2), (7, 7), (7, 3), (6, 1)])
def test_beta_is_the_best_of_all_supports(n, rank, seed):
    gram, right = problem(n, rank, seed)
    before = gram.copy(), right.copy()
    got = solve_simplex(gram, right)
    assert got.min() >= 0
    assert got.sum() == pytest.approx(1, abs=1e-12)
    g = regular(gram)
    wanted = oracles.solve_simplex(g, right)

    def cost(b):
        return b @ g @ b / 2 - right @ b

    np.testing.assert_allclose(cost(got), cost(wanted), rtol=1e-7, atol=1e-9)
    if rank == n:
        np.testing.assert_allclose(got, wanted, atol=1e-6)
    np.testing.assert_array_equal(gram, before[0])
    np.testing.assert_array_equal(right, before[1])


@pytest.mark.parametrize(("n", "rank"), [(46, 46), (46, 20), (50, 8)])
def test_beta_of_many_prototypes_meets_the_optimality_conditions(n, rank):
    gram, right = problem(n, rank, 1)
    got = solve_simplex(gram, right)
    slope = regular(gram) @ got - right
    multiplier = slope[got > 1e-9].mean()
    scale = np.abs(slope).max()
    np.testing.assert_allclose(slope[got > 1e-9], multiplier, atol=1e-6 * scale)
    assert (slope[got <= 1e-9] >= multiplier - 1e-6 * scale).all()


def test_beta_agrees_with_slsqp():
    gram, right = problem(12, 12, 3)
    g = regular(gram)
    found = minimize(
        lambda b: b @ g @ b / 2 - right @ b,
        np.full(12, 1 / 12),
        jac=lambda b: g @ b - right,
        bounds=[(0, None)] * 12,
        constraints={"type": "eq", "fun": lambda b: b.sum() - 1, "jac": lambda b: np.ones(12)},
        method="SLSQP",
        options={"ftol": 1e-15, "maxiter": 500},
    )
    np.testing.assert_allclose(solve_simplex(gram, right), found.x, atol=1e-6)


def test_equal_prototypes_share_their_beta():
    gram, _ = problem(3, 3, 0)
    twice = [0, 1, 2, 2]
    alone = solve_simplex(gram, gram[2])
    both = solve_simplex(gram[np.ix_(twice, twice)], gram[2][twice])
    assert alone[2] > 0.9
    np.testing.assert_allclose(both[2:].sum(), alone[2], atol=1e-3)
    assert both[2] == pytest.approx(both[3], abs=1e-3)


def test_float32_sums_are_good_enough():
    gram, right = problem(46, 30, 5)
    single = solve_simplex(gram.astype(np.float32), right.astype(np.float32))
    double = solve_simplex(gram, right)
    g = regular(gram)
    cost = [b @ g @ b / 2 - right @ b for b in (single, double)]
    assert cost[0] - cost[1] < 1e-8 * abs(cost[1])


def test_alpha_is_the_ridge_regression_of_the_flow(basis, analyzer):
    rng = np.random.default_rng(0)
    flow = rng.normal(size=analyzer.basis.flows.shape[1:]).astype(np.float32)
    rows, wanted = [], []
    h, w = analyzer.basis.w_f.shape
    for y in range(h):
        for x in range(w):
            weight = analyzer.basis.w_f[y, x]
            if weight > 0.02 and (x + y) % 2 == 0:
                for c in range(2):
                    own = analyzer.basis.flows[analyzer.basis.moving, y, x, c]
                    rows.append(np.sqrt(weight) * own.astype(float))
                    wanted.append(np.sqrt(weight) * float(flow[y, x, c]))
    rows = np.array(rows)
    ridge = np.sqrt(FLOW_RIDGE * (rows**2).sum() / rows.shape[1]) * np.eye(rows.shape[1])
    system = np.concatenate([rows, ridge])
    right = np.append(wanted, np.zeros(len(ridge)))
    solution = np.linalg.lstsq(system, right, rcond=None)[0]
    np.testing.assert_allclose(fit_flow(analyzer, flow), solution, rtol=1e-3, atol=1e-4)


def test_a_flow_of_the_model_gives_its_alpha(analyzer):
    alpha = np.array([0.3, -0.2, 0.5, 0.1])
    got = fit_flow(analyzer, analyzer.basis.flow(alpha))
    np.testing.assert_allclose(got, alpha, atol=0.03)  # the ridge pulls a little


def test_the_region_is_cut_to_its_masks(basis, analyzer):
    assert analyzer.basis.w_t.size < basis.w_t.size
    for name in ("w_f", "w_t"):
        assert getattr(analyzer.basis, name).sum() == pytest.approx(
            getattr(basis, name).sum(), rel=0.01
        )
        cut = getattr(basis, name)[analyzer.inside]
        np.testing.assert_array_equal(getattr(analyzer.basis, name), cut)


def test_thumbnails_see_only_what_the_mask_shows(basis):
    image = basis.images[1].copy()
    small = thumbnail(image, basis.w_t)
    image[basis.w_t == 0] = 1.0
    np.testing.assert_array_equal(thumbnail(image, basis.w_t), small)
    image[basis.w_t > 0.9] = 1.0
    assert np.abs(thumbnail(image, basis.w_t) - small).max() > 0.1


@pytest.mark.parametrize("seed", range(3))
def test_a_picture_of_the_model_is_made_again(basis, analyzer, kernels, seed):
    rng = np.random.default_rng(seed)
    alpha = rng.dirichlet(np.ones(5))[1:]
    beta = rng.dirichlet(np.full(5, 0.7))
    image = picture(basis, alpha, beta)
    a, b = analyze(analyzer, image)
    assert a.shape == (4,)
    assert b.shape == (5,)
    assert b.min() >= 0
    assert b.sum() == pytest.approx(1)
    again = picture(basis, a, b)
    assert psnr(again, image, basis.w_t) > 38
    neutral = basis.images[basis.reference]
    assert psnr(again, image, basis.w_t) > psnr(neutral, image, basis.w_t) + 6


def test_prototypes_are_made_again(basis, analyzer, kernels):
    for image in basis.images:
        a, b = analyze(analyzer, image)
        assert psnr(picture(basis, a, b), image, basis.w_t) > 36


def test_postures_between_the_prototypes_are_made(face_and_basis, analyzer, kernels):
    face, basis = face_and_basis
    new = hold(
        POSTURES[0], {"jaw": 0.7, "press": 0.0, "lower_lip": 0.2}, {"jaw": 0.3, "press": 0.0}
    )
    for image in mouth_pictures(face, new, basis.region)[1:]:
        a, b = analyze(analyzer, image)
        made = psnr(picture(basis, a, b), image, basis.w_t)
        nearest = max(psnr(p, image, basis.w_t) for p in basis.images)
        assert made > 28
        assert made > nearest + 2


def test_both_backends_find_the_same(basis, analyzer, backend):
    image = (0.5 * basis.images[1] + 0.5 * basis.images[2]).astype(np.float32)
    wanted = analyze(analyzer, image)
    got = analyze(prepare_analysis(basis, get_backend(backend)), image)
    for a, b in zip(got, wanted, strict=True):
        np.testing.assert_allclose(a, b, atol=2e-3)


@pytest.mark.parametrize("seed", range(4))
def test_the_fit_of_texture_makes_the_picture_of_the_unfused_reference(basis, backend, seed):
    """To 1e-4, of flows and pictures that are none of the prototypes'."""
    rng = np.random.default_rng(seed)
    alpha, beta = rng.normal(0, 0.3, len(basis.moving)), rng.dirichlet(np.ones(len(basis.images)))
    image = picture(basis, alpha, beta) + rng.normal(0, 0.02, basis.images[0].shape)
    made = []
    for name in ("numpy", backend):
        analyzer = prepare_analysis(basis, get_backend(name))
        wanted = planes(image[analyzer.inside].astype(np.float32))
        every = np.arange(len(basis.images))
        got = fit_texture(analyzer, wanted, analyzer.basis.flow(alpha), every)[0]
        made.append(picture(basis, alpha, got))
    np.testing.assert_allclose(made[1], made[0], rtol=0, atol=1e-4)


def test_no_moved_prototypes_are_brought_to_the_host(basis, backend, monkeypatch):
    """Only what is solved for beta, and the one picture that a step looks at."""
    kernels = get_backend(backend)
    analyzer = prepare_analysis(basis, kernels)
    fetch, fetched = type(kernels).to_host, []

    def watched(self, array):
        fetched.append(tuple(array.shape))
        return fetch(self, array)

    monkeypatch.setattr(type(kernels), "to_host", watched)
    analyze(analyzer, basis.images[1])
    pictures = [shape for shape in fetched if len(shape) > 2]
    assert pictures == [(1, 3, *analyzer.masked.plane.shape)] * STEPS
    assert (6, 5) in fetched  # the equations of all five


def test_beta_explains_the_pixels_of_the_mask_and_no_others(basis, analyzer, kernels):
    rng = np.random.default_rng(0)
    image = np.where(basis.w_t[..., None] > 0.2, basis.images[1], rng.random(basis.images[1].shape))
    alpha, beta = analyze(analyzer, image.astype(np.float32))
    part = analyzer.basis
    residual = part.flow(alpha)[None] - part.flows
    oriented = kernels.fill_holes(*kernels.forward_warp(residual, part.flows), HOLE)
    moved = kernels.fill_holes(*kernels.forward_warp(part.images, oriented), HOLE)
    weight = np.where(part.w_t > MOUTH, part.w_t, 0)[..., None]
    gram = np.einsum("mhwc,nhwc->mn", weight * moved, moved)
    right = np.einsum("mhwc,hwc->m", weight * moved, image[analyzer.inside])
    np.testing.assert_allclose(beta, solve_simplex(gram, right), rtol=0, atol=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_a_step_lowers_the_difference_of_the_pictures(basis, analyzer, kernels, seed):
    rng = np.random.default_rng(seed)
    beta = rng.dirichlet(np.ones(5))
    alpha = rng.dirichlet(np.ones(5))[1:]
    image = picture(basis, alpha, beta)[analyzer.inside]
    start = alpha + 0.12 * rng.normal(size=4)
    everything = np.arange(5)

    def error(a):
        _, made = fit_texture(analyzer, planes(image), analyzer.basis.flow(a), everything)
        return -psnr(made, image, analyzer.basis.w_f), made

    before, made = error(start)
    stepped = refine(analyzer, image, start, analyzer.basis.flow(start), made)
    assert error(stepped)[0] < before - 1


def test_a_step_from_the_truth_stays(basis, analyzer, kernels):
    alpha = np.array([0.2, 0.3, 0.1, 0.1])
    beta = np.array([0.2, 0.3, 0.2, 0.2, 0.1])
    image = picture(basis, alpha, beta)[analyzer.inside]
    stepped = refine(analyzer, image, alpha, analyzer.basis.flow(alpha), image)
    np.testing.assert_allclose(stepped, alpha, atol=0.02)


def test_inputs_are_not_changed(basis, analyzer, kernels):
    image = basis.images[3].copy()
    analyze(analyzer, image)
    np.testing.assert_array_equal(image, basis.images[3])
    again = prepare_analysis(replace(basis), kernels)
    np.testing.assert_array_equal(again.thumbnails, analyzer.thumbnails)


def test_prototypes_that_do_not_move_are_an_error(basis, kernels):
    with pytest.raises(InputError, match="never moves"):
        prepare_analysis(replace(basis, flows=np.zeros_like(basis.flows)), kernels)
    with pytest.raises(InputError, match="never moves"):
        prepare_analysis(replace(basis, w_f=np.zeros_like(basis.w_f)), kernels)
