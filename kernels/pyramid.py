"""Pull-push hole filling of planes: red, green, blue and weight, one after the other.

Of the pixels, means have a weight of 1, and holes none; the levels hold sums over blocks of them. A
cell without weight is interpolated from the next coarser level.
"""

import warp as wp

from mmmgpu.kernels.lanes import HUGE, LANES, get, pairs, pitch_of, put, vec16

wp.set_module_options({"enable_backward": False})


@wp.func
def pull(
    fine: wp.array[float], finest: int, step: int, h: int, w: int, cells: wp.array[float], to: int
):
    """The level after one of h x w: sums over blocks of 2 x 2. Returns the least weight of all."""
    pitch = pitch_of(w)
    columns = (w + 1) / 2
    across = pitch_of(columns)
    rows = (h + 1) / 2
    low = vec16(HUGE)
    for y in range(rows):
        for x in range(0, across, LANES):
            sum = vec16()
            for c in range(4):
                i = finest + c * step + 2 * y * pitch + 2 * x
                left = get(fine, i)
                right = vec16()
                if 2 * y + 1 < h:
                    left += get(fine, i + pitch)
                if 2 * x + LANES < pitch:
                    right = get(fine, i + LANES)
                    if 2 * y + 1 < h:
                        right += get(fine, i + pitch + LANES)
                sum = pairs(left, right)
                put(cells, to + (c * rows + y) * across + x, sum)
            for j in range(LANES):
                low[j] = wp.where(x + j < columns and sum[j] < low[j], sum[j], low[j])
    return wp.min(low)


@wp.func
def mean(cells: wp.array[float], i: int, step: int):
    """Of a cell; the fourth is 1, or 0 where it is empty."""
    n = cells[i + 3 * step]
    known = wp.where(n > 0.0, 1.0, 0.0)
    share = wp.where(n > 0.0, 1.0 / n, 0.0)  # n times it may be less than 1 on a GPU
    return wp.vec4(share * cells[i], share * cells[i + step], share * cells[i + 2 * step], known)


@wp.func
def between(cells: wp.array[float], coarse: int, h: int, w: int, y: int, x: int):
    """The pixel (x, y) of a level of h x w, interpolated from four cells of the next one.

    The fourth is 1, or less where one of the four is empty.
    """
    columns = (w + 1) / 2
    rows = (h + 1) / 2
    across = pitch_of(columns)
    step = rows * across
    x0 = x / 2
    x1 = wp.clamp(x0 + 2 * (x % 2) - 1, 0, columns - 1)
    y0 = coarse + y / 2 * across
    y1 = coarse + wp.clamp(y / 2 + 2 * (y % 2) - 1, 0, rows - 1) * across
    near = 0.75 * mean(cells, y0 + x0, step) + 0.25 * mean(cells, y0 + x1, step)
    far = 0.75 * mean(cells, y1 + x0, step) + 0.25 * mean(cells, y1 + x1, step)
    return 0.75 * near + 0.25 * far


@wp.func
def set_cell(cells: wp.array[float], i: int, step: int, colour: wp.vec4):
    """Give an empty cell a colour, and the weight of one pixel."""
    cells[i] = colour[0]
    cells[i + step] = colour[1]
    cells[i + 2 * step] = colour[2]
    cells[i + 3 * step] = 1.0


@wp.func
def zeros(n: vec16):
    """How many there are: a least value minds NaN, and takes longer."""
    number = int(0)
    for j in range(LANES):
        number += wp.where(n[j] == 0.0, 1, 0)
    return number


@wp.func
def complete(cells: wp.array[float], first: int, height: int, width: int, levels: int):
    """Push: fill the empty cells of `levels` levels, of which the last has none."""
    for up in range(1, levels):
        h = int(height)
        w = int(width)
        at = int(first)
        for _ in range(levels - 1 - up):
            at += 4 * h * pitch_of(w)
            h = (h + 1) / 2
            w = (w + 1) / 2
        pitch = pitch_of(w)
        step = h * pitch
        for y in range(h):
            for first_x in range(0, w, LANES):
                if zeros(get(cells, at + 3 * step + y * pitch + first_x)) > 0:
                    for x in range(first_x, wp.min(first_x + LANES, w)):
                        i = at + y * pitch + x
                        if cells[i + 3 * step] == 0.0:
                            set_cell(cells, i, step, between(cells, at + 4 * step, h, w, y, x))


@wp.func
def least_weight(cells: wp.array[float], first: int, h: int, w: int):
    """The least weight of a cell of the first level."""
    pitch = pitch_of(w)
    low = vec16(HUGE)
    for y in range(h):
        for x in range(0, pitch, LANES):
            n = get(cells, first + y * pitch + x)
            for j in range(LANES):
                low[j] = wp.where(x + j < w and n[j] < low[j], n[j], low[j])
    return wp.min(low)


@wp.func
def fill(cells: wp.array[float], first: int, height: int, width: int):
    """Pull-push of a level of height x width cells. Returns 0 of nothing but holes.

    Levels are made until one has no empty cell.
    """
    h = int(height)
    w = int(width)
    low = least_weight(cells, first + 3 * h * pitch_of(w), h, w)
    at = int(first)
    levels = int(1)
    while low == 0.0 and (h > 1 or w > 1):
        plane = h * pitch_of(w)
        low = pull(cells, at, plane, h, w, cells, at + 4 * plane)
        at += 4 * plane
        h = (h + 1) / 2
        w = (w + 1) / 2
        levels += 1
    if low == 0.0:
        return 0
    complete(cells, first, height, width, levels)
    return 1
