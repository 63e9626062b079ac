"""What every runtime makes of moved and mixed prototypes, against the reference."""

import functools
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pyopencl as cl
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_operations_equivalence import FLOWS, SIZES

from mmmgpu.backends import get_backend, opencl
from mmmgpu.backends.launches import GPU_WORKERS
from mmmgpu.backends.moved_equations import BAND
from mmmgpu.backends.planes import planes
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


def some_of(size, rng):
    """A scale (h, w) between 0 and 1 that asks for about half of the pixels, and for the first."""
    scale = np.float32(rng.random(size) * (rng.random(size) < 0.5))
    scale[0, 0] = 0.7
    return scale


def moved(name, images, flows, flow, used, scale, threads=None):
    k = get_backend(name, threads)
    held = k.hold_prototypes(images, flows, HOLE)
    to, how = map(k.to_device, (planes(flow[None]), planes(scale[..., None])[0]))
    made = k.to_host(k.move_prototypes(held, to, np.array(used, int), how))
    return np.moveaxis(made[..., : images.shape[2]], 1, -1)


def equations(name, images, flows, flow, used, scale, wanted, threads=None):
    k = get_backend(name, threads)
    held = k.hold_prototypes(images, flows, HOLE)
    image, how = map(k.to_device, (planes(wanted), planes(scale[..., None])[0]))
    return k.to_host(k.prototype_equations(held, planes(flow), np.array(used, int), image, how))


def mixed(name, *given, threads=None):
    return mix(get_backend(name, threads), *given)


def mix(k, images, flows, wanted, weights, scale):
    held = k.hold_prototypes(images, flows, HOLE)
    to, how = map(k.to_device, (planes(wanted), planes(scale[..., None])[0]))
    made = k.to_host(k.mix_prototypes(held, to, np.float32(weights), how))
    return np.moveaxis(made[..., : images.shape[2]], 1, -1)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("own", KINDS)
@pytest.mark.parametrize("to", ["zero", "random", "tearing", "converging"])
def test_moved_prototypes(backend, own, to, size):
    images, flows = prototypes(own, size)
    flow = FLOWS[to](np.random.default_rng(3), *size)
    given = images, flows, flow, [2, 0, 1, 2], some_of(size, np.random.default_rng(4))
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
    given = images, flows, wanted, weights, some_of(size, rng)
    desired = mixed("numpy", *given)
    assert_allclose(mixed(backend, *given), desired, rtol=0, atol=1e-4)


@pytest.mark.parametrize("mixtures", [1, 2, 3, 4, 5, 7, 8])
def test_mixtures_whose_flows_are_oriented_together_are_as_alone(backend, mixtures):
    k, size = replace(get_backend(backend), workers=1), (9, 20)
    images, flows = prototypes("tearing", size)
    rng = np.random.default_rng(8)
    weights, scale = rng.dirichlet(np.ones(NUMBER), mixtures), some_of(size, rng)
    wanted = rng.normal(0, 2, (mixtures, *size, 2)).astype(np.float32)
    made = mix(k, images, flows, wanted, weights, scale)
    for b in range(mixtures):
        alone = mix(k, images, flows, wanted[b : b + 1], weights[b : b + 1], scale)
        assert_array_equal(made[b], alone[0])


@pytest.mark.parametrize("mixtures", [1, 2, 5])
def test_a_gpu_has_a_worker_for_each_prototype_of_a_mixture(backend, mixtures, monkeypatch):
    k, size = replace(get_backend(backend), workers=GPU_WORKERS), (9, 20)
    images, flows = prototypes("tearing", size)
    rng = np.random.default_rng(9)
    weights, scale = rng.dirichlet(np.ones(NUMBER), mixtures), some_of(size, rng)
    wanted = rng.normal(0, 1, (mixtures, *size, 2)).astype(np.float32)
    launch_all, counts = type(k).launch_all, {}

    def counted(self, kernel, count, inputs, outputs):
        counts[kernel] = count
        launch_all(self, kernel, count, inputs, outputs)

    monkeypatch.setattr(type(k), "launch_all", counted)
    made = mix(k, images, flows, wanted, weights, scale)
    assert counts["prototypes.mix_prototypes"] == NUMBER * mixtures
    desired = mixed("numpy", images, flows, wanted, weights, scale)
    assert_allclose(made, desired, rtol=0, atol=1e-4)
    assert_array_equal(mix(k, images, flows, wanted, weights, scale), made)


