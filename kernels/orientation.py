"""The residual flow of a prototype, carried to its pixels: W_F(C_syn - C_i, C_i) of CE05, Eq. 2.

It is a mean over neighbours that are always the same (see mmmgpu/backends/orientation.py), made for
vectors of 16 pixels of a row. Shares follow from C_i: kept ones would take more time to read.
"""

import warp as wp

from mmmgpu.kernels.lanes import (
    LANES,
    get,
    put,
    vec16,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def near(off: vec16, distance: int):
    """How much of what arrives `distance` and `off` pixels away a pixel gets."""
    v = vec16()
    for j in range(LANES):
        v[j] = 1.0 - wp.abs(off[j] + float(distance))
    return v


@wp.func
def given(share: vec16, lanes: int):
    """The shares of the pixels that have a source there, else 0."""
    v = vec16()
    for j in range(LANES):
        v[j] = wp.where((lanes & (1 << j)) != 0, share[j], 0.0)
    return v


@wp.func
def orient(
    m: int,
    own: wp.array[float],
    shares: wp.array[float],
    firsts: wp.array[int],
    neighbours: wp.array[wp.vec3i],
    rows: wp.array[int],
    targets: wp.array[int],
    starts: wp.array[int],
    row_taps: wp.array[int],
    row_shares: wp.array[float],
    area: int,
    pitch: int,
    nodes: int,
    together: int,
    field: wp.array[float],
    there: int,
    residual: wp.array[float],
    here: int,
):
    """The flow that is missing to prototype `m`, for each of its pixels, in one frame or two."""
    vectors = area / LANES
    next = there + 2 * (area + LANES)
    for v in range(vectors):
        i = LANES * v
        x = vec16()
        y = vec16()
        next_x = vec16()
        next_y = vec16()
        for k in range(firsts[m * vectors + v], firsts[m * vectors + v + 1]):
            part = neighbours[k]
            s = i + part[1] * pitch + part[0]
            qx = get(own, LANES + 2 * m * area + s)
            qy = get(own, LANES + (2 * m + 1) * area + s)
            share = given(wp.cw_mul(near(qx, part[0]), near(qy, part[1])), part[2])
            x += wp.cw_mul(share, get(field, there + s) - qx)
            y += wp.cw_mul(share, get(field, there + area + s) - qy)
            if together > 1:
                next_x += wp.cw_mul(share, get(field, next + s) - qx)
                next_y += wp.cw_mul(share, get(field, next + area + s) - qy)
        share = get(shares, m * area + i)
        put(residual, here + i, wp.cw_mul(share, x))
        put(residual, here + nodes + i, wp.cw_mul(share, y))
        if together > 1:
            put(residual, here + 2 * nodes + i, wp.cw_mul(share, next_x))
            put(residual, here + 3 * nodes + i, wp.cw_mul(share, next_y))
    for plane in range(2 * together):
        at = here + plane * nodes
        for row in range(rows[m], rows[m + 1]):
            sum = float(0.0)
            for j in range(starts[row], starts[row + 1]):
                sum += row_shares[j] * residual[at + row_taps[j]]
            residual[at + targets[row]] = sum
