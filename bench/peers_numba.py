"""numba: all threads, fastmath, float32 sums. It does less than ours: no float64 accumulator."""

import numba
import numpy as np


def use_threads(number):
    """So many, or as many as it has."""
    numba.set_num_threads(min(number, numba.config.NUMBA_NUM_THREADS))


def forward_warp(field, flow):
    """Bilinear splat of (B, H, W, C) along (B, H, W, 2), one image a thread."""
    return _splat(field, flow)


@numba.njit(parallel=True, fastmath=True, cache=True)
def _splat(field, flow):
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


def distance_scan(queries, corpus, weights):
    """Weighted distances (K, N) of (K, P, 2) and (N, P, 2), channels laid out as planes first.

    A row of the corpus by the thread that uses it. Without planes it takes four times as long.
    """
    return _scan_planes(_planes(queries), corpus, weights)


@numba.njit(parallel=True, fastmath=True, cache=True)
def _scan_planes(queries, corpus, weights):
    number, _, points = queries.shape
    distance = np.empty((number, len(corpus)), np.float32)
    for n in numba.prange(len(corpus)):
        row = np.empty((2, points), np.float32)
        for p in range(points):
            row[0, p], row[1, p] = corpus[n, p]
        for k in range(number):
            total = np.float32(0)
            for p in range(points):
                dx = queries[k, 0, p] - row[0, p]
                dy = queries[k, 1, p] - row[1, p]
                total += weights[p] * np.sqrt(dx * dx + dy * dy)
            distance[k, n] = total
    return distance


@numba.njit(parallel=True, cache=True)
def _planes(fields):
    number, points, channels = fields.shape
    planes = np.empty((number, channels, points), np.float32)
    for n in numba.prange(number):
        for c in range(channels):
            for p in range(points):
                planes[n, c, p] = fields[n, p, c]
    return planes


def sample(field, points):
    """Bilinear gather, border clamped, one point after the other."""
    return _gather(field, points)


@numba.njit(parallel=True, fastmath=True, cache=True)
def _gather(field, points):
    batch, height, width, channels = field.shape
    number = points.shape[1]
    out = np.empty((batch, number, channels), np.float32)
    for b in range(batch):
        for p in numba.prange(number):
            x = min(max(points[b, p, 0], np.float32(0)), np.float32(width - 1))
            y = min(max(points[b, p, 1], np.float32(0)), np.float32(height - 1))
            x0, y0 = int(x), int(y)
            x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
            fx, fy = x - np.float32(x0), y - np.float32(y0)
            for c in range(channels):
                near = (1 - fx) * field[b, y0, x0, c] + fx * field[b, y0, x1, c]
                far = (1 - fx) * field[b, y1, x0, c] + fx * field[b, y1, x1, c]
                out[b, p, c] = (1 - fy) * near + fy * far
    return out


def blend(images, weights):
    """One pass over all images for each row of weights."""
    flat = images.reshape(len(images), -1)
    return _mix(flat, weights).reshape((-1, *images.shape[1:]))


@numba.njit(parallel=True, fastmath=True, cache=True)
def _mix(flat, weights):
    number, size = flat.shape
    out = np.zeros((len(weights), size), np.float32)
    part = 4096
    for i in numba.prange((size + part - 1) // part):
        for b in range(len(weights)):
            row = out[b, i * part : (i + 1) * part]
            for m in range(number):
                w, source = weights[b, m], flat[m, i * part : (i + 1) * part]
                for p in range(len(row)):
                    row[p] += w * source[p]
    return out


def normal_equations(images, wanted):
    """Pairs of images dealt out, each a sum of its own."""
    pairs = np.argwhere(np.tri(len(images) + 1, len(images), dtype=bool))
    return _multiply(images.reshape(len(images), -1), wanted.ravel(), pairs)


@numba.njit(parallel=True, fastmath=True, cache=True)
def _multiply(rows, wanted, pairs):
    number, size = rows.shape
    out = np.empty((number + 1, number), np.float32)
    for k in numba.prange(len(pairs)):
        m, n = pairs[k]
        other = rows[m] if m < number else wanted
        total = np.float32(0)
        for p in range(size):
            total += other[p] * rows[n, p]
        out[m, n] = total
        if m < number:
            out[n, m] = total
    return out


def evaluate_rbf(points, centres, weights, affine, sharpness):
    """All Gaussians of one point after the other."""
    return _gaussians(points, centres, weights, affine, np.float32(sharpness))


@numba.njit(parallel=True, fastmath=True, cache=True)
def _gaussians(points, centres, weights, affine, sharpness):
    out = np.empty_like(points)
    for p in numba.prange(len(points)):
        x, y = points[p]
        u = affine[0, 0] + affine[0, 1] * x + affine[0, 2] * y
        v = affine[1, 0] + affine[1, 1] * x + affine[1, 2] * y
        for k in range(len(centres)):
            dx, dy = x - centres[k, 0], y - centres[k, 1]
            phi = np.exp(-sharpness * (dx * dx + dy * dy))
            u += weights[k, 0] * phi
            v += weights[k, 1] * phi
        out[p, 0], out[p, 1] = u, v
    return out