@pytest.mark.parametrize("kind", ["mirrored", "down", "up and down"])
def test_rows_arrive_in_any_order(backend, kind):
    """Rows are shown when no later one reaches them, be that late."""
    size = 40, 20
    y = np.arange(40, dtype=np.float32)
    down = {"mirrored": 38.7 - 2 * y, "down": 0 * y + 5.5, "up and down": 9.4 * (-1) ** y}[kind]
    images, flows = prototypes("zero", size)
    flow = np.stack([np.zeros(size), np.broadcast_to(down[:, None], size)], -1).astype(np.float32)
    given = images, flows, flow, [1, 2], np.ones(size, np.float32)
    assert_allclose(moved(backend, *given), moved("numpy", *given), rtol=0, atol=1e-4)


def test_the_reference_mixes_what_it_moves():
    images, flows = prototypes("random", (9, 12))
    weights, scale = np.float32([[0.2, 0.5, 0.3]]), some_of((9, 12), np.random.default_rng(7))
    apart = moved("numpy", images, flows, flows[2], range(NUMBER), scale)
    together = mixed("numpy", images, flows, flows[2:], weights, scale)
    assert_allclose(together[0], np.tensordot(weights[0], apart, axes=1), rtol=0, atol=1e-6)


def test_a_prototype_without_weight_is_not_looked_at(backend):
    images, flows = prototypes("random", (9, 12))
    other = images.copy()
    other[1] = 1 - other[1]
    weights, scale = [[0.4, 0, 0.6], [0.0, 0.0, 0.0]], np.ones((9, 12), np.float32)
    wanted = np.stack([flows[2], flows[1]])
    seen = mixed(backend, images, flows, wanted, weights, scale)
    assert_array_equal(mixed(backend, other, flows, wanted, weights, scale), seen)
    assert_array_equal(seen[1], 0)


@pytest.mark.parametrize("frames", [0, 2])
def test_nothing_asked_gives_nothing(backend, frames):
    images, flows = prototypes("random", (5, 4))
    wanted, weights, scale = flows[:frames], np.ones((frames, NUMBER)), np.zeros((5, 4), np.float32)
    seen = mixed(backend, images, flows, wanted, weights, scale)
    assert_array_equal(seen, np.zeros((frames, 5, 4, 3)))
    assert moved(backend, images, flows, flows[1], [], scale).shape == (0, 5, 4, 3)
    for name in (backend, "numpy"):
        assert equations(name, images, flows, flows[1], [], scale, images[0]).shape == (1, 0)


def test_any_number_of_threads_gives_the_same_bits(backend):
    images, flows = prototypes("tearing", (33, 64))
    wanted, scale = flows[::-1].copy(), np.ones((33, 64), np.float32)
    weights = np.random.default_rng(6).random((NUMBER, NUMBER))
    for run, given in (
        (mixed, (wanted, weights, scale)),
        (moved, (wanted[0], [0, 1, 2], scale)),
        (equations, (wanted[0], [0, 1, 2], scale, images[0])),
    ):
        one, *others = (run(backend, images, flows, *given, threads=n) for n in (1, 2, 5))
        for other in others:
            assert_array_equal(other, one)


def test_scratch_is_used_again(backend, monkeypatch):
    k, size = replace(get_backend(backend), workers=2), (9, 20)
    images, flows = prototypes("tearing", size)
    held = k.hold_prototypes(images, flows, HOLE)
    to, how = map(k.to_device, (planes(flows[1:2]), planes(np.ones((*size, 1), np.float32))[0]))
    first = k.to_host(k.move_prototypes(held, to, np.arange(NUMBER), how)).copy()
    empty, asked = type(k).empty, []

    def counted(self, *shape, dtype=np.float32):
        asked.append(shape)
        return empty(self, *shape, dtype=dtype)

    monkeypatch.setattr(type(k), "empty", counted)
    for number in (1, NUMBER):
        again = k.to_host(k.move_prototypes(held, to, np.arange(number), how))
        assert_array_equal(again, first[:number])
    assert asked == [(1, 3, 9, 32), (1,), (NUMBER, 3, 9, 32), (NUMBER,)]  # what is returned


def test_threads_that_share_prototypes_do_not_share_scratch(backend):
    """Warp's threads run side by side, OpenCL has one queue: only Warp could show the fault."""
    k, size = get_backend(backend), (160, 192)
    images, flows = prototypes("tearing", size)
    held = k.hold_prototypes(images, flows, HOLE)
    how = k.to_device(np.ones(size, np.float32))

    def move(step):
        to = k.to_device(planes(flows[1:2] * np.float32(0.1 * step)))
        return k.to_host(k.move_prototypes(held, to, np.arange(NUMBER), how)).copy()

    alone = list(map(move, range(12)))
    with ThreadPoolExecutor(4) as pool:
        for step, together in enumerate(pool.map(move, 3 * list(range(12)))):
            assert_array_equal(together, alone[step % 12])


