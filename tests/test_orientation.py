import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_operations_equivalence import FLOWS, SIZES

from mmmgpu.backends.orientation import orient
from mmmgpu.backends.planes import LANES, picture, pitch_of
from mmmgpu.errors import InputError
from mmmgpu.operations import fill_holes, forward_warp

HOLE = 0.1
STAYING = sorted(set(FLOWS) - {"leaving"})


def applied(o, i, field):
    """L_i of a picture (h, w, C): the parts of each vector, then the rows one after the other."""
    h, w, channels = field.shape
    pitch = pitch_of(w)
    area = h * pitch
    nodes = np.zeros((LANES + o.nodes, channels))
    pixels, cells = nodes[LANES : LANES + area], nodes[LANES:]
    pixels.reshape(h, pitch, channels)[:, :w] = field
    result = np.zeros((area, channels))
    vectors = area // LANES
    for v in range(vectors):
        for k in range(o.firsts[i * vectors + v], o.firsts[i * vectors + v + 1]):
            at = LANES + LANES * v + o.deltas[k]
            result[LANES * v : LANES * (v + 1)] += (
                o.shares[k].astype(float)[:, None] * nodes[at : at + LANES]
            )
    for row in range(o.rows[i], o.rows[i + 1]):
        span = slice(o.starts[row], o.starts[row + 1])
        mean = o.row_shares[span].astype(float) @ cells[o.row_taps[span]]
        target = o.targets[row]
        if target < area:
            assert not result[target].any()
            result[target] = mean
        else:
            cells[target] = mean
    return result.reshape(h, pitch, channels)[:, :w]


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
        assert_allclose(applied(o, i, field[i]), desired[i], rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", ["constant", "random", "tearing"])
def test_what_is_fixed_is_the_flow_carried_along_itself(name):
    flows = make_flows(name, (33, 20))
    o = orient(flows, HOLE)
    for i in range(2):
        fixed = picture(o.fixed[i], 20)
        assert_allclose(fixed, applied(o, i, flows[i]), rtol=0, atol=1e-5)


def test_pixels_that_stay_need_no_rows():
    o = orient(np.zeros((1, 5, 20, 2), np.float32), HOLE)
    assert len(o.targets) == 0
    assert_array_equal(o.firsts, np.arange(5 * 2 + 1))
    assert_array_equal(o.deltas, 0)
    assert_array_equal(o.shares, np.tile(np.float32(np.arange(32) < 20), 5).reshape(10, LANES))
    assert_array_equal(o.fixed[..., :20], 0)


def test_what_pads_a_row_is_carried_out_of_any_picture():
    o = orient(np.zeros((1, 5, 20, 2), np.float32), HOLE)
    assert o.fixed[..., 20:].min() > 1e8


def test_shares_of_every_pixel_add_up_to_one():
    o = orient(make_flows("random", (33, 20)), HOLE)
    carried = applied(o, 1, np.ones((33, 20, 1)))
    assert_allclose(carried, 1, rtol=0, atol=1e-6)


def test_a_flow_that_leaves_nothing_is_an_error():
    flows = np.zeros((2, 4, 4, 2), np.float32)
    flows[1] = 100
    with pytest.raises(InputError, match="no pixel"):
        orient(flows, HOLE)
