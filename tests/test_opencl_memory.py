"""A device with memory of its own, as a GPU has: here the CPU, made to copy all that it gets."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from test_backends_faults import MANY
from test_operations import CALLS, call

from mmmgpu import operations, synthesis
from mmmgpu.analysis import analyze, prepare_analysis
from mmmgpu.backends import get_backend
from mmmgpu.backends.opencl_memory import OwnMemory
from mmmgpu.bench.timing import as_tuple
from mmmgpu.synthesis import prepare_synthesis, synthesize_batch

WORKERS = 64  # accumulators: many, as on a GPU


@pytest.fixture
def shared():
    return get_backend("opencl")


@pytest.fixture
def own(shared):
    return replace(shared, workers=WORKERS, memory=OwnMemory(shared.queue))


def coordinates(frames):
    rng = np.random.default_rng(0)
    return rng.normal(0, 0.4, (frames, 4)), rng.dirichlet(np.ones(5), frames)


@pytest.mark.parametrize("name", CALLS)
def test_operations_give_the_same_bits(monkeypatch, own, name):
    desired = call(name, "opencl", **MANY[name])
    monkeypatch.setattr(operations, "get_backend", lambda _: own)
    actual = call(name, "opencl", **MANY[name])
    assert own.memory.allocated > 0  # it was used
    for a, d in zip(as_tuple(actual), as_tuple(desired), strict=True):
        assert_array_equal(a, d)


def test_synthesis_gives_the_same_bits(monkeypatch, own, basis):
    desired = synthesize_batch(prepare_synthesis(basis, backend="opencl"), *coordinates(9))
    monkeypatch.setattr(synthesis, "get_backend", lambda _: own)
    made = synthesize_batch(prepare_synthesis(basis, backend="opencl"), *coordinates(9))
    assert_array_equal(made, desired)


def test_analysis_gives_the_same_bits(own, shared, basis):
    found = [analyze(prepare_analysis(basis, k), basis.images[1]) for k in (own, shared)]
    for actual, desired in zip(*found, strict=True):
        assert_array_equal(actual, desired)


def test_nothing_is_allocated_for_further_frames(monkeypatch, own, basis):
    monkeypatch.setattr(synthesis, "get_backend", lambda _: own)
    synthesizer, analyzer = prepare_synthesis(basis, backend="opencl"), prepare_analysis(basis, own)

    def frames():
        synthesize_batch(synthesizer, *coordinates(4))
        for image in basis.images[:2]:
            analyze(analyzer, image)
        return own.memory.allocated

    frames()  # scratch that is kept from here on may be what synthesis gave back
    first = frames()
    assert [frames() for _ in range(3)] == 3 * [first]


def test_what_was_fetched_stays_when_its_memory_is_used_again(own):
    fetched = own.to_host(own.to_device(np.full((3, 50), 7, np.float32)))
    for _ in range(5):
        own.to_device(np.zeros((3, 50), np.float32))
    assert_array_equal(fetched, np.full((3, 50), 7))
    empty = own.to_device(np.ones((0, 3), np.float32))
    assert own.to_host(empty).shape == (0, 3)
