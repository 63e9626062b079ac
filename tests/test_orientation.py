import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_operations_equivalence import FLOWS, SIZES

from mmmgpu.backends.orientation import OWN_ROW, TAPS, orient
from mmmgpu.errors import InputError
from mmmgpu.operations import fill_holes, forward_warp

HOLE = 0.1
STAYING = sorted(set(FLOWS) - {"leaving"})


def applied(o, i, field):
    """L_i of a field (h w, C): the regular pixels, then the rows one after the other."""
    nodes = np.zeros((o.nodes, field.shape[1]))
    nodes[: len(field)] = field
    result = np.full(field.shape, np.nan)
    regular = o.taps[i, :, 0] != OWN_ROW
    for s in np.flatnonzero(regular):
        result[s] = o.shares[i, s].astype(float) @ nodes[o.taps[i, s]]
    for row in range(o.rows[i], o.rows[i + 1]):
        span = slice(o.starts[row], o.starts[row + 1])
        mean = o.row_shares[span].astype(float) @ nodes[o.row_taps[span]]
        target = o.targets[row]
        if target < len(field):
            assert not regular[target]
            result[target] = mean
        else:
            nodes[target] = mean
    return result


def make_flows(name, size):
    rng = np.random.default_rng(1)
    return np.stack([FLOWS[name](rng, *size) for _ in range(2)])


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", STAYING)
def test_it_is_the_filled_forward_warp(name, size):
    flows = make_flows(name, size)
    try:
        o = orient(flows, HOLE)
    except InputError:
        with pytest.raises(InputError):
            fill_holes(*forward_warp(flows, flows, backend="numpy"), threshold=HOLE)
        return
    field = np.random.default_rng(2).normal(0, 1, (2, *size, 2)).astype(np.float32)
    warped, weight = forward_warp(field, flows, backend="numpy")
    desired = fill_holes(warped, weight, threshold=HOLE, backend="numpy")
    for i in range(2):
        actual = applied(o, i, field[i].reshape(-1, 2))
        assert_allclose(actual, desired[i].reshape(-1, 2), rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", ["constant", "random", "tearing"])
def test_what_is_fixed_is_the_flow_carried_along_itself(name):
    flows = make_flows(name, (33, 20))
    o = orient(flows, HOLE)
    for i in range(2):
        carried = applied(o, i, flows[i].reshape(-1, 2))
        assert_allclose(o.fixed[i], carried, rtol=0, atol=1e-5)


def test_pixels_that_stay_need_no_rows():
    o = orient(np.zeros((1, 5, 7, 2), np.float32), HOLE)
    assert len(o.targets) == 0
    assert o.nodes == 35
    assert_array_equal(o.taps[0, :, 0], np.arange(35))
    assert o.taps.min() >= 0
    assert o.taps.max() < 35
    assert_array_equal(o.shares[0], np.eye(TAPS)[:1].repeat(35, axis=0))
    assert_array_equal(o.fixed, 0)


def test_shares_of_every_pixel_add_up_to_one():
    o = orient(make_flows("random", (33, 20)), HOLE)
    carried = applied(o, 1, np.ones((33 * 20, 1)))
    assert_allclose(carried, 1, rtol=0, atol=1e-6)


def test_a_flow_that_leaves_nothing_is_an_error():
    flows = np.zeros((2, 4, 4, 2), np.float32)
    flows[1] = 100
    with pytest.raises(InputError, match="no pixel"):
        orient(flows, HOLE)
