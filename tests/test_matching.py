"""Matching by synthesis against slow versions, small worlds made to measure, and known truth."""

import weakref
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import oracles_matching as oracles
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from performer_pairs import found, make_pair, target_of, views_of
from tiny_pair import COUNT, FRAMES, tiny_pair

from mmmgpu import flow_matching, matching
from mmmgpu.analysis import TEXTURE_RIDGE, solve_simplex
from mmmgpu.backends import get_backend
from mmmgpu.errors import DeviceMemoryError
from mmmgpu.flow_matching import synthetic_flows
from mmmgpu.matching import match_prototypes, texture_coordinates


@pytest.fixture(scope="module")
def tiny():
    return tiny_pair()


def test_texture_coordinates_are_equation_8(tiny, backend):
    for name in ("numpy", backend):
        got = texture_coordinates(tiny.source, tiny.views, tiny.view, backend=name)
        for k, r in enumerate(tiny.view):
            wanted = oracles.texture_coordinates(tiny.source, tiny.views[r], k)
            assert_allclose(got[:, k], wanted, atol=2e-4)


def scan_of(tiny, beta, backend):
    flows = synthetic_flows(tiny.views, tiny.view, tiny.target.w_t.shape)
    return matching._TextureScan(tiny.target, tiny.views, tiny.view, flows, beta, backend)


def test_the_texture_scan_is_equations_9_and_10(tiny, backend):
    beta = np.random.default_rng(1).dirichlet(np.ones(COUNT), COUNT).T
    candidates = np.array([3, 1, 6, 6, 0])
    flows = synthetic_flows(tiny.views, tiny.view, tiny.target.w_t.shape)
    wanted = [
        [
            oracles.texture_distance(
                tiny.target, tiny.views[r], beta[:, k], candidates, flows[k], n
            )
            for n in range(FRAMES)
        ]
        for k, r in enumerate(tiny.view)
    ]
    for name in ("numpy", backend):
        scan = scan_of(tiny, beta, name)
        for before in ([5] * 5, [3, 2, 2, 2, 4], [3, 1, 2, 6, 0]):
            scan(np.array(before))  # what was made before is not taken for what is new
            assert_allclose(scan(candidates), wanted, rtol=1e-4)


@pytest.mark.parametrize(("operation", "batch"), [("distance_scan", 0), ("mix_prototypes", 1)])
def test_scans_of_what_does_not_fit_are_made_in_parts(tiny, backend, monkeypatch, operation, batch):
    beta = np.random.default_rng(1).dirichlet(np.ones(COUNT), COUNT).T
    scans = (
        partial(scan_of(tiny, beta, backend), np.array([3, 1, 6, 6, 0])),
        flow_matching.FlowScan(tiny.source, tiny.views, backend=backend),
    )
    whole = [scan() for scan in scans]
    runtime, refused = type(get_backend(backend)), []
    real = getattr(runtime, operation)

    def one_at_a_time(self, *given):
        if given[batch].shape[0] > 1:
            refused.append(given[batch].shape)
            raise DeviceMemoryError("not enough memory")
        return real(self, *given)

    monkeypatch.setattr(runtime, operation, one_at_a_time)
    for scan, desired in zip(scans, whole, strict=True):
        assert_array_equal(scan(), desired)
    assert refused


@pytest.fixture
def device(backend, monkeypatch):
    """A device that holds at most `most` prototypes in all; `refused` counts what it did not."""
    found = SimpleNamespace(most=99, refused=0, held=[])
    runtime = type(get_backend(backend))
    real = runtime.hold_prototypes

    def hold(self, images, flows, hole):
        if len(images) + sum(n for n, one in found.held if one() is not None) > found.most:
            found.refused += 1
            raise DeviceMemoryError("not enough memory")
        held = real(self, images, flows, hole)
        found.held.append((len(images), weakref.ref(held)))
        return held

    monkeypatch.setattr(runtime, "hold_prototypes", hold)
    return found