def test_a_prototype_that_leaves_the_picture_is_an_error(backend):
    images, flows = prototypes("zero", (6, 6))
    gone, scale = np.full((6, 6, 2), 50, np.float32), np.ones((6, 6), np.float32)
    with pytest.raises(InputError, match="no pixel"):
        moved(backend, images, flows, gone, [0], scale)
    with pytest.raises(InputError, match="no pixel"):
        mixed(backend, images, flows, np.stack([flows[0], gone]), np.ones((2, NUMBER)), scale)
    with pytest.raises(InputError, match="no pixel"):
        equations(backend, images, flows, gone, [0], scale, images[0])


@pytest.mark.parametrize("size", [(1, 1), (30, 16), (BAND + 1, 70), (2 * BAND, 40)])
@pytest.mark.parametrize("own", KINDS)
def test_equations_without_pictures_are_those_of_moved_pictures(backend, own, size):
    images, flows = prototypes(own, size)
    rng = np.random.default_rng(9)
    flow, image = rng.uniform(-3, 3, (*size, 2)), rng.random((*size, 3), np.float32)
    given = images, flows, flow.astype(np.float32), [2, 0, 1, 2], some_of(size, rng), image
    try:
        desired = equations("numpy", *given)
    except InputError:
        with pytest.raises(InputError):
            equations(backend, *given)
        return
    assert_allclose(equations(backend, *given), desired, rtol=0, atol=1e-5 * desired.max())


@pytest.mark.parametrize("kind", ["constant", "random", "tearing"])
@pytest.mark.parametrize("run", [moved, equations])
def test_no_memory_is_read_before_it_is_written(backend, monkeypatch, run, kind):
    """It holds anything at first, such as NaN and numbers beyond every array."""
    images, flows = prototypes(kind, (2 * BAND, 40))
    scale = some_of((2 * BAND, 40), np.random.default_rng(10))
    given = images, flows, flows[1], range(NUMBER), scale
    given = (*given, images[0]) if run is equations else given
    k = get_backend(backend, None)  # that of `run`
    empty = type(k).empty

    def poisoned(self, *shape, dtype=np.float32):
        array = empty(self, *shape, dtype=dtype)
        most = np.nan if np.dtype(dtype) == np.float32 else 2**31 - 1
        if hasattr(array, "fill_"):
            array.fill_(most)
        elif array.size:
            value = np.full(1, most, dtype)
            cl.enqueue_fill_buffer(self.queue, array.data, value, 0, array.size * value.itemsize)
        return array

    monkeypatch.setattr(type(k), "empty", poisoned)
    k.scratch.give_up()
    desired = run("numpy", *given)
    assert_allclose(run(backend, *given), desired, rtol=0, atol=1e-5 * desired.max())


def test_equations_write_to_nothing_that_comes_from_the_host(backend, monkeypatch):
    """Drivers may trust that it is only read, and keep a copy of it."""
    images, flows = prototypes("random", (BAND, 40))
    k, scale = get_backend(backend, None), np.ones((BAND, 40), np.float32)
    to_device, launcher, brought, written = type(k).to_device, type(k).launcher, [], []

    def bringing(self, array):
        brought.append(to_device(self, array))
        return brought[-1]

    def launching(self, kernel, inputs, outputs):
        written.extend(outputs)
        return launcher(self, kernel, inputs, outputs)

    monkeypatch.setattr(type(k), "to_device", bringing)
    monkeypatch.setattr(type(k), "launcher", launching)
    equations(backend, images, flows, flows[1], range(NUMBER), scale, images[0])
    assert brought
    assert written
    assert not {id(a) for a in brought} & {id(a) for a in written}


def test_equations_that_are_interrupted_wait_for_what_is_launched(backend, monkeypatch):
    """It uses arrays that would be freed."""
    images, flows = prototypes("random", (BAND, 40))
    k, scale = get_backend(backend, None), np.ones((BAND, 40), np.float32)
    launch_on, wait, events = type(k).launch_on, type(k).wait, []

    def waiting(self):
        events.append("wait")
        wait(self)

    def interrupted(self, kernel, count, inputs, outputs):
        if kernel == "normal_equations.multiply":
            raise KeyboardInterrupt
        events.append(kernel)
        launch_on(self, kernel, count, inputs, outputs)

    monkeypatch.setattr(type(k), "launch_on", interrupted)
    monkeypatch.setattr(type(k), "wait", waiting)
    with pytest.raises(KeyboardInterrupt):
        equations(backend, images, flows, flows[1], range(NUMBER), scale, images[0])
    assert events[-1] == "wait"
    assert "prototype_equations.set_aside" in events


