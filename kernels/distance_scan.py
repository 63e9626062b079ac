"""Weighted Euclidean distances between two sets of fields (CE05, Eq. 7 and 10).

`pack` lays the channels of each field out as planes padded to whole vectors; `distance_scan` walks
them 16 points at a time, in float32 within a block and in float64 from block to block. Two queries
and two rows of the corpus share their loads; a thread does four rows, as in OpenCL.
"""

import warp as wp

from mmmgpu.kernels.lanes import LANES, get, vec16

wp.set_module_options({"enable_backward": False})

BLOCK = wp.constant(16 * LANES)  # points summed in float32
QUERIES, ROWS = wp.constant(2), wp.constant(4)  # of a thread, two rows at a time
vec32 = wp.types.vector(length=2 * LANES, dtype=wp.float32)


@wp.kernel
def pack(
    fields: wp.array[float],  # (N, P, C)
    points: int,  # P
    channels: int,
    begin: int,  # the points before it are packed already
    first: int,
    count: int,
    # outputs
    planes: wp.array[float],  # (count, C, V, 16), zero beyond P; V = ceil(P / 16)
):
    tid = wp.tid()
    if tid >= count:
        return
    padded = (points + LANES - 1) / LANES * LANES
    source = (first + tid) * points * channels
    for c in range(channels):
        target = (tid * channels + c) * padded
        for p in range(begin, points):
            planes[target + p] = fields[source + p * channels + c]
        for p in range(points, padded):
            planes[target + p] = 0.0


@wp.kernel
def pack_flows(
    flows: wp.array2d[vec32],  # (N, P, 2) as rows of P // 16 whole vectors
    points: int,  # P
    first: int,
    count: int,
    # outputs
    planes: wp.array[vec16],  # (count, 2, V), whole vectors of points are written
):
    tid = wp.tid()
    if tid >= count:
        return
    vectors = (points + LANES - 1) / LANES
    target = 2 * tid * vectors
    for v in range(points / LANES):
        flow = flows[first + tid, v]
        x = vec16()
        y = vec16()
        for lane in range(LANES):
            x[lane] = flow[2 * lane]
            y[lane] = flow[2 * lane + 1]
        planes[target + v] = x
        planes[target + vectors + v] = y


@wp.func
def squared(queries: wp.array[float], q: int, planes: wp.array[float], f: int):
    """Squared differences of 16 points in one channel."""
    d = get(queries, q) - get(planes, f)
    return wp.cw_mul(d, d)


@wp.func
def lengths(
    queries: wp.array[float],
    q: int,
    planes: wp.array[float],
    f: int,
    plane: int,
    channels: int,
):
    """Distances of 16 points. Pairs share their loads where flows and colours need no loop."""
    norm = squared(queries, q, planes, f)
    if channels > 1:
        norm += squared(queries, q + plane, planes, f + plane)
    if channels > 2:
        norm += squared(queries, q + 2 * plane, planes, f + 2 * plane)
    for c in range(3, channels):
        norm += squared(queries, q + c * plane, planes, f + c * plane)
    for lane in range(LANES):
        norm[lane] = wp.sqrt(norm[lane])
    return norm


@wp.func
def sum_of(part: vec16):
    four = wp.vec4()
    for j in range(4):
        four[j] = (part[j] + part[j + 8]) + (part[j + 4] + part[j + 12])
    return wp.float64(four[0]) + wp.float64(four[1]) + (wp.float64(four[2]) + wp.float64(four[3]))


@wp.kernel
def distance_scan(
    queries: wp.array[float],  # (K, C, V, 16)
    planes: wp.array[float],  # (tile, C, V, 16), row 0 is the corpus row `start`
    weights: wp.array[float],  # (V, 16)
    number: int,  # K
    corpus: int,  # N
    start: int,
    tile: int,  # corpus rows of this launch
    vectors: int,  # V
    channels: int,
    first: int,
    count: int,
    # outputs
    distance: wp.array[float],  # (K, N)
):
    tid = wp.tid()
    if tid >= count:
        return
    groups = (number + QUERIES - 1) / QUERIES
    k0 = QUERIES * ((first + tid) % groups)
    k1 = wp.min(k0 + 1, number - 1)  # of an odd number the last is done twice
    begin_row = ROWS * ((first + tid) / groups)
    plane = LANES * vectors
    row = channels * plane
    for n0 in range(begin_row, wp.min(begin_row + ROWS, tile), 2):
        n1 = wp.min(n0 + 1, tile - 1)
        total00 = wp.float64(0.0)
        total01 = wp.float64(0.0)
        total10 = wp.float64(0.0)
        total11 = wp.float64(0.0)
        for begin in range(0, plane, BLOCK):
            part00 = vec16()
            part01 = vec16()
            part10 = vec16()
            part11 = vec16()
            for i in range(begin, wp.min(begin + BLOCK, plane), LANES):
                q0 = k0 * row + i
                q1 = k1 * row + i
                f0 = n0 * row + i
                f1 = n1 * row + i
                w = get(weights, i)
                part00 += wp.cw_mul(w, lengths(queries, q0, planes, f0, plane, channels))
                part01 += wp.cw_mul(w, lengths(queries, q0, planes, f1, plane, channels))
                part10 += wp.cw_mul(w, lengths(queries, q1, planes, f0, plane, channels))
                part11 += wp.cw_mul(w, lengths(queries, q1, planes, f1, plane, channels))
            total00 += sum_of(part00)
            total01 += sum_of(part01)
            total10 += sum_of(part10)
            total11 += sum_of(part11)
        distance[k0 * corpus + start + n0] = float(total00)
        distance[k0 * corpus + start + n1] = float(total01)
        distance[k1 * corpus + start + n0] = float(total10)
        distance[k1 * corpus + start + n1] = float(total11)
