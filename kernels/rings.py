"""Pictures splatted along a flow into sums of a ring of rows, and shown row by row.

A pixel is added as two vectors of a pixel and the one right of it, in red, green, blue and weight.
A row of sums that no later pixel reaches is shown, and its place is free for another. Pixels that
received too little are listed, and filled by pull-push in the end.
"""

import warp as wp

from mmmgpu.kernels.lanes import (
    HALF,
    LANES,
    add_at,
    address,
    colour_at,
    colours,
    fraction,
    get,
    get_half,
    ivec16,
    one_at,
    pitch_of,
    place_at,
    put,
    put_half,
    put_whole,
    share_of,
    uvec16,
    vec8,
    vec16,
    whole,
    within,
)
from mmmgpu.kernels.pyramid import between, fill

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


@wp.func
def channel(a: vec16, b: vec16, c: vec16, d: vec16, which: int):
    """One of the channels of 16 pixels."""
    v = vec16()
    for j in range(COLOUR):
        v[j] = a[COLOUR * j + which]
        v[j + 4] = b[COLOUR * j + which]
        v[j + 8] = c[COLOUR * j + which]
        v[j + 12] = d[COLOUR * j + which]
    return v


@wp.func
def known(share: vec16):
    """A weight of 1 where there is a mean, else 0."""
    v = vec16()
    for j in range(LANES):
        v[j] = wp.where(share[j] > 0.0, 1.0, 0.0)
    return v


@wp.func
def missed(asked: vec16, share: vec16):
    """What is asked for where there is no mean, else 0."""
    v = vec16()
    for j in range(LANES):
        v[j] = wp.where(share[j] > 0.0, 0.0, asked[j])
    return v


@wp.func
def positive(v: vec16):
    """How many there are."""
    number = int(0)
    for j in range(LANES):
        number += wp.where(v[j] > 0.0, 1, 0)
    return number


@wp.func
def add(out: wp.array[float], i: int, v: vec16):
    put(out, i, get(out, i) + v)


@wp.func
def add_pairs(cells: wp.array[float], i: int, v: vec16, more: float):
    """Add half of the sums over blocks of 2 x 2 (`more` is 1), or begin them (0)."""
    sum = vec8()
    for j in range(HALF):
        sum[j] = v[2 * j] + v[2 * j + 1]
    put_half(cells, i, sum + more * get_half(cells, i))


@wp.func
def show(
    total: wp.array[float],
    here: int,
    y: int,
    h: int,
    w: int,
    pitch: int,
    hole: float,
    weight: float,
    scale: wp.array[float],
    begun: int,
    out: wp.array[float],
    start: int,
    cells: wp.array[float],
    cell: int,
    holes: wp.array[int],
    list: int,
    found: int,
):
    """Add the means of row `y` to a picture that is `begun`, or begin it; begin the pyramid.

    Empties their sums. Pixels that are asked for and received too little go to the list of holes,
    of which there are `found`. Returns how many there are then.
    """
    area = h * pitch
    across = pitch_of((w + 1) / 2)
    step = (h + 1) / 2 * across
    number = int(found)
    if begun == 0:
        for i in range(0, 3 * pitch, LANES):
            put(out, start + i / pitch * area + y * pitch + i % pitch, vec16())
    for x in range(0, pitch, LANES):
        t = here + COLOUR * (x + LEFT)
        a = get(total, t)
        b = get(total, t + LANES)
        c = get(total, t + 2 * LANES)
        d = get(total, t + 3 * LANES)
        for k in range(COLOUR):
            put(total, t + LANES * k, vec16())
        share = share_of(within(channel(a, b, c, d, 3), w - x), hole)
        red = wp.cw_mul(share, channel(a, b, c, d, 0))
        green = wp.cw_mul(share, channel(a, b, c, d, 1))
        blue = wp.cw_mul(share, channel(a, b, c, d, 2))
        i = y * pitch + x
        asked = get(scale, i)
        lacks = missed(asked, share)
        if positive(lacks) > 0:
            for j in range(LANES):
                if lacks[j] > 0.0:
                    holes[list + number] = i + j
                    number += 1
        part = weight * asked
        add(out, start + i, wp.cw_mul(part, red))
        add(out, start + area + i, wp.cw_mul(part, green))
        add(out, start + 2 * area + i, wp.cw_mul(part, blue))
        more = float(y % 2)
        at = cell + y / 2 * across + x / 2
        add_pairs(cells, at, red, more)
        add_pairs(cells, at + step, green, more)
        add_pairs(cells, at + 2 * step, blue, more)
        add_pairs(cells, at + 3 * step, known(share), more)
    return number


@wp.func
def mend(
    holes: wp.array[int],
    list: int,
    found: int,
    h: int,
    w: int,
    pitch: int,
    weight: float,
    scale: wp.array[float],
    cells: wp.array[float],
    cell: int,
    out: wp.array[float],
    start: int,
):
    """Add to some pixels what is interpolated for them."""
    for k in range(found):
        i = holes[list + k]
        colour = weight * scale[i] * between(cells, cell, h, w, i / pitch, i % pitch)
        for c in range(3):
            out[start + c * h * pitch + i] += colour[c]


@wp.func
def carry(
    textures: wp.array[uvec16],
    texture: int,
    h: int,
    w: int,
    pitch: int,
    residual: wp.array[float],
    right: int,
    down: int,
    hole: float,
    weight: float,
    scale: wp.array[float],
    total: wp.array[float],
    here: int,
    cells: wp.array[float],
    cell: int,
    opens: wp.array[int],
    open: int,
    places: wp.array[int],
    place: int,
    steps: wp.array[float],
    step: int,
    holes: wp.array[int],
    list: int,
    begun: int,
    out: wp.array[float],
    start: int,
):
    """Add a prototype, carried along a flow, as `show` does. Returns 0 where nothing arrives."""
    ring = reach(residual, down, h, pitch, opens, open)
    shown = int(0)
    found = int(0)
    for y in range(h + 1):
        while shown < opens[open + y]:
            found = show(
                total,
                here + (shown & (ring - 1)) * COLOUR * (pitch + MARGIN),
                shown,
                h,
                w,
                pitch,
                hole,
                weight,
                scale,
                begun,
                out,
                start,
                cells,
                cell,
                holes,
                list,
                found,
            )
            shown += 1
        if y < h:
            aim(
                textures,
                texture + COLOUR * y * pitch / LANES,
                y,
                h,
                w,
                pitch,
                residual,
                right + y * pitch,
                down + y * pitch,
                ring,
                places,
                place,
                steps,
                step,
            )
            splat(pitch, places, place, steps, step, total, here)
    if found == 0:
        return 1
    if fill(cells, cell, (h + 1) / 2, (w + 1) / 2) == 0:
        return 0
    mend(holes, list, found, h, w, pitch, weight, scale, cells, cell, out, start)
    return 1
