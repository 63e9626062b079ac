"""Pull-push hole filling: valid pixels are averaged down a pyramid, holes interpolated back up.

A pixel is valid where its weight reaches the threshold. A coarse cell holds the mean of the valid
pixels of its block and their number; a cell without any is interpolated from the level above it.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def count_valid(
    weight: wp.array[float],  # (batch * H, W)
    threshold: float,
    width: int,
    first: int,
    count: int,
    # outputs
    valid: wp.array[int],  # (batch * H,)
):
    tid = wp.tid()
    if tid >= count:
        return
    row = first + tid
    n = int(0)
    for x in range(width):
        if weight[row * width + x] >= threshold:
            n += 1
    valid[row] = n


@wp.kernel
def pull(
    holes: wp.array[int],  # (batch,) 1 where the image has holes; the others are skipped
    value: wp.array[float],  # (batch, h, w, C), a level
    weight: wp.array[float],  # (batch, h, w), at the finest level of the caller, then the numbers
    threshold: float,
    finest: int,
    height: int,
    width: int,
    channels: int,
    first: int,
    count: int,
    # outputs
    coarse: wp.array[float],  # (batch, ceil(h / 2), ceil(w / 2), C)
    number: wp.array[float],  # (batch, ceil(h / 2), ceil(w / 2)), valid pixels in the block
):
    tid = wp.tid()
    if tid >= count:
        return
    cell = first + tid
    columns = (width + 1) / 2
    rows = (height + 1) / 2
    b = cell / (rows * columns)
    if holes[b] == 0:
        return
    y = 2 * ((cell / columns) % rows)
    x = 2 * (cell % columns)
    n = float(0.0)
    for c in range(channels):
        coarse[cell * channels + c] = 0.0
    for ty in range(y, wp.min(y + 2, height)):
        for tx in range(x, wp.min(x + 2, width)):
            i = (b * height + ty) * width + tx
            if weight[i] >= threshold:
                w = wp.where(finest == 1, 1.0, weight[i])
                n += w
                for c in range(channels):
                    coarse[cell * channels + c] += w * value[i * channels + c]
    if n > 0.0:
        for c in range(channels):
            coarse[cell * channels + c] = coarse[cell * channels + c] / n
    number[cell] = n


@wp.kernel
def push(
    holes: wp.array[int],  # (batch,) 1 where the image has holes; the others are copied
    value: wp.array[float],  # (batch, h, w, C), a level
    weight: wp.array[float],  # (batch, h, w)
    coarse: wp.array[float],  # (batch, ceil(h / 2), ceil(w / 2), C), complete
    threshold: float,
    height: int,
    width: int,
    channels: int,
    first: int,
    count: int,
    # outputs
    filled: wp.array[float],  # (batch, h, w, C), may be `value`
):
    tid = wp.tid()
    if tid >= count:
        return
    i = first + tid
    b = i / (height * width)
    if holes[b] == 0 or weight[i] >= threshold:
        for c in range(channels):
            filled[i * channels + c] = value[i * channels + c]
        return
    columns = (width + 1) / 2
    rows = (height + 1) / 2
    x = i % width
    y = (i / width) % height
    # the near cell holds the pixel (3/4), the far one is its neighbour on the pixel's side (1/4)
    x0 = x / 2
    y0 = y / 2
    x1 = wp.clamp(x0 + 2 * (x % 2) - 1, 0, columns - 1)
    y1 = wp.clamp(y0 + 2 * (y % 2) - 1, 0, rows - 1)
    near = (b * rows + y0) * columns
    far = (b * rows + y1) * columns
    for c in range(channels):
        a0 = 0.75 * coarse[(near + x0) * channels + c] + 0.25 * coarse[(near + x1) * channels + c]
        a1 = 0.75 * coarse[(far + x0) * channels + c] + 0.25 * coarse[(far + x1) * channels + c]
        filled[i * channels + c] = 0.75 * a0 + 0.25 * a1
