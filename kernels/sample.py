"""Bilinear gather with the border clamped."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def sample(
    field: wp.array[float],  # (fields, H, W, C), fields is 1 or the batch
    points: wp.array[float],  # (sets, N, 2) = (x, y) [px], sets is 1 or the batch
    fields: int,
    sets: int,
    number: int,  # N
    height: int,
    width: int,
    channels: int,
    first: int,
    count: int,
    # outputs
    sampled: wp.array[float],  # (batch, N, C)
):
    tid = wp.tid()
    if tid >= count:
        return
    i = first + tid
    b = i / number
    p = (b % sets) * number + i % number
    x = wp.clamp(points[2 * p], 0.0, float(width - 1))
    y = wp.clamp(points[2 * p + 1], 0.0, float(height - 1))
    x0 = int(x)
    y0 = int(y)
    fx = x - float(x0)
    fy = y - float(y0)
    x1 = wp.min(x0 + 1, width - 1)
    y1 = wp.min(y0 + 1, height - 1)
    near = ((b % fields) * height + y0) * width
    far = ((b % fields) * height + y1) * width
    for c in range(channels):
        a0 = (1.0 - fx) * field[(near + x0) * channels + c]
        a0 += fx * field[(near + x1) * channels + c]
        a1 = (1.0 - fx) * field[(far + x0) * channels + c]
        a1 += fx * field[(far + x1) * channels + c]
        sampled[i * channels + c] = (1.0 - fy) * a0 + fy * a1
