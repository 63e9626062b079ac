"""The image operations as slow, obvious loops over plain Python numbers."""

import math

import numpy as np


def forward_warp(field, flow):
    """One field (H, W, C) along one flow (H, W, 2): every source pixel in turn, tap by tap."""
    height, width, channels = field.shape
    total = np.zeros((height, width, channels))
    weight = np.zeros((height, width))
    for y in range(height):
        for x in range(width):
            (ix, fx), (iy, fy) = (split(float(v)) for v in flow[y, x])
            for dy, wy in ((0, 1 - fy), (1, fy)):
                for dx, wx in ((0, 1 - fx), (1, fx)):
                    ty, tx = y + iy + dy, x + ix + dx
                    if 0 <= ty < height and 0 <= tx < width:
                        total[ty, tx] += wx * wy * field[y, x].astype(float)
                        weight[ty, tx] += wx * wy
    arrived = weight > 0
    total[arrived] /= weight[arrived][:, None]
    return total, weight


def split(value):
    """A displacement as a whole number, of any size, and a float32 fraction."""
    whole = math.floor(value)
    return whole, float(np.float32(value) - np.float32(whole))


def fill_holes(field, weight, threshold):
    """One field: each hole from block means, computed anew for every cell of every level."""
    valid = weight >= np.float32(threshold)
    filled = field.astype(float)
    for y, x in np.argwhere(~valid):
        filled[y, x] = _up(field, valid, 1, y, x)
    return filled


def _up(field, valid, level, y, x):
    """The four cells of `level` around the centre of cell (y, x) of the level below."""
    rows, columns = (-(-n // 2**level) for n in valid.shape)
    value = 0.0
    for cy, wy in ((y // 2, 0.75), (y // 2 + (1 if y % 2 else -1), 0.25)):
        for cx, wx in ((x // 2, 0.75), (x // 2 + (1 if x % 2 else -1), 0.25)):
            cell = min(max(cy, 0), rows - 1), min(max(cx, 0), columns - 1)
            value = value + wy * wx * _cell(field, valid, level, *cell)
    return value


def _cell(field, valid, level, y, x):
    """The mean of the valid pixels of a block of 2**level, or else what the next level gives."""
    size = 2**level
    block = np.s_[y * size : (y + 1) * size, x * size : (x + 1) * size]
    inside = field[block][valid[block]]
    return inside.astype(float).mean(axis=0) if len(inside) else _up(field, valid, level + 1, y, x)


def blend(images, weights):
    """One blend: a running sum over the images."""
    total = np.zeros(images.shape[1:])
    for image, weight in zip(images, weights, strict=True):
        total += float(weight) * image.astype(float)
    return total


def normal_equations(images, wanted):
    """Every product a running sum over the values."""
    rows = [image.ravel().tolist() for image in images]
    return tuple(
        np.array(
            [
                [sum(a * b for a, b in zip(row, other, strict=True)) for other in others]
                for row in rows
            ]
        )
        for others in (rows, [wanted.ravel().tolist()])
    )


def sample(field, points):
    """Samples (N, C) of one field at points (N, 2)."""
    height, width, _ = field.shape
    samples = []
    for x, y in points.astype(float):
        x, y = min(max(x, 0), width - 1), min(max(y, 0), height - 1)
        value = np.zeros(field.shape[2])
        for ty in range(height):
            for tx in range(width):
                value += max(0, 1 - abs(tx - x)) * max(0, 1 - abs(ty - y)) * field[ty, tx]
        samples.append(value)
    return np.array(samples)


def piecewise_warp(field, vertices, triangles, index, barycentric):
    """Values (P, C) of one field at the pixels of a mesh, corner after corner."""
    places = []
    for triangle, shares in zip(index, barycentric, strict=True):
        place = [0.0, 0.0]
        for vertex, share in zip(triangles[triangle], shares, strict=True):
            for axis in range(2):
                place[axis] += float(share) * float(vertices[vertex, axis])
        places.append(place)
    return sample(field, np.array(places))


def evaluate_rbf(points, centres, weights, affine, sharpness):
    """Images (P, 2) of points (P, 2): term by term."""
    mapped = []
    for x, y in points.astype(float):
        value = affine.astype(float) @ [1, x, y]
        for centre, weight in zip(centres.astype(float), weights.astype(float), strict=True):
            value = value + weight * math.exp(-sharpness * math.dist((x, y), centre) ** 2)
        mapped.append(value)
    return np.array(mapped)


def distance_scan(queries, corpus, weights):
    """Every pair of fields, point by point."""
    return np.array(
        [
            [
                sum(w * math.dist(a, b) for w, a, b in zip(weights, query, frame, strict=True))
                for frame in corpus.astype(float)
            ]
            for query in queries.astype(float)
        ]
    )