def test_candidates_that_do_not_fit_together_are_held_one_after_the_other(tiny, backend, device):
    beta = np.random.default_rng(1).dirichlet(np.ones(COUNT), COUNT).T
    candidates = [np.array(c) for c in ([5] * 5, [3, 2, 2, 2, 4], [3, 1, 2, 6, 0])]
    scan = scan_of(tiny, beta, backend)
    wanted = [scan(c) for c in candidates]
    del scan
    for most in (4, 1):
        device.most, device.refused = most, 0
        scan = scan_of(tiny, beta, backend)
        for c, desired in zip(candidates, wanted, strict=True):
            assert_allclose(scan(c), desired, rtol=1e-5)
        assert device.refused
    device.most = 0
    with pytest.raises(DeviceMemoryError, match="not enough memory"):
        scan(candidates[0])


def test_texture_coordinates_hold_the_prototypes_once_at_a_time(tiny, backend, device):
    wanted = texture_coordinates(tiny.source, tiny.views, tiny.view, backend=backend)
    device.most = COUNT
    again = texture_coordinates(tiny.source, tiny.views, tiny.view, backend=backend)
    assert_array_equal(again, wanted)


@pytest.mark.parametrize("equal", [False, True])
def test_the_programme_of_equation_8_is_solved(tiny, equal):
    """Against every set of positive coordinates, and Karush-Kuhn-Tucker; two may be equal."""
    images = tiny.source.images.copy()
    flows = tiny.views[0].flows_a.copy()
    if equal:
        images[3], flows[3] = images[1], flows[1]
    source, view = replace(tiny.source, images=images), replace(tiny.views[0], flows_a=flows)
    for k in range(COUNT):
        gram, right = oracles.texture_system(source, view, k)
        singular = equal and k not in (1, 3)
        assert (np.linalg.cond(gram) > 1e12) == singular
        beta = solve_simplex(gram, right)
        ridge = TEXTURE_RIDGE * np.trace(gram) / len(gram)
        gram = gram + ridge * np.eye(len(gram))
        scale = np.abs(right).max()
        wanted = oracles.oracles_model.solve_simplex(gram, right)
        assert_allclose(beta, wanted, atol=1e-6)
        slope = (gram @ beta - right) / scale
        price = beta @ slope  # the multiplier of sum b = 1
        assert beta.min() >= 0
        assert_allclose(beta.sum(), 1, atol=1e-12)
        assert (slope >= price - 1e-6).all()
        assert_allclose(slope[beta > 1e-6], price, atol=1e-6)


def test_two_equal_prototypes_are_each_other(tiny):
    images, flows = tiny.source.images.copy(), tiny.views[0].flows_a.copy()
    images[3], flows[3] = images[1], flows[1]
    source, views = replace(tiny.source, images=images), [replace(tiny.views[0], flows_a=flows)]
    beta = texture_coordinates(source, views, np.zeros(COUNT, int), backend="numpy")
    assert beta[3, 1] > 0.99
    assert beta[1, 3] > 0.99
    others = beta[:, [0, 2, 4]]
    assert_allclose(others[1], others[3], atol=1e-3)  # they share what either would have
    assert_array_equal(np.diag(beta), 0)
    assert_allclose(beta.sum(axis=0), 1, atol=1e-12)


UNSEEN = SimpleNamespace(w_t=np.zeros((1, 1)), flows_b=None)


class FlowScan:
    """In place of the flow scan: distances (V, M, N) that no calibration changes."""

    def __init__(self, distances):
        self.distances = distances

    def calibrate(self, _):
        return None

    def __call__(self, _=None):
        return self.distances


class Scan:
    """In place of the texture scan: distances (M, N) by what the candidates are."""

    def __init__(self, distances):
        self.distances, self.asked = distances, []

    def __call__(self, candidates):
        self.asked.append(candidates.tolist())
        return self.distances(candidates)


