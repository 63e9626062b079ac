"""Forward warping: bilinear splatting along a flow, normalised by the weight that arrived.

A worker owns one accumulator and one band of target rows at a time, and scans the whole source in
raster order: no atomics, and the same bits for any number of workers and bands.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(1.0e8)  # beyond any picture, inside int32


@wp.kernel
def forward_warp(
    field: wp.array[float],  # (fields, H, W, C), fields is 1 or the batch
    flow: wp.array[float],  # (flows, H, W, 2) [px], flows is 1 or the batch
    fields: int,
    flows: int,
    batch: int,
    height: int,
    width: int,
    channels: int,
    bands: int,
    workers: int,
    first: int,
    count: int,
    # outputs
    total: wp.array[wp.float64],  # (workers, ceil(H / bands), W, C + 1), scratch
    warped: wp.array[float],  # (batch, H, W, C)
    weight: wp.array[float],  # (batch, H, W)
):
    tid = wp.tid()
    if tid >= count:
        return
    worker = first + tid
    rows = (height + bands - 1) / bands
    cell = channels + 1
    base = worker * rows * width * cell
    for job in range(worker, batch * bands, workers):
        b = job / bands
        top = (job % bands) * rows
        bottom = wp.min(top + rows, height)
        for i in range((bottom - top) * width * cell):
            total[base + i] = wp.float64(0.0)
        source = (b % fields) * height * width
        along = (b % flows) * height * width
        for s in range(height * width):
            qy = flow[2 * (along + s) + 1]
            down = wp.floor(qy)
            y = s / width + int(wp.clamp(down, -FAR, FAR))
            if y >= top - 1 and y < bottom:
                qx = flow[2 * (along + s)]
                right = wp.floor(qx)
                x = s % width + int(wp.clamp(right, -FAR, FAR))
                fy = qy - down
                fx = qx - right
                for tap in range(4):
                    dx = tap % 2
                    dy = tap / 2
                    tx = x + dx
                    ty = y + dy
                    if tx >= 0 and tx < width and ty >= top and ty < bottom:
                        wx = wp.where(dx == 1, fx, 1.0 - fx)
                        wy = wp.where(dy == 1, fy, 1.0 - fy)
                        w = wp.float64(wx * wy)
                        t = base + ((ty - top) * width + tx) * cell
                        for c in range(channels):
                            total[t + c] += w * wp.float64(field[(source + s) * channels + c])
                        total[t + channels] += w
        start = (b * height + top) * width
        for i in range((bottom - top) * width):
            t = base + i * cell
            w = total[t + channels]
            scale = wp.float64(0.0)
            if w > wp.float64(0.0):
                scale = wp.float64(1.0) / w
            for c in range(channels):
                warped[(start + i) * channels + c] = float(total[t + c] * scale)
            weight[start + i] = float(w)
