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

FOUR = wp.constant(4)  # frames in one loop; a loop for any number would keep its sums in memory


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
def arriving(part: wp.vec3i, own: wp.array[float], x: int, y: int):
    """The flow of 16 sources of a part, read at `x` and `y`, and the share of it that arrives."""
    qx = get(own, x)
    qy = get(own, y)
    return qx, qy, given(wp.cw_mul(near(qx, part[0]), near(qy, part[1])), part[2])


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
    x_plane = LANES + 2 * m * area
    y_plane = x_plane + area
    for v in range(vectors):
        i = LANES * v
        begin = firsts[m * vectors + v]
        end = firsts[m * vectors + v + 1]
        total = get(shares, m * area + i)
        to = here + i
        if together == FOUR:
            x0 = vec16()
            y0 = vec16()
            x1 = vec16()
            y1 = vec16()
            x2 = vec16()
            y2 = vec16()
            x3 = vec16()
            y3 = vec16()
            for k in range(begin, end):
                part = neighbours[k]
                s = i + part[1] * pitch + part[0]
                qx, qy, share = arriving(part, own, x_plane + s, y_plane + s)
                at = there + s
                x0 += missing(field, at, share, qx)
                y0 += missing(field, at + area, share, qy)
                x1 += missing(field, at + frame, share, qx)
                y1 += missing(field, at + frame + area, share, qy)
                x2 += missing(field, at + 2 * frame, share, qx)
                y2 += missing(field, at + 2 * frame + area, share, qy)
                x3 += missing(field, at + 3 * frame, share, qx)
                y3 += missing(field, at + 3 * frame + area, share, qy)
            put(residual, to, wp.cw_mul(total, x0))
            put(residual, to + nodes, wp.cw_mul(total, y0))
            put(residual, to + 2 * nodes, wp.cw_mul(total, x1))
            put(residual, to + 3 * nodes, wp.cw_mul(total, y1))
            put(residual, to + 4 * nodes, wp.cw_mul(total, x2))
            put(residual, to + 5 * nodes, wp.cw_mul(total, y2))
            put(residual, to + 6 * nodes, wp.cw_mul(total, x3))
            put(residual, to + 7 * nodes, wp.cw_mul(total, y3))
        else:
            for f in range(together):
                x = vec16()
                y = vec16()
                for k in range(begin, end):
                    part = neighbours[k]
                    s = i + part[1] * pitch + part[0]
                    qx, qy, share = arriving(part, own, x_plane + s, y_plane + s)
                    at = there + f * frame + s
                    x += missing(field, at, share, qx)
                    y += missing(field, at + area, share, qy)
                put(residual, to + 2 * f * nodes, wp.cw_mul(total, x))
                put(residual, to + (2 * f + 1) * nodes, wp.cw_mul(total, y))
    for f in range(together):
        x_at = here + 2 * f * nodes
        y_at = x_at + nodes
        for row in range(rows[m], rows[m + 1]):
            across = float(0.0)
            along = float(0.0)
            for j in range(starts[row], starts[row + 1]):
                across += row_shares[j] * residual[x_at + row_taps[j]]
                along += row_shares[j] * residual[y_at + row_taps[j]]
            residual[x_at + targets[row]] = across
            residual[y_at + targets[row]] = along