def match_stubbed(monkeypatch, flow, distances, **options):
    """`match_prototypes` with given flow distances, (M, N) or (V, M, N), and texture distances."""
    scan, flow = Scan(distances), np.array(flow, float, ndmin=3)
    source = SimpleNamespace(images=flow[0])
    monkeypatch.setattr(matching, "FlowScan", lambda *_, **__: FlowScan(flow))
    monkeypatch.setattr(matching, "synthetic_flows", lambda *_: None)
    monkeypatch.setattr(matching, "texture_coordinates", lambda *_, **__: np.eye(flow.shape[1]))
    monkeypatch.setattr(matching, "_TextureScan", lambda *_: scan)
    return match_prototypes(source, UNSEEN, [UNSEEN] * len(flow), **options), scan


def wandering(seed, count=4, frames=6):
    """Texture distances that depend on all candidates, at random, but always in the same way."""

    def distances(candidates):
        rng = np.random.default_rng([seed, *candidates.tolist()])
        return rng.uniform(1, 2, (count, frames))

    return distances


@pytest.mark.parametrize("balance", [0.0, 0.3, 0.5, 1.0])
@pytest.mark.parametrize("seed", range(6))
def test_the_iteration_is_that_of_the_paper(monkeypatch, balance, seed):
    flow = np.random.default_rng(seed).uniform(1, 3, (4, 6))
    got, _ = match_stubbed(monkeypatch, flow, wandering(seed), balance=balance, iterations=9)
    history, costs = oracles.iterate(flow, wandering(seed), balance, 9)
    assert_array_equal(got.history, history)
    repeated = history[-1] in history[:-1]
    first = history.index(history[-1]) if repeated else len(history)
    kind = "limit" if not repeated else "fixed point" if first == len(history) - 2 else "cycle"
    assert got.outcome == kind
    inside = range(first, len(costs)) if kind == "cycle" else [len(costs) - 1]
    best = min(inside, key=lambda i: costs[i])
    assert_array_equal(got.chosen, history[best + 1])


def test_flow_alone_and_texture_alone(monkeypatch):
    flow = [[1.0, 2, 3], [3, 1, 2]]
    texture_ = np.array([[3.0, 1, 2], [2, 3, 1]])
    alone, _ = match_stubbed(monkeypatch, flow, lambda _: texture_, balance=1.0)
    assert alone.chosen.tolist() == [0, 1]
    assert alone.outcome == "fixed point"
    alone, _ = match_stubbed(monkeypatch, flow, lambda _: texture_, balance=0.0)
    assert alone.chosen.tolist() == [1, 2]
    assert alone.history.tolist() == [[0, 1], [1, 2], [1, 2]]


def test_prototype_and_frame_are_compared_in_the_view_that_brings_them_nearer(monkeypatch):
    flow = [[[1.0, 2, 3], [3, 3, 2]], [[3, 0.5, 3], [1, 3, 3]]]
    got, _ = match_stubbed(monkeypatch, flow, lambda _: np.ones((2, 3)), balance=1.0)
    assert got.chosen.tolist() == [1, 0]
    assert got.view.tolist() == [1, 1]
    assert_allclose(got.flow_distance[-1], [0.5 / 1.5, 1 / 1.5])  # the median of the nearer is 1.5
    got, _ = match_stubbed(monkeypatch, flow[::-1], lambda _: np.ones((2, 3)), fixed=[(0, 2)])
    assert got.view.tolist() == [0, 0]


def test_what_is_known_is_not_chosen(monkeypatch):
    flow = [[1.0, 2, 3], [3, 1, 2]]
    got, scan = match_stubbed(monkeypatch, flow, lambda _: np.array(flow), fixed=[(1, 0)])
    assert got.chosen.tolist() == [0, 0]
    assert all(candidates[1] == 0 for candidates in scan.asked)
    assert got.flow_distance[-1].tolist() == [0.5, 1.5]  # over the median, 2


