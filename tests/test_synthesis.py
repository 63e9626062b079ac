from dataclasses import replace

import numpy as np
import oracles_model as oracles
import pytest

from mmmgpu.backends import get_backend
from mmmgpu.basis import around, cut
from mmmgpu.compositing import looked_at
from mmmgpu.synthesis import (
    BATCH,
    HOLE,
    NO_TEXTURE,
    from_whole_blocks,
    prepare_synthesis,
    synthesize,
    synthesize_batch,
)

ALL = ("numpy", "warp", "opencl")


def coordinates(basis, seed=0, frames=3):
    """Random alphas (T, M - 1) of about unit length and betas (T, M) on the simplex."""
    rng = np.random.default_rng(seed)
    count = len(basis.images)
    alpha = rng.normal(0, 0.4, (frames, count - 1))
    return alpha, rng.dirichlet(np.ones(count), frames)


@pytest.mark.parametrize("seed", [0, 1])
def test_synthesis_is_equation_1_and_2(basis, seed):
    alpha, beta = coordinates(basis, seed)
    made = list(synthesize(basis, alpha, beta, backend="numpy"))
    assert len(made) == 3
    for image, a, b in zip(made, alpha, beta, strict=True):
        assert image.dtype == np.float32
        np.testing.assert_allclose(image, oracles.synthesize(basis, a, b), atol=1e-5)


def test_every_backend_makes_the_same_pictures(basis, backend):
    alpha, beta = coordinates(basis, 2)
    wanted = synthesize(basis, alpha, beta, backend="numpy")
    for image, reference in zip(
        synthesize(basis, alpha, beta, backend=backend), wanted, strict=True
    ):
        np.testing.assert_allclose(image, reference, atol=1e-4)


def unfused(basis, alpha, beta, name):
    """Eq. 2 of one frame as a chain of single operations."""
    k = get_backend(name)
    flows = k.to_device(basis.flows)
    moved = k.forward_warp(k.to_device(basis.flow(alpha)[None] - basis.flows), flows)
    oriented = k.fill_holes(*moved, HOLE)
    texture = k.fill_holes(*k.forward_warp(k.to_device(basis.images), oriented), HOLE)
    return k.to_host(k.blend(texture, k.to_device(np.float32(beta)[None])))[0]


