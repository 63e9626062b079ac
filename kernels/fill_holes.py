"""Pull-push hole filling: valid pixels are averaged down a pyramid, holes interpolated back up.

A cell is valid where its weight reaches the threshold. A coarse cell holds the mean of the valid
pixels of its block, and their number as its weight; one without any is interpolated from the level
above it. Every thread takes one row.
"""

import warp as wp

from mmmgpu.kernels.lanes import LANES, address, get, one_at, put

wp.set_module_options({"enable_backward": False})

GROUP = wp.constant(4)  # channels unrolled: twice as fast as one loop of unknown length


@wp.func
def at(values: wp.array[float], i: int):
    """values[i] without the questions whether i is negative and values are strided."""
    return one_at(address(values, i))


@wp.func
def number_valid(weight: wp.array[float], i: int, threshold: float):
    """How many of 16 neighbours in a row are valid."""
    some = get(weight, i)
    n = int(0)
    for j in range(LANES):
        n += wp.where(some[j] >= threshold, 1, 0)
    return n


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
    whole = width / LANES * LANES
    for x in range(0, whole, LANES):
        n += number_valid(weight, row * width + x, threshold)
    for x in range(whole, width):
        n += wp.where(weight[row * width + x] >= threshold, 1, 0)
    valid[row] = n


@wp.func
def share(weight: float, threshold: float, finest: int):
    """Number of valid pixels in a cell; in the finest level weights are not numbers yet."""
    if weight < threshold:
        return 0.0
    return wp.where(finest == 1, 1.0, weight)


@wp.kernel
def pull(
    holes: wp.array[int],  # (batch,) 0 where an image has no holes: it has no levels
    value: wp.array[float],  # (batch, h, w, C), a level
    weight: wp.array[float],  # (batch, h, w)
    threshold: float,
    finest: int,
    height: int,  # h
    width: int,  # w
    channels: int,
    first: int,
    count: int,
    # outputs
    filled: wp.array[float],  # (batch, h, w, C), in the finest level the valid are written
    coarse: wp.array[float],  # (batch, ceil(h / 2), ceil(w / 2), C)
    number: wp.array[float],  # (batch, ceil(h / 2), ceil(w / 2)), valid pixels in the block
):
    tid = wp.tid()
    if tid >= count:
        return
    rows = (height + 1) / 2
    columns = (width + 1) / 2
    b = (first + tid) / rows
    y = 2 * ((first + tid) % rows)
    upper = (b * height + y) * width
    if finest == 1:
        begin = upper * channels
        end = begin + wp.min(height - y, 2) * width * channels
        whole = end - (end - begin) % LANES
        for i in range(begin, whole, LANES):
            put(filled, i, get(value, i))
        for i in range(whole, end):
            filled[i] = value[i]
    if holes[b] == 0:
        return
    lower = (b * height + wp.min(y + 1, height - 1)) * width
    for column in range(columns):
        x = 2 * column
        right = wp.min(x + 1, width - 1)
        n00 = share(at(weight, upper + x), threshold, finest)
        n01 = share(at(weight, upper + right), threshold, finest)
        n10 = share(at(weight, lower + x), threshold, finest)
        n11 = share(at(weight, lower + right), threshold, finest)
        if x + 1 >= width:
            n01 = 0.0
            n11 = 0.0
        if y + 1 >= height:
            n10 = 0.0
            n11 = 0.0
        n = n00 + n01 + n10 + n11
        scale = float(0.0)
        if n > 0.0:
            scale = 1.0 / n
        cell = (first + tid) * columns + column
        number[cell] = n
        for group in range(0, channels, GROUP):
            for lane in range(GROUP):
                c = group + lane
                if c < channels:
                    total = n00 * at(value, (upper + x) * channels + c)
                    total += n01 * at(value, (upper + right) * channels + c)
                    total += n10 * at(value, (lower + x) * channels + c)
                    total += n11 * at(value, (lower + right) * channels + c)
                    coarse[cell * channels + c] = total * scale


@wp.kernel
def push(
    holes: wp.array[int],  # (batch,) 0 where an image has no holes: it is skipped
    weight: wp.array[float],  # (batch, h, w)
    coarse: wp.array[float],  # (batch, ceil(h / 2), ceil(w / 2), C), complete
    threshold: float,
    height: int,  # h
    width: int,  # w
    channels: int,
    first: int,
    count: int,
    # outputs
    value: wp.array[float],  # (batch, h, w, C), its holes are written
):
    tid = wp.tid()
    if tid >= count:
        return
    rows = (height + 1) / 2
    columns = (width + 1) / 2
    row = first + tid
    b = row / height
    if holes[b] == 0:
        return
    y = row % height
    # a pixel lies 1/4 from the centre of its own cell towards the next cell on its side
    y1 = wp.clamp(y / 2 + 2 * (y % 2) - 1, 0, rows - 1)
    near = (b * rows + y / 2) * columns
    far = (b * rows + y1) * columns
    for start in range(0, width, LANES):
        valid = int(0)
        if start + LANES <= width:
            valid = number_valid(weight, row * width + start, threshold)
        if valid < LANES:
            for x in range(start, wp.min(start + LANES, width)):
                i = row * width + x
                if weight[i] < threshold:
                    x0 = x / 2
                    x1 = wp.clamp(x0 + 2 * (x % 2) - 1, 0, columns - 1)
                    for c in range(channels):
                        a0 = 0.75 * coarse[(near + x0) * channels + c]
                        a0 += 0.25 * coarse[(near + x1) * channels + c]
                        a1 = 0.75 * coarse[(far + x0) * channels + c]
                        a1 += 0.25 * coarse[(far + x1) * channels + c]
                        value[i * channels + c] = 0.75 * a0 + 0.25 * a1