def test_two_prototypes_may_choose_one_frame(monkeypatch):
    flow = [[1.0, 2, 3], [1, 2, 3]]
    got, _ = match_stubbed(monkeypatch, flow, lambda _: np.array(flow))
    assert got.chosen.tolist() == [0, 0]


@pytest.mark.parametrize("cheap", [1, 2, 3])
def test_of_a_cycle_the_least_total_cost_is_taken(monkeypatch, cheap):
    """0 -> 1 -> 2 -> 3 -> 1: choosing `cheap` costs less than the others of the cycle.

    The way into the cycle costs least, but is no part of it.
    """
    after = {0: 1, 1: 2, 2: 3, 3: 1}

    def distances(candidates):
        new = after[int(candidates[0])]
        row = np.full((1, 4), 8.0)
        row[0, new] = 1.0 if new == cheap else 2.0
        return row if candidates[0] else row / 8

    got, _ = match_stubbed(monkeypatch, [[1.0, 1.1, 1.1, 1.1]], distances)
    assert got.history.ravel().tolist() == [0, 1, 2, 3, 1]
    assert got.outcome == "cycle"
    assert got.chosen.tolist() == [cheap]


def test_the_unit_of_the_texture_stays_that_of_the_first_iteration(monkeypatch):
    calls = []

    def distances(_):
        calls.append(1)
        return np.array([[4.0, 2, 1]]) * (1 if len(calls) == 1 else 100)

    got, _ = match_stubbed(monkeypatch, [[1.0, 2, 9]], distances)
    assert got.history.ravel().tolist() == [0, 1, 2, 2]
    assert got.texture_distance.ravel().tolist() == [2, 1, 50, 50]


def test_the_limit_is_kept(monkeypatch):
    got, scan = match_stubbed(monkeypatch, np.ones((4, 6)), wandering(3), balance=0.0, iterations=2)
    assert got.outcome == "limit"
    assert len(scan.asked) == 2
    assert_array_equal(got.chosen, got.history[2])
    assert got.flow_distance.shape == got.texture_distance.shape == (3, 4)


def test_the_same_bits_twice_and_on_any_number_of_threads(tiny, backend, monkeypatch):
    def bits():
        got = match_prototypes(tiny.source, tiny.target, tiny.views, backend=backend)
        parts = (
            got.chosen,
            got.flow_history,
            got.history,
            got.flow_distance,
            got.texture_distance,
            got.texture,
        )
        return [part.tobytes() for part in parts]

    first = bits()
    assert bits() == first
    for threads in (1, 5):
        monkeypatch.setattr(matching, "get_backend", lambda name, n=threads: get_backend(name, n))
        assert bits() == first


def test_every_backend_matches_alike(tiny, backend):
    wanted, got = (
        match_prototypes(tiny.source, tiny.target, tiny.views, backend=name)
        for name in ("numpy", backend)
    )
    assert_array_equal(got.flow_history, wanted.flow_history)
    assert_array_equal(got.history, wanted.history)
    assert_allclose(got.flow_distance, wanted.flow_distance, rtol=1e-4)
    assert_allclose(got.texture_distance, wanted.texture_distance, rtol=1e-4)


def test_most_counterparts_of_drawn_prototypes_are_found():
    """One pair of performers with known truth; what all seeds reach is in docs/measurements.md."""
    pair = make_pair(0)
    views = views_of(pair)
    fixed = [(0, int(pair.counterpart[0]))]
    matching = match_prototypes(pair.source, target_of(pair), views, fixed=fixed)
    by_flow, at_the_end = (
        found(pair, chosen).mean() for chosen in (matching.history[0], matching.chosen)
    )
    before = found(pair, matching.flow_history[0]).mean()
    assert by_flow > max(0.9, before + 0.05)
    assert at_the_end > 0.95
    assert matching.outcome == "fixed point"
    assert len(matching.history) <= 10
