"""The same operations by other means: numba, all threads, float32 sums.

They do less than ours: no float64 accumulator, no check of the input.
"""

import numba
import numpy as np


@numba.njit(parallel=True, fastmath=True, cache=True)
def forward_warp(field, flow):
    """Bilinear splat of (B, H, W, C) along (B, H, W, 2), one image a thread."""
    batch, height, width, channels = field.shape
    warped = np.zeros((batch, height, width, channels), np.float32)
    weight = np.zeros((batch, height, width), np.float32)
    for b in numba.prange(batch):
        for y in range(height):
            for x in range(width):
                left = np.floor(flow[b, y, x, 0])
                top = np.floor(flow[b, y, x, 1])
                fx = flow[b, y, x, 0] - left
                fy = flow[b, y, x, 1] - top
                for dy in range(2):
                    ty = y + int(top) + dy
                    wy = fy if dy else 1 - fy
                    for dx in range(2):
                        tx = x + int(left) + dx
                        if 0 <= tx < width and 0 <= ty < height:
                            w = wy * (fx if dx else 1 - fx)
                            for c in range(channels):
                                warped[b, ty, tx, c] += w * field[b, y, x, c]
                            weight[b, ty, tx] += w
        for y in range(height):
            for x in range(width):
                if weight[b, y, x] > 0:
                    for c in range(channels):
                        warped[b, y, x, c] /= weight[b, y, x]
    return warped, weight


@numba.njit(parallel=True, fastmath=True, cache=True)
def _scan_planes(queries, corpus, weights):
    number, _, points = queries.shape
    distance = np.empty((number, len(corpus)), np.float32)
    for n in numba.prange(len(corpus)):
        for k in range(number):
            total = np.float32(0)
            for p in range(points):
                dx = queries[k, 0, p] - corpus[n, 0, p]
                dy = queries[k, 1, p] - corpus[n, 1, p]
                total += weights[p] * np.sqrt(dx * dx + dy * dy)
            distance[k, n] = total
    return distance


def distance_scan(queries, corpus, weights):
    """Weighted distances (K, N) of (K, P, 2) and (N, P, 2), channels laid out as planes first."""
    return _scan_planes(_planes(queries), _planes(corpus), weights)


@numba.njit(parallel=True, cache=True)
def _planes(fields):
    number, points, channels = fields.shape
    planes = np.empty((number, channels, points), np.float32)
    for n in numba.prange(number):
        for c in range(channels):
            for p in range(points):
                planes[n, c, p] = fields[n, p, c]
    return planes
