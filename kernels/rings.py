"""Pictures splatted along a flow into sums of a ring of rows.

A pixel is added as two vectors of a pixel and the one right of it, in red, green, blue and weight.
A row of sums that no later pixel reaches can be shown (carrying); then its place is free again.
"""

import warp as wp

from mmmgpu.kernels.lanes import (
    LANES,
    add_at,
    address,
    colour_at,
    colours,
    fraction,
    get,
    ivec16,
    one_at,
    place_at,
    put,
    put_whole,
    uvec16,
    vec8,
    vec16,
    whole,
)

wp.set_module_options({"enable_backward": False})

APART = wp.constant(4)  # between pixels splatted in turn: neighbours would wait for each other
COLOUR = 4  # floats of a pixel: red, green, blue, weight
LEFT = wp.constant(4)  # pixels of a row of sums before the picture; the first two are nowhere
MARGIN = wp.constant(40)  # pixels of a row of sums beside the picture


@wp.func
def lower(low: vec16, q: vec16, least: float):
    """The lower of each, of those q that are not below the least."""
    v = vec16()
    for j in range(LANES):
        counts = wp.where(q[j] < least, low[j], q[j])
        v[j] = wp.where(counts < low[j], counts, low[j])
    return v


@wp.func
def higher(high: vec16, q: vec16, end: float):
    """The higher of each, of those q that are below the end."""
    v = vec16()
    for j in range(LANES):
        counts = wp.where(q[j] < end, q[j], high[j])
        v[j] = wp.where(counts > high[j], counts, high[j])
    return v


@wp.func
def reach(residual: wp.array[float], down: int, h: int, pitch: int, opens: wp.array[int], at: int):
    """Rows of sums that are needed at once.

    Row y of the source and those after it reach no row before opens[at + y].
    """
    open = int(h)
    most = int(1)
    opens[at + h] = h
    for y in range(h - 1, -1, -1):
        above = -1.0 - float(y)
        below = float(h - y)
        low = vec16(below)
        high = vec16(above)
        for x in range(0, pitch, LANES):
            q = get(residual, down + y * pitch + x)
            low = lower(low, q, above)
            high = higher(high, q, below)
        first = y + int(wp.floor(wp.min(low)))
        last = wp.min(y + int(wp.floor(wp.max(high))) + 1, h - 1)
        open = wp.min(wp.max(first, 0), open)
        most = wp.max(last - open + 1, most)
        opens[at + y] = open
    ring = int(1)
    while ring < most:
        ring *= 2
    return ring


@wp.func
def places_of(column: ivec16, row: ivec16, first: int, h: int, w: int, pitch: int, ring: int):
    """Where the sums of pixels are, and of those right of them; 0 for those that arrive nowhere.

    What pads a row is not moved, so that it stays outside the picture.
    """
    place = ivec16()
    length = COLOUR * (pitch + MARGIN)
    for j in range(LANES):
        x = column[j] + first + j
        there = (row[j] & (ring - 1)) * length + COLOUR * (x + LEFT)
        inside = wp.where(wp.uint32(row[j]) < wp.uint32(h), there, 0)
        place[j] = wp.where(wp.uint32(x + 1) <= wp.uint32(w), inside, 0)
    return place


@wp.func
def aim(
    textures: wp.array[uvec16],
    texture: int,
    y: int,
    h: int,
    w: int,
    pitch: int,
    residual: wp.array[float],
    right: int,
    down: int,
    ring: int,
    places: wp.array[int],
    place: int,
    steps: wp.array[float],
    step: int,
):
    """Where the pixels of row `y` arrive, how far between pixels, and which colours they have."""
    for v in range(pitch / LANES):
        i = LANES * v
        qx = get(residual, right + i)
        qy = get(residual, down + i)
        nx = whole(qx)
        ny = whole(qy)
        fy = fraction(qy, ny)
        put(steps, step + i, fraction(qx, nx))
        put(steps, step + pitch + i, vec16(1.0) - fy)
        put(steps, step + 2 * pitch + i, fy)
        row = ny + ivec16(y)
        put_whole(places, place + i, places_of(nx, row, i, h, w, pitch, ring))
        below = places_of(nx, row + ivec16(1), i, h, w, pitch, ring)
        put_whole(places, place + pitch + i, below)
        for k in range(COLOUR):
            colour = colours(textures[texture + COLOUR * v + k])
            put(steps, step + 3 * pitch + COLOUR * i + LANES * k, colour)


@wp.func
def splat(
    pitch: int,
    places: wp.array[int],
    place: int,
    steps: wp.array[float],
    step: int,
    total: wp.array[float],
    here: int,
):
    """Add the pixels of a row, each to the four around where it arrives."""
    row = wp.uint64(4) * wp.uint64(pitch)
    sums = address(total, here)
    across = address(steps, step)
    above = across + row
    below = above + row
    colours = below + row
    uppers = places.ptr + wp.uint64(4) * wp.uint64(place)
    lowers = uppers + row
    for first in range(APART):
        i = wp.uint64(4) * wp.uint64(first)
        while i < row:
            colour = colour_at(colours + wp.uint64(4) * i)
            fx = one_at(across + i)
            both = vec8()
            for k in range(COLOUR):
                both[k] = colour[k] * (1.0 - fx)
                both[k + COLOUR] = colour[k] * fx
            upper = wp.uint64(place_at(uppers + i))
            lower = wp.uint64(place_at(lowers + i))
            add_at(sums + wp.uint64(4) * upper, one_at(above + i) * both)
            add_at(sums + wp.uint64(4) * lower, one_at(below + i) * both)
            i += wp.uint64(4) * wp.uint64(APART)
