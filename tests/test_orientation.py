import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_operations_equivalence import FLOWS, SIZES

from mmmgpu.backends.orientation import orient
from mmmgpu.backends.planes import LANES, pitch_of
from mmmgpu.errors import InputError
from mmmgpu.operations import fill_holes, forward_warp

HOLE = 0.1
STAYING = sorted(set(FLOWS) - {"leaving"})


def applied(o, i, field):
    """L_i of a picture (h, w, C): the parts of each vector, then the rows one after the other."""
    h, w, channels = field.shape
    pitch = pitch_of(w)
    area = h * pitch
    nodes = np.zeros((o.nodes, channels))
    for y, x in np.ndindex(h, w):
        vector, lane = divmod(y * pitch + x, LANES)
        first = i * area // LANES + vector
        for right, down, lanes in o.parts[o.firsts[first] : o.firsts[first + 1]]:
            if lanes >> lane & 1:
                off = o.flows[i, :, y + down, x + right] + (right, down)
                assert np.abs(off).max() <= 1
                nodes[y * pitch + x] += (1 - np.abs(off)).prod() * field[y + down, x + right]
        nodes[y * pitch + x] *= o.shares[i, y, x]
    for row in range(o.rows[i], o.rows[i + 1]):
        span = slice(o.starts[row], o.starts[row + 1])
        assert not nodes[o.targets[row]].any()
        nodes[o.targets[row]] = o.row_shares[span].astype(float) @ nodes[o.row_taps[span]]
    return nodes[:area].reshape(h, pitch, channels)[:, :w]


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


def test_pixels_that_stay_have_one_part_and_no_rows():
    o = orient(np.zeros((1, 5, 20, 2), np.float32), HOLE)
    assert len(o.targets) == 0
    assert_array_equal(o.firsts, np.arange(5 * 2 + 1))
    assert_array_equal(o.parts, np.tile([[0, 0, 0xFFFF], [0, 0, 0xF]], (5, 1)))
    assert_array_equal(o.shares[..., :20], 1)


def test_parts_that_reach_over_the_sides_have_no_sources_there():
    """A row's neighbour in memory is the next row's first pixel: it is none in the picture."""
    flows = np.zeros((1, 3, 16, 2), np.float32)
    flows[..., 0] = -0.5
    o = orient(flows, HOLE)
    last = o.parts[o.firsts[0] : o.firsts[1]]
    assert_array_equal(last, [[0, 0, 0xFFFF], [1, 0, 0x7FFF]])


def test_shares_of_every_pixel_add_up_to_one():
    o = orient(make_flows("random", (33, 20)), HOLE)
    carried = applied(o, 1, np.ones((33, 20, 1)))
    assert_allclose(carried, 1, rtol=0, atol=1e-6)


def test_a_flow_that_leaves_nothing_is_an_error():
    flows = np.zeros((2, 4, 4, 2), np.float32)
    flows[1] = 100
    with pytest.raises(InputError, match="no pixel"):
        orient(flows, HOLE)