def test_one_launch_makes_what_the_chain_of_operations_makes(basis, backend):
    alpha, beta = coordinates(basis, 4)
    made = synthesize_batch(prepare_synthesis(basis, backend=backend), alpha, beta)
    for image, a, b in zip(made, alpha, beta, strict=True):
        np.testing.assert_allclose(image, unfused(basis, a, b, backend), rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", ALL)
def test_a_prototype_s_own_coordinates_give_it_back(basis, name):
    count = len(basis.images)
    alpha, beta = np.zeros((count, count - 1)), np.eye(count)
    alpha[basis.moving] = np.eye(count - 1)
    made = synthesize(basis, alpha, beta, backend=name)
    for image, prototype in zip(made, basis.images, strict=True):
        np.testing.assert_allclose(image, prototype, rtol=0, atol=2e-5)


@pytest.mark.parametrize("name", ALL)
def test_prototypes_without_texture_do_not_matter(basis, name):
    alpha, beta = coordinates(basis)
    beta[:, [1, 3]] = 0
    images = basis.images.copy()
    images[[1, 3]] = 0.123
    made, other = (
        list(synthesize(b, alpha, beta, backend=name))
        for b in (basis, replace(basis, images=images))
    )
    np.testing.assert_array_equal(made, other)


def test_prototypes_without_texture_cost_nothing(basis, monkeypatch):
    kernels = get_backend("numpy")
    move, moved = type(kernels).move_prototypes, []

    def counted(self, held, flow, used, scale):
        moved.extend(used.tolist())
        return move(self, held, flow, used, scale)

    monkeypatch.setattr(type(kernels), "move_prototypes", counted)
    beta = np.array([[0.5, 0, 0, 0.5, 0], [0, NO_TEXTURE / 2, 1, 0, 0]])
    synthesize_batch(prepare_synthesis(basis, backend="numpy"), np.zeros((2, 4)), beta)
    assert moved == [0, 3, 2]


def test_textures_that_cannot_be_seen_cost_no_brightness(basis):
    alpha, _ = coordinates(basis, frames=1)
    beta = np.full((1, len(basis.images)), 0.99 * NO_TEXTURE)
    beta[0, 0] = 1 - beta[0, 1:].sum()
    only = np.eye(len(basis.images))[:1]
    made, wanted = (list(synthesize(basis, alpha, b, backend="numpy")) for b in (beta, only))
    np.testing.assert_array_equal(made, wanted)


@pytest.mark.parametrize("name", ALL)
def test_pictures_stay_in_range(basis, name):
    bright = replace(basis, images=np.ones_like(basis.images))
    alpha, beta = coordinates(basis, 3)
    for image in synthesize(bright, 3 * alpha, beta, backend=name):
        np.testing.assert_allclose(image, 1, rtol=0, atol=1e-5)
        assert image.max() <= 1


@pytest.mark.parametrize("name", ALL)
def test_only_what_is_shown_is_made(basis, name):
    """A part of the picture is that of the basis cut to it; the rest is the reference."""
    h, w = basis.w_t.shape
    shown = np.zeros((h, w), bool)
    shown[h // 4 : -h // 4, w // 3 : -w // 3] = basis.w_t[h // 4 : -h // 4, w // 3 : -w // 3] > 0.5
    alpha, beta = coordinates(basis, 5, frames=1)
    prepared = prepare_synthesis(basis, shown=shown, backend=name)
    made = synthesize_batch(prepared, alpha, beta)[0]
    inside = from_whole_blocks(around(shown))
    part = unfused(cut(basis, inside), alpha[0], beta[0], "numpy")
    seen = shown[inside]
    np.testing.assert_allclose(made[inside][seen], part[seen], rtol=0, atol=1e-4)
    np.testing.assert_array_equal(made[~shown], basis.images[basis.reference][~shown])


def test_what_a_composite_does_not_see_does_not_matter(basis):
    """Outside of the cover nothing moves: the mouth does not change when that is left out."""
    alpha, beta = coordinates(basis, 6, frames=8)
    shown = looked_at(basis.cover)
    assert not shown.all()
    every = synthesize_batch(prepare_synthesis(basis), alpha, beta)
    some = synthesize_batch(prepare_synthesis(basis, shown=shown), alpha, beta)
    np.testing.assert_allclose(some[:, shown], every[:, shown], rtol=0, atol=1e-4)


def test_a_part_fills_its_holes_as_the_whole_picture_does(basis):
    """A tear of 7 px, in a part that begins at no round number."""
    h, w = 61, 75
    y, x = np.mgrid[:h, :w]
    flows = np.zeros((2, h, w, 2), np.float32)
    torn = (abs(y - 33) < 8) & (abs(x - 41) < 12)
    flows[1, ..., 0] = np.where(torn, np.where(x < 41, -3.5, 3.5), 0)
    images = np.random.default_rng(0).random((2, h, w, 3), dtype=np.float32)
    two = replace(basis, images=images, flows=flows, reference=0, w_t=np.ones((h, w)))
    shown = (abs(y - 33) < 14) & (abs(x - 41) < 18)
    every, some = (
        synthesize_batch(prepare_synthesis(two, shown=s), np.ones((1, 1)), np.array([[1.0, 0]]))[0]
        for s in (None, shown)
    )
    np.testing.assert_allclose(some[shown], every[shown], rtol=0, atol=1e-4)
    assert np.abs(every - images[0])[shown].max() > 0.1


def test_the_number_of_frames_at_a_time_does_not_matter(basis, backend):
    alpha, beta = coordinates(basis, 7, frames=BATCH + 3)
    made = list(synthesize(basis, alpha, beta, backend=backend))
    prepared = prepare_synthesis(basis, backend=backend)
    for t in (0, BATCH - 1, BATCH, BATCH + 2):
        alone = synthesize_batch(prepared, alpha[t : t + 1], beta[t : t + 1])
        np.testing.assert_array_equal(made[t], alone[0])


def test_synthesis_is_lazy(basis):
    alpha, beta = coordinates(basis, frames=1)
    asked = []

    def endless(row):
        while True:
            asked.append(1)
            yield row

    made = synthesize(basis, endless(alpha[0]), endless(beta[0]), backend="numpy")
    next(made)
    assert len(asked) == 2 * BATCH


def test_no_frames_are_none(basis):
    assert list(synthesize(basis, [], [], backend="numpy")) == []


def test_inputs_are_not_changed(basis, backend):
    alpha, beta = coordinates(basis, 8)
    before = alpha.copy(), beta.copy()
    synthesize_batch(prepare_synthesis(basis, backend=backend), alpha, beta)
    np.testing.assert_array_equal(alpha, before[0])
    np.testing.assert_array_equal(beta, before[1])
