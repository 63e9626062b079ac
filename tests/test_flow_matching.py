"""Flow matching and its calibration against slow versions, and where the truth is known."""

from dataclasses import replace

import numpy as np
import oracles_matching as oracles
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from tiny_pair import COUNT, FRAMES, smooth_flows, tiny_pair

from mmmgpu import flow_matching
from mmmgpu.correspondence import rbf_correspondence
from mmmgpu.flow_matching import (
    KEPT,
    FlowScan,
    View,
    principal_mixtures,
    robust_map,
    synthetic_flows,
)

CHOSEN = np.array([3, 1, 6, 5, 0])


@pytest.fixture(scope="module")
def tiny():
    return tiny_pair()


def test_flow_distances_are_equation_7(tiny, backend):
    for name in ("numpy", backend):
        got = FlowScan(tiny.source, tiny.views, backend=name)()
        wanted = [
            [
                [oracles.flow_distance(tiny.source, view, k, n) for n in range(FRAMES)]
                for k in range(COUNT)
            ]
            for view in tiny.views
        ]
        assert_allclose(got, wanted, rtol=1e-5)


def test_synthetic_flows_are_on_the_new_person_s_pixels(tiny):
    shape = tiny.target.w_t.shape
    got = synthetic_flows(tiny.views, tiny.view, shape)
    assert got.dtype == np.float32
    for k in (1, 3):
        wanted = oracles.synthetic_flow(tiny.views[tiny.view[k]], k, shape)
        # OpenCV reads a flow at 1/32 px
        assert_allclose(got[k], wanted, atol=0.06)


def test_calibrated_distances_are_those_of_the_directions(tiny, backend, monkeypatch):
    monkeypatch.setattr(flow_matching, "DIRECTIONS", 4)
    for name in ("numpy", backend):
        scan = FlowScan(tiny.source, tiny.views, backend=name)
        got = scan(scan.calibrate(CHOSEN))
        wanted = [oracles.calibrated_distances(tiny.source, v, CHOSEN, 4) for v in tiny.views]
        assert_allclose(got, wanted, rtol=2e-4)


def test_calibrated_flows_are_known_on_all_pixels_of_the_new_person(tiny):
    shape = tiny.target.w_t.shape
    calibration = FlowScan(tiny.source, tiny.views).calibrate(CHOSEN)
    plain = synthetic_flows(tiny.views, tiny.view, shape)
    got = synthetic_flows(tiny.views, tiny.view, shape, calibration)
    for k, r in enumerate(tiny.view):
        wanted = KEPT * plain[k].astype(float)
        for share, flow in zip(calibration.mixture[r, k], tiny.views[r].flows_b, strict=True):
            wanted += share * flow
        assert_allclose(got[k], wanted, atol=1e-4)
    assert np.abs(got - plain).max() > 0.1


def test_a_person_who_moves_out_of_proportion_is_calibrated(tiny):
    """B raises what A raises by half as much again, and to the side goes half as far."""
    rng = np.random.default_rng(3)
    h, w = tiny.source.w_f.shape
    flows = smooth_flows(rng, 40, h, w, size=3.0)
    counterpart = rng.permutation(40)
    moved = np.empty_like(flows)
    moved[counterpart] = flows * np.float32([0.5, 1.5])
    marks = np.array([[2, 2], [19, 3], [4, 15], [18, 15.0]])
    view = View(rbf_correspondence(marks, marks), flows[:20], moved)
    scan = FlowScan(tiny.source, [view], backend="numpy")
    truth = counterpart[:20]
    (plain,), (exact,) = scan(), scan(scan.calibrate(truth))
    rows = np.arange(20)
    assert exact[rows, truth].mean() < 0.5 * plain[rows, truth].mean()
    wrong = truth.copy()
    wrong[[4, 9, 15]] = truth[[9, 15, 4]]
    assert_array_equal(scan(scan.calibrate(wrong))[0].argmin(axis=1), truth)


def test_directions_of_many_frames_are_found_from_some_of_them(tiny, monkeypatch):
    """Flows of four dimensions: those of 20 frames out of 60 span the same."""
    rng = np.random.default_rng(4)
    base = smooth_flows(rng, 5, *tiny.views[0].flows_b.shape[1:3])[1:]
    flows = np.tensordot(rng.standard_normal((60, 4)), base, axes=1).astype(np.float32)
    views = [replace(v, flows_b=flows) for v in tiny.views]
    chosen = rng.integers(60, size=COUNT)
    made = []
    for learned in (60, 20):
        monkeypatch.setattr(flow_matching, "LEARNED", learned)
        scan = FlowScan(tiny.source, views, backend="numpy")
        calibration = scan.calibrate(chosen)
        assert (np.abs(calibration.mixture).max(axis=(0, 1)) > 0).sum() == learned
        made.append(scan(calibration))
    assert_allclose(made[1], made[0], rtol=1e-3)
    assert np.abs(made[0] / scan() - 1).max() > 0.1


def test_a_mouth_that_never_moves_is_not_calibrated(tiny):
    still = [replace(v, flows_b=np.zeros_like(v.flows_b)) for v in tiny.views]
    scan = FlowScan(tiny.source, still, backend="numpy")
    assert_array_equal(scan(scan.calibrate(CHOSEN)), scan())


def test_a_model_that_never_moves_is_calibrated_to_one_flow(tiny):
    still = [replace(v, flows_a=np.zeros_like(v.flows_a)) for v in tiny.views]
    scan = FlowScan(tiny.source, still, backend="numpy")
    got = scan(scan.calibrate(CHOSEN))
    assert np.isfinite(got).all()
    assert_allclose(got, got[:, :1] + np.zeros_like(got), rtol=1e-6)


@pytest.mark.parametrize("number", [1, 3, 9])
def test_principal_mixtures_are_singular_vectors(number):
    flows = np.random.default_rng(0).standard_normal((7, 50)) * np.arange(1, 8)[:, None]
    a = principal_mixtures(flows @ flows.T, number)
    wanted = np.linalg.svd(flows, full_matrices=False)[2][:number]
    assert a.shape == (min(number, 7), 7)
    assert_allclose(np.abs(np.sum((a @ flows) * wanted, axis=1)), 1, atol=1e-9)


def test_there_are_no_more_directions_than_differ():
    flows = np.random.default_rng(0).standard_normal((2, 50))[[0, 1, 0, 1]]
    assert len(principal_mixtures(flows @ flows.T, 4)) == 2
    assert principal_mixtures(np.zeros((4, 4)), 4).shape == (0, 4)


def test_the_robust_map_against_least_squares_in_rounds():
    rng = np.random.default_rng(1)
    z, y = rng.standard_normal((2, 12, 3))
    got = robust_map(z, y)
    wanted = oracles.robust_map(z, y)
    assert_allclose(got[0], wanted[0], atol=1e-10)
    assert_allclose(got[1], wanted[1], atol=1e-10)


def test_the_robust_map_is_not_led_by_what_is_wrong():
    rng = np.random.default_rng(2)
    z = rng.standard_normal((40, 3))
    linear, offset = np.eye(3) + 0.3 * rng.standard_normal((3, 3)), rng.standard_normal(3)
    y = z @ linear.T + offset + 0.01 * rng.standard_normal((40, 3))
    y[:8] = y[8:16] + 5
    got = robust_map(z, y)
    assert_allclose(got[0], linear, atol=0.05)
    assert_allclose(got[1], offset, atol=0.05)
