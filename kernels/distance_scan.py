"""Weighted Euclidean distances between two sets of fields (CE05, Eq. 7 and 10).

`pack` lays the channels of each field out as planes padded to whole vectors; `distance_scan` walks
them 16 points at a time, in float32 within a block and in float64 from block to block. Two queries
and two rows of the corpus share their loads; a thread does four rows, as in OpenCL.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

LANES = 16
BLOCK = wp.constant(16)  # vectors summed in float32
QUERIES, ROWS = wp.constant(2), wp.constant(4)  # of a thread, two rows at a time
vec16 = wp.types.vector(length=LANES, dtype=wp.float32)
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
def root(x: vec16):
    """The square root of each."""
    y = x
    for lane in range(LANES):
        y[lane] = wp.sqrt(x[lane])
    return y


@wp.kernel
def distance_scan(
    queries: wp.array[vec16],  # (K, C, V)
    planes: wp.array[vec16],  # (tile, C, V), row 0 is the corpus row `start`
    weights: wp.array[vec16],  # (V,)
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
    row = channels * vectors
    for n0 in range(begin_row, wp.min(begin_row + ROWS, tile), 2):
        n1 = wp.min(n0 + 1, tile - 1)
        total00 = wp.float64(0.0)
        total01 = wp.float64(0.0)
        total10 = wp.float64(0.0)
        total11 = wp.float64(0.0)
        for begin in range(0, vectors, BLOCK):
            part00 = vec16()
            part01 = vec16()
            part10 = vec16()
            part11 = vec16()
            for v in range(begin, wp.min(begin + BLOCK, vectors)):
                norm00 = vec16()
                norm01 = vec16()
                norm10 = vec16()
                norm11 = vec16()
                for i in range(v, row, vectors):
                    q0 = queries[k0 * row + i]
                    q1 = queries[k1 * row + i]
                    f0 = planes[n0 * row + i]
                    f1 = planes[n1 * row + i]
                    norm00 += wp.cw_mul(q0 - f0, q0 - f0)
                    norm01 += wp.cw_mul(q0 - f1, q0 - f1)
                    norm10 += wp.cw_mul(q1 - f0, q1 - f0)
                    norm11 += wp.cw_mul(q1 - f1, q1 - f1)
                w = weights[v]
                part00 += wp.cw_mul(w, root(norm00))
                part01 += wp.cw_mul(w, root(norm01))
                part10 += wp.cw_mul(w, root(norm10))
                part11 += wp.cw_mul(w, root(norm11))
            for lane in range(LANES):
                total00 += wp.float64(part00[lane])
                total01 += wp.float64(part01[lane])
                total10 += wp.float64(part10[lane])
                total11 += wp.float64(part11[lane])
        distance[k0 * corpus + start + n0] = float(total00)
        distance[k0 * corpus + start + n1] = float(total01)
        distance[k1 * corpus + start + n0] = float(total10)
        distance[k1 * corpus + start + n1] = float(total11)