def runs_of(k, monkeypatch):
    """For each launch from now on, whether it begins equations of one band."""
    launch_on, begun = type(k).launch_on, []

    def counted(self, kernel, count, inputs, outputs):
        begun.append(kernel == "prototype_equations.advance")
        launch_on(self, kernel, count, inputs, outputs)

    monkeypatch.setattr(type(k), "launch_on", counted)
    return begun


def test_equations_seldom_begin_again_where_ever_more_pixels_are_set_aside(backend, monkeypatch):
    k, size = replace(get_backend(backend)), (BAND, 96)
    x = np.arange(96) + np.zeros(size)
    images, flows = prototypes("zero", size)
    held, scale = k.hold_prototypes(images, flows, HOLE), k.to_device(np.ones(size, np.float32))
    image, begun = k.to_device(planes(images[0])), runs_of(k, monkeypatch)
    frames = range(14, 40)
    for gap in frames:
        right = np.where(x < 48, -gap, gap)
        flow = np.stack([right, 0 * right], -1).astype(np.float32)
        k.prototype_equations(held, planes(flow), np.arange(NUMBER), image, scale)
    assert len(frames) < sum(begun) < len(frames) + 8


def test_divisions_may_be_as_coarse_as_opencl_allows(monkeypatch):
    """By 2.5 units in the last place, as on GPUs: that a cell is known must not depend on it."""
    images, flows = prototypes("random", (33, 40))
    given = images, flows, flows[1], range(NUMBER), np.ones((33, 40), np.float32)
    desired, included = moved("opencl", *given), opencl._included
    monkeypatch.setattr(
        opencl, "_included", lambda line: included(line).replace("1.0f / n", "0.9999998f / n")
    )
    for cached in (opencl._kernel, opencl._program):
        monkeypatch.setattr(opencl, cached.__name__, functools.cache(cached.__wrapped__))
    actual = moved("opencl", *given)
    assert_allclose(actual, desired, rtol=0, atol=1e-5)
    assert not np.array_equal(actual, desired)


def test_equations_keep_no_picture(backend, monkeypatch):
    """No array has room for the prototypes in all of their rows."""
    k, size = replace(get_backend(backend)), (5 * BAND, 20)
    images, flows = prototypes("tearing", size)
    held = k.hold_prototypes(images, flows, HOLE)
    image, how = map(k.to_device, (planes(images[0]), planes(np.ones((*size, 1), np.float32))[0]))
    empty, largest = type(k).empty, [0]

    def counted(self, *shape, dtype=np.float32):
        if dtype == np.float32:
            largest[0] = max(largest[0], math.prod(shape))
        return empty(self, *shape, dtype=dtype)

    monkeypatch.setattr(type(k), "empty", counted)
    k.prototype_equations(held, planes(0 * flows[1]), np.arange(NUMBER), image, how)
    assert 0 < largest[0] < NUMBER * 3 * size[0] * 32


@pytest.mark.parametrize("kind", ["mirrored", "torn"])
def test_equations_begin_again_with_more_room_which_is_kept(backend, monkeypatch, kind):
    """For rows of sums where rows arrive out of order, and for pixels that are set aside."""
    k, size = replace(get_backend(backend)), (BAND - 1, 40)
    x, y = np.meshgrid(*map(np.arange, size[::-1]))
    down = {"mirrored": 46.2 - 2 * y, "torn": np.zeros(size)}[kind]
    right = {"mirrored": np.zeros(size), "torn": np.where(x < 20, -19.5, 19.5)}[kind]
    images, flows = prototypes("zero", size)
    flow, used = np.stack([right, down], -1).astype(np.float32), np.arange(NUMBER)
    held, scale = k.hold_prototypes(images, flows, HOLE), np.ones(size, np.float32)
    image, how = map(k.to_device, (planes(images[0]), planes(scale[..., None])[0]))
    begun, found, runs = runs_of(k, monkeypatch), [], []
    for _ in range(2):
        found.append(k.to_host(k.prototype_equations(held, planes(flow), used, image, how)).copy())
        runs.append(sum(begun))
        begun.clear()
    assert runs == [2, 1]
    desired = equations("numpy", images, flows, flow, used, scale, images[0])
    assert_allclose(found[0], desired, rtol=0, atol=1e-5 * desired.max())
    assert_array_equal(found[1], found[0])
