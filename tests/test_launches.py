"""What every runtime makes of moved and mixed prototypes, against the reference."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_operations_equivalence import FLOWS, SIZES

from mmmgpu.backends import get_backend
from mmmgpu.errors import InputError

HOLE = 0.1
NUMBER = 3
KINDS = sorted(set(FLOWS) - {"leaving", "1e6", "1e30"})  # these can leave a prototype nothing


def prototypes(name, size, seed=0):
    """Images (3, h, w, 3) and flows (3, h, w, 2), the first zero."""
    rng = np.random.default_rng(seed)
    flows = np.stack([FLOWS[name](rng, *size) for _ in range(NUMBER)])
    flows[0] = 0
    return rng.random((NUMBER, *size, 3), dtype=np.float32), flows


def placed(size, pixels):
    """Each of `pixels` goes to its position in the list, all others nowhere."""
    places = np.full(size[0] * size[1], -1, np.int32)
    places[list(pixels)] = np.arange(len(pixels))
    return places.reshape(size)


def moved(name, images, flows, flow, used, pixels, scale=None, threads=None):
    k, size = get_backend(name, threads), images.shape[1:3]
    held = k.hold_prototypes(images, flows, HOLE)
    scale = np.ones(size) if scale is None else scale
    given = flow, np.int32(used), placed(size, pixels), np.float32(scale)
    return k.to_host(k.move_prototypes(held, *map(k.to_device, given), len(pixels)))


def mixed(name, images, flows, wanted, weights, pixels, scale=None, threads=None):
    k, size = get_backend(name, threads), images.shape[1:3]
    held = k.hold_prototypes(images, flows, HOLE)
    scale = np.ones(size) if scale is None else scale
    given = wanted, np.float32(weights), placed(size, pixels), np.float32(scale)
    return k.to_host(k.mix_prototypes(held, *map(k.to_device, given), len(pixels)))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("own", KINDS)
@pytest.mark.parametrize("to", ["zero", "random", "tearing", "converging"])
def test_moved_prototypes(backend, own, to, size):
    images, flows = prototypes(own, size)
    flow = FLOWS[to](np.random.default_rng(3), *size)
    rng = np.random.default_rng(4)
    pixels, scale = rng.permutation(size[0] * size[1])[::2], rng.random(size)
    given = images, flows, flow, [2, 0, 1, 2], pixels, scale
    try:
        desired = moved("numpy", *given)
    except InputError:
        with pytest.raises(InputError):
            moved(backend, *given)
        return
    assert_allclose(moved(backend, *given), desired, rtol=0, atol=1e-4)


@pytest.mark.parametrize("size", SIZES[4:])
@pytest.mark.parametrize("own", KINDS)
def test_mixed_prototypes(backend, own, size):
    images, flows = prototypes(own, size)
    rng = np.random.default_rng(5)
    weights = rng.dirichlet(np.ones(NUMBER), 4)
    weights[1, 0] = 0
    wanted = np.einsum("bm,mhwc->bhwc", rng.normal(0, 0.5, (4, NUMBER)), flows).astype(np.float32)
    pixels = rng.permutation(size[0] * size[1])[::2]
    given = images, flows, wanted, weights, pixels, rng.random(size)
    desired = mixed("numpy", *given)
    assert_allclose(mixed(backend, *given), desired, rtol=0, atol=1e-4)


def test_the_reference_mixes_what_it_moves():
    images, flows = prototypes("random", (9, 12))
    weights, pixels = np.float32([[0.2, 0.5, 0.3]]), np.arange(10, 60, 3)
    apart = moved("numpy", images, flows, flows[2], range(NUMBER), pixels)
    together = mixed("numpy", images, flows, flows[2:], weights, pixels)
    assert_allclose(together[0], np.tensordot(weights[0], apart, axes=1), rtol=0, atol=1e-6)


def test_a_prototype_without_weight_is_not_looked_at(backend):
    images, flows = prototypes("random", (9, 12))
    other = images.copy()
    other[1] = np.nan
    weights, pixels = [[0.4, 0, 0.6], [0.0, 0.0, 0.0]], np.arange(9 * 12)
    wanted = np.stack([flows[2], flows[1]])
    pictures = mixed(backend, images, flows, wanted, weights, pixels)
    assert_array_equal(mixed(backend, other, flows, wanted, weights, pixels), pictures)
    assert_array_equal(pictures[1], 0)


@pytest.mark.parametrize(("frames", "pixels"), [(0, 5), (2, 0), (0, 0)])
def test_nothing_asked_gives_nothing(backend, frames, pixels):
    images, flows = prototypes("random", (5, 4))
    wanted, weights = flows[:frames], np.ones((frames, NUMBER))
    assert mixed(backend, images, flows, wanted, weights, range(pixels)).shape == (
        frames,
        pixels,
        3,
    )
    empty = moved(backend, images, flows, flows[1], [], range(pixels))
    assert empty.shape == (0, pixels, 3)


def test_any_number_of_threads_gives_the_same_bits(backend):
    images, flows = prototypes("tearing", (33, 64))
    wanted, pixels = flows[::-1].copy(), np.arange(33 * 64)
    weights = np.random.default_rng(6).random((NUMBER, NUMBER))
    for run, given in (
        (mixed, (wanted, weights, pixels)),
        (moved, (wanted[0], [0, 1, 2], pixels)),
    ):
        one, *others = (run(backend, images, flows, *given, threads=n) for n in (1, 2, 5))
        for other in others:
            assert_array_equal(other, one)


def test_a_prototype_that_leaves_the_picture_is_an_error(backend):
    images, flows = prototypes("zero", (6, 6))
    gone = np.full((6, 6, 2), 50, np.float32)
    with pytest.raises(InputError, match="no pixel"):
        moved(backend, images, flows, gone, [0], [1])
    with pytest.raises(InputError, match="no pixel"):
        mixed(backend, images, flows, np.stack([flows[0], gone]), np.ones((2, NUMBER)), [1])
