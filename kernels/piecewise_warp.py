"""Piecewise-affine warp: each pixel of a mesh is read where its triangle has gone.

Places are float64: rounded to float32 they would differ between runtimes by 1e-4 px.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def place(
    vertices: wp.array[float],
    triangles: wp.array[int],
    barycentric: wp.array[float],
    base: int,
    triangle: int,
    pixel: int,
    axis: int,
    last: int,
):
    at = wp.float64(0.0)
    for corner in range(3):
        vertex = base + triangles[3 * triangle + corner]
        share = wp.float64(barycentric[3 * pixel + corner])
        at += share * wp.float64(vertices[2 * vertex + axis])
    return wp.clamp(at, wp.float64(0.0), wp.float64(last))


@wp.kernel
def piecewise_warp(
    field: wp.array[float],  # (fields, H, W, C), fields is 1 or the batch
    vertices: wp.array[float],  # (sets, N, 2) = (x, y) [px], sets is 1 or the batch
    triangles: wp.array[int],  # (K, 3), each below N
    index: wp.array[int],  # (P,), each below K
    barycentric: wp.array[float],  # (P, 3)
    fields: int,
    sets: int,
    points: int,  # N
    number: int,  # P
    height: int,
    width: int,
    channels: int,
    first: int,
    count: int,
    # outputs
    warped: wp.array[float],  # (batch, P, C)
):
    tid = wp.tid()
    if tid >= count:
        return
    i = first + tid
    b = i / number
    p = i % number
    base = (b % sets) * points
    x = place(vertices, triangles, barycentric, base, index[p], p, 0, width - 1)
    y = place(vertices, triangles, barycentric, base, index[p], p, 1, height - 1)
    x0 = int(x)
    y0 = int(y)
    fx = float(x - wp.float64(x0))
    fy = float(y - wp.float64(y0))
    x1 = wp.min(x0 + 1, width - 1)
    y1 = wp.min(y0 + 1, height - 1)
    near = ((b % fields) * height + y0) * width
    far = ((b % fields) * height + y1) * width
    for c in range(channels):
        a0 = (1.0 - fx) * field[(near + x0) * channels + c]
        a0 += fx * field[(near + x1) * channels + c]
        a1 = (1.0 - fx) * field[(far + x0) * channels + c]
        a1 += fx * field[(far + x1) * channels + c]
        warped[i * channels + c] = (1.0 - fy) * a0 + fy * a1
