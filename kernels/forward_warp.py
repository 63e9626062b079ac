"""Forward warping: bilinear splatting along a flow, normalised by the weight that arrived.

A worker owns one accumulator and one band of target rows at a time, and scans the whole source in
raster order: no atomics, and the same bits for any number of workers and bands. Sums are float64
(a flow may send a whole picture to one pixel). One launch takes up to four channels.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(1.0e8)  # [px] beyond any picture, inside int32
GROUP = 4
vec4d = wp.types.vector(length=GROUP, dtype=wp.float64)


@wp.kernel
def forward_warp(
    field: wp.array[float],  # (fields, H, W, C), fields is 1 or the batch
    flow: wp.array[wp.vec2],  # (flows, H, W) [px], flows is 1 or the batch
    fields: int,
    flows: int,
    batch: int,
    height: int,
    width: int,
    channels: int,
    channel: int,  # the first of the group
    bands: int,
    workers: int,
    first: int,
    count: int,
    # outputs
    total: wp.array[vec4d],  # (workers, ceil(H / bands), W), scratch: sums of weight x value
    mass: wp.array[wp.float64],  # (workers, ceil(H / bands), W), scratch: sums of weight
    warped: wp.array[float],  # (batch, H, W, C), the channels of the group are written
    weight: wp.array[float],  # (batch, H, W)
):
    tid = wp.tid()
    if tid >= count:
        return
    worker = first + tid
    group = wp.min(channels - channel, GROUP)
    rows = (height + bands - 1) / bands
    base = worker * rows * width
    for i in range(rows * width):
        total[base + i] = vec4d()
        mass[base + i] = wp.float64(0.0)
    for job in range(worker, batch * bands, workers):
        b = job / bands
        top = (job % bands) * rows
        bottom = wp.min(top + rows, height)
        source = (b % fields) * height * width
        along = (b % flows) * height * width
        for sy in range(height):
            for sx in range(width):
                s = sy * width + sx
                q = flow[along + s]
                down = wp.floor(q[1])
                y = sy + int(wp.clamp(down, -FAR, FAR))
                if y >= top - 1 and y < bottom:
                    right = wp.floor(q[0])
                    x = sx + int(wp.clamp(right, -FAR, FAR))
                    fx = q[0] - right
                    fy = q[1] - down
                    gx = 1.0 - fx
                    gy = 1.0 - fy
                    value = vec4d()
                    pixel = (source + s) * channels + channel
                    if group == GROUP:
                        for c in range(GROUP):
                            value[c] = wp.float64(field[pixel + c])
                    else:
                        for c in range(group):
                            value[c] = wp.float64(field[pixel + c])
                    t = base + (y - top) * width + x
                    if x >= 0 and x + 1 < width and y >= top and y + 1 < bottom:
                        w00 = wp.float64(gx * gy)
                        w01 = wp.float64(fx * gy)
                        w10 = wp.float64(gx * fy)
                        w11 = wp.float64(fx * fy)
                        total[t] += w00 * value
                        total[t + 1] += w01 * value
                        total[t + width] += w10 * value
                        total[t + width + 1] += w11 * value
                        mass[t] += w00
                        mass[t + 1] += w01
                        mass[t + width] += w10
                        mass[t + width + 1] += w11
                    else:
                        for tap in range(4):
                            dx = tap % 2
                            dy = tap / 2
                            if x + dx >= 0 and x + dx < width and y + dy >= top and y + dy < bottom:
                                w = wp.where(dx == 1, fx, gx) * wp.where(dy == 1, fy, gy)
                                total[t + dy * width + dx] += wp.float64(w) * value
                                mass[t + dy * width + dx] += wp.float64(w)
        start = (b * height + top) * width
        for i in range((bottom - top) * width):
            w64 = mass[base + i]
            scale = wp.float64(0.0)
            if w64 > wp.float64(0.0):
                scale = wp.float64(1.0) / w64
            mean = total[base + i] * scale
            total[base + i] = vec4d()  # for the next job
            mass[base + i] = wp.float64(0.0)
            for c in range(GROUP):
                if c < group:
                    warped[(start + i) * channels + channel + c] = float(mean[c])
            weight[start + i] = float(w64)
