"""Prototypes carried along a flow: splatted (rings), shown row by row, holes filled (pyramid).

Pixels that received too little are listed when their row is shown, and filled later. Each array
comes with the index where what belongs to a prototype begins; OpenCL has pointers there.
"""

import warp as wp

from mmmgpu.kernels.lanes import (
    HALF,
    LANES,
    get,
    get_half,
    pitch_of,
    put,
    put_half,
    share_of,
    uvec16,
    vec8,
    vec16,
    within,
)
from mmmgpu.kernels.pyramid import between, fill
from mmmgpu.kernels.rings import COLOUR, LEFT, MARGIN, aim, reach, splat

wp.set_module_options({"enable_backward": False})


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
    """Add half of the sums over blocks of 2 x 2 (`more` is 1), or begin them (0).

    No NaN must be where they begin: it would stay.
    """
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
    apart: int,
    out: wp.array[float],
    start: int,
    cells: wp.array[float],
    cell: int,
    holes: wp.array[int],
    list: int,
    found: int,
):
    """Add the means of row `y` to a picture that is `begun`, or begin it; begin the pyramid.

    Channels of the picture are `apart` floats from each other. Empties the sums. Pixels that are
    asked for and received too little go to the list of holes, of which there are `found`. Returns
    how many there are then.
    """
    across = pitch_of((w + 1) / 2)
    step = (h + 1) / 2 * across
    number = int(found)
    if begun == 0:
        for i in range(0, 3 * pitch, LANES):
            put(out, start + i / pitch * apart + y * pitch + i % pitch, vec16())
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
        add(out, start + apart + i, wp.cw_mul(part, green))
        add(out, start + 2 * apart + i, wp.cw_mul(part, blue))
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
    shown: int,
    weight: float,
    scale: wp.array[float],
    cells: wp.array[float],
    cell: int,
    apart: int,
    out: wp.array[float],
    start: int,
):
    """Add to holes what is interpolated for them, where no cell is empty that it is made of.

    Cells must be final: those of two rows below are `shown`, or all are. Returns how many holes are
    left; they are the first of the list then.
    """
    left = int(0)
    for k in range(found):
        i = holes[list + k]
        y = i / pitch
        colour = between(cells, cell, h, w, y, i % pitch)
        if colour[3] < 1.0 or (y + 3 > shown and shown < h):
            holes[list + left] = i
            left += 1
        else:
            part = weight * scale[i]
            for c in range(3):
                out[start + c * apart + i] += part * colour[c]
    return left


@wp.func
def carry_on(
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
    state: wp.vec4i,
    bottom: int,
    begun: int,
    apart: int,
    out: wp.array[float],
    start: int,
):
    """Carry a prototype on along a flow until the rows before `bottom` are shown.

    A state is how many rows of sums there are, the next row of the source, the next one to show,
    and how many holes there are. Returns the next state.
    """
    ring = state[0]
    y = int(state[1])
    shown = int(state[2])
    found = int(state[3])
    while shown < bottom:
        if shown < opens[open + y]:
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
                apart,
                out,
                start,
                cells,
                cell,
                holes,
                list,
                found,
            )
            shown += 1
        else:
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
            y += 1
    return wp.vec4i(ring, y, shown, found)


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
    apart = h * pitch
    state = carry_on(
        textures,
        texture,
        h,
        w,
        pitch,
        residual,
        right,
        down,
        hole,
        weight,
        scale,
        total,
        here,
        cells,
        cell,
        opens,
        open,
        places,
        place,
        steps,
        step,
        holes,
        list,
        wp.vec4i(reach(residual, down, h, pitch, opens, open), 0, 0, 0),
        h,
        begun,
        apart,
        out,
        start,
    )
    if state[3] == 0:
        return 1
    if fill(cells, cell, (h + 1) / 2, (w + 1) / 2) == 0:
        return 0
    mend(holes, list, state[3], h, w, pitch, h, weight, scale, cells, cell, apart, out, start)
    return 1
