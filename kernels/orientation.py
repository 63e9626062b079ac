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
def missing(field: wp.array[float], at: int, share: vec16, q: vec16):
    """A share of the flow that is missing at a pixel, in one direction and frame."""
    return wp.cw_mul(share, get(field, at) - q)


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
    """The flow that is missing to prototype `m`, for each of its pixels, in 1, 2 or 4 frames."""
    vectors = area / LANES
    frame = 2 * (area + LANES)
    for v in range(vectors):
        i = LANES * v
        x0 = vec16()
        y0 = vec16()
        x1 = vec16()
        y1 = vec16()
        x2 = vec16()
        y2 = vec16()
        x3 = vec16()
        y3 = vec16()
        for k in range(firsts[m * vectors + v], firsts[m * vectors + v + 1]):
            part = neighbours[k]
            s = i + part[1] * pitch + part[0]
            qx = get(own, LANES + 2 * m * area + s)
            qy = get(own, LANES + (2 * m + 1) * area + s)
            share = given(wp.cw_mul(near(qx, part[0]), near(qy, part[1])), part[2])
            at = there + s
            x0 += missing(field, at, share, qx)
            y0 += missing(field, at + area, share, qy)
            if together > 1:
                at += frame
                x1 += missing(field, at, share, qx)
                y1 += missing(field, at + area, share, qy)
            if together > 2:
                at += frame
                x2 += missing(field, at, share, qx)
                y2 += missing(field, at + area, share, qy)
                at += frame
                x3 += missing(field, at, share, qx)
                y3 += missing(field, at + area, share, qy)
        share = get(shares, m * area + i)
        to = here + i
        put(residual, to, wp.cw_mul(share, x0))
        put(residual, to + nodes, wp.cw_mul(share, y0))
        if together > 1:
            put(residual, to + 2 * nodes, wp.cw_mul(share, x1))
            put(residual, to + 3 * nodes, wp.cw_mul(share, y1))
        if together > 2:
            put(residual, to + 4 * nodes, wp.cw_mul(share, x2))
            put(residual, to + 5 * nodes, wp.cw_mul(share, y2))
            put(residual, to + 6 * nodes, wp.cw_mul(share, x3))
            put(residual, to + 7 * nodes, wp.cw_mul(share, y3))
    for plane in range(2 * together):
        at = here + plane * nodes
        for row in range(rows[m], rows[m + 1]):
            sum = float(0.0)
            for j in range(starts[row], starts[row + 1]):
                sum += row_shares[j] * residual[at + row_taps[j]]
            residual[at + targets[row]] = sum
