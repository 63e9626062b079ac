"""Bilinear gather with the border clamped: a run of points a thread.

Pictures have a kernel of their own: Warp finds the address of every element it reads anew, and a
colour is one element. The places of a run are found as vectors first.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

RUN = 16
vec16 = wp.types.vector(length=RUN, dtype=wp.float32)
ivec16 = wp.types.vector(length=RUN, dtype=wp.int32)


@wp.func
def within(x: float, most: float):
    """0 ... most; wp.clamp minds NaN."""
    return wp.where(x < 0.0, 0.0, wp.where(x > most, most, x))


@wp.kernel
def sample(
    field: wp.array[float],  # (fields, H, W, C), fields is 1 or the batch
    points: wp.array[wp.vec2],  # (sets, N) = (x, y) [px], sets is 1 or the batch
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
    runs = (number + RUN - 1) / RUN
    b = (first + tid) / runs
    start = (first + tid) % runs * RUN
    origin = (b % fields) * height * width
    right = float(width - 1)
    bottom = float(height - 1)
    for p in range(start, wp.min(start + RUN, number)):
        point = points[(b % sets) * number + p]
        x = within(point[0], right)
        y = within(point[1], bottom)
        x0 = int(x)
        y0 = int(y)
        fx = x - float(x0)
        fy = y - float(y0)
        step = wp.where(x0 + 1 < width, channels, 0)
        near = (origin + y0 * width + x0) * channels
        far = wp.where(y0 + 1 < height, near + width * channels, near)
        for c in range(channels):
            a0 = (1.0 - fx) * field[near + c] + fx * field[near + step + c]
            a1 = (1.0 - fx) * field[far + c] + fx * field[far + step + c]
            sampled[(b * number + p) * channels + c] = (1.0 - fy) * a0 + fy * a1


@wp.kernel
def sample_pictures(
    pictures: wp.array[wp.vec3],  # (fields, H, W), fields is 1 or the batch
    points: wp.array[wp.vec2],  # (sets, N) = (x, y) [px], sets is 1 or the batch
    fields: int,
    sets: int,
    number: int,  # N
    height: int,
    width: int,
    first: int,
    count: int,
    # outputs
    sampled: wp.array[wp.vec3],  # (batch, N)
):
    tid = wp.tid()
    if tid >= count:
        return
    runs = (number + RUN - 1) / RUN
    b = (first + tid) / runs
    start = (first + tid) % runs * RUN
    origin = (b % fields) * height * width
    right = float(width - 1)
    bottom = float(height - 1)
    fx = vec16()
    fy = vec16()
    step = ivec16()
    near = ivec16()
    far = ivec16()
    for j in range(RUN):  # beyond the points: the last again, which is not written
        point = points[(b % sets) * number + wp.min(start + j, number - 1)]
        x = within(point[0], right)
        y = within(point[1], bottom)
        x0 = int(x)
        y0 = int(y)
        fx[j] = x - float(x0)
        fy[j] = y - float(y0)
        step[j] = wp.where(x0 + 1 < width, 1, 0)
        near[j] = origin + y0 * width + x0
        far[j] = near[j] + wp.where(y0 + 1 < height, width, 0)
    for j in range(wp.min(RUN, number - start)):
        a0 = (1.0 - fx[j]) * pictures[near[j]] + fx[j] * pictures[near[j] + step[j]]
        a1 = (1.0 - fx[j]) * pictures[far[j]] + fx[j] * pictures[far[j] + step[j]]
        sampled[b * number + start + j] = (1.0 - fy[j]) * a0 + fy[j] * a1
