"""Weighted Euclidean distances between two sets of fields (CE05, Eq. 7 and 10).

`pack` lays the channels of each field out as planes padded to whole vectors; `distance_scan` walks
them 16 points at a time, in float32 within a block and in float64 from block to block. Two queries
share each load of the corpus.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

LANES = 16
BLOCK = wp.constant(16)  # vectors summed in float32
vec16 = wp.types.vector(length=LANES, dtype=wp.float32)


@wp.kernel
def pack(
    fields: wp.array[float],  # (N, P, C)
    points: int,  # P
    channels: int,
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
        for p in range(points):
            planes[target + p] = fields[source + p * channels + c]
        for p in range(points, padded):
            planes[target + p] = 0.0


@wp.kernel
def distance_scan(
    queries: wp.array[vec16],  # (K, C, V)
    planes: wp.array[vec16],  # (tile, C, V), row 0 is the first corpus row of this launch
    weights: wp.array[vec16],  # (V,)
    number: int,  # K
    corpus: int,  # N
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
    pairs = (number + 1) / 2
    k0 = 2 * ((first + tid) % pairs)
    k1 = wp.min(k0 + 1, number - 1)  # of an odd number the last query is done twice
    n = (first + tid) / pairs
    q0 = k0 * channels * vectors
    q1 = k1 * channels * vectors
    f = (n - first / pairs) * channels * vectors
    total0 = wp.float64(0.0)
    total1 = wp.float64(0.0)
    for start in range(0, vectors, BLOCK):
        part0 = vec16()
        part1 = vec16()
        for v in range(start, wp.min(start + BLOCK, vectors)):
            norm0 = vec16()
            norm1 = vec16()
            for c in range(channels):
                plane = planes[f + c * vectors + v]
                r0 = queries[q0 + c * vectors + v] - plane
                r1 = queries[q1 + c * vectors + v] - plane
                norm0 += wp.cw_mul(r0, r0)
                norm1 += wp.cw_mul(r1, r1)
            for lane in range(LANES):
                norm0[lane] = wp.sqrt(norm0[lane])
            for lane in range(LANES):
                norm1[lane] = wp.sqrt(norm1[lane])
            part0 += wp.cw_mul(weights[v], norm0)
            part1 += wp.cw_mul(weights[v], norm1)
        for lane in range(LANES):
            total0 += wp.float64(part0[lane])
            total1 += wp.float64(part1[lane])
    distance[k0 * corpus + n] = float(total0)
    distance[k1 * corpus + n] = float(total1)
