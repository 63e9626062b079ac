"""Normal equations of prototypes moved along a flow, of which no picture is kept.

All prototypes go on together, a band of rows at a time, each with its own residual flow, ring of
sums and pyramid (see orientation, carrying). Holes that need more of the pyramid than there is then
are set aside, in all prototypes, until the pyramids are complete. `normal_equations.multiply` gets
the bands, and then these pixels.
"""

import warp as wp

from mmmgpu.kernels.carrying import carry_on, mend
from mmmgpu.kernels.lanes import LANES, get, ivec16, pitch_of, put, uvec16, vec16
from mmmgpu.kernels.orientation import orient
from mmmgpu.kernels.pyramid import between, fill
from mmmgpu.kernels.rings import COLOUR, MARGIN, reach

wp.set_module_options({"enable_backward": False})

WHITE = wp.constant(65535.0)  # the brightest value of a texture


@wp.kernel
def advance(
    flow: wp.array[float],  # (2, H, pitch) [px] between 16 numbers
    textures: wp.array[uvec16],  # from here to row_shares as in prototypes
    own: wp.array[float],
    shares: wp.array[float],
    firsts: wp.array[int],
    neighbours: wp.array[wp.vec3i],
    rows: wp.array[int],
    targets: wp.array[int],
    starts: wp.array[int],
    row_taps: wp.array[int],
    row_shares: wp.array[float],
    used: wp.array[int],  # (N) prototypes
    scale: wp.array[float],  # (H, pitch) of what is shown; 0 where nothing is asked for
    height: int,
    width: int,
    size: int,  # of a pyramid without its finest level
    ring: int,  # rows of sums that there is room for
    nodes: int,  # pixels and cells of a prototype
    hole: float,
    depth: int,  # rows of the highest band
    top: int,
    bottom: int,
    first: int,
    count: int,
    # outputs
    residual: wp.array[float],  # (N, 2, nodes) [px]
    opens: wp.array[int],  # (N, H + 1) see rings.reach
    states: wp.array[wp.vec4i],  # (N) see carrying.carry_on; of holes those that are left
    total: wp.array[float],  # (N, ring, pitch + 40, 4) scratch: sums
    cells: wp.array[float],  # (N, 4 size) the pyramids
    places: wp.array[int],  # (N, 2, pitch) scratch
    steps: wp.array[float],  # (N, 7, pitch) scratch
    holes: wp.array[int],  # (N, H, pitch) the holes that there are still
    flags: wp.array[float],  # (H, pitch) 1 where one of the prototypes has one
    band: wp.array[float],  # (N, 3, depth, pitch) of which each has 3 (bottom - top) rows
):
    """Each prototype, until the rows before `bottom` are shown.

    Before the first band, its residual flow is found. One that needs more rows of sums than there
    is room for only says so in its state.
    """
    tid = wp.tid()
    if tid >= count:
        return
    p = first + tid
    pitch = pitch_of(width)
    across = pitch_of((width + 1) / 2)
    area = height * pitch
    apart = (bottom - top) * pitch
    row = COLOUR * (pitch + MARGIN)
    here = p * ring * row
    cell = 4 * p * size
    missing = 2 * p * nodes
    open = p * (height + 1)
    start = (3 * p * depth - top) * pitch
    if top == 0:
        orient(
            used[p],
            own,
            shares,
            firsts,
            neighbours,
            rows,
            targets,
            starts,
            row_taps,
            row_shares,
            area,
            pitch,
            nodes,
            1,
            flow,
            LANES,
            residual,
            missing,
        )
        needed = reach(residual, missing + nodes, height, pitch, opens, open)
        states[p] = wp.vec4i(needed, 0, 0, 0)
        for i in range(0, 4 * ((height + 1) / 2) * across, LANES):  # the first level; see add_pairs
            put(cells, cell + i, vec16())
    before = states[p]
    found = before[3]
    if before[0] > ring:  # the host will make more room
        return
    if top == 0:
        for i in range(0, before[0] * row, LANES):
            put(total, here + i, vec16())
    now = carry_on(
        textures,
        COLOUR * used[p] * area / LANES,
        height,
        width,
        pitch,
        residual,
        missing,
        missing + nodes,
        hole,
        1.0 / WHITE,
        scale,
        total,
        here,
        cells,
        cell,
        opens,
        open,
        places,
        2 * p * pitch,
        steps,
        7 * p * pitch,
        holes,
        p * area,
        before,
        bottom,
        0,
        apart,
        band,
        start,
    )
    left = mend(
        holes,
        p * area + found,
        now[3] - found,
        height,
        width,
        pitch,
        bottom,
        1.0 / WHITE,
        scale,
        cells,
        cell,
        apart,
        band,
        start,
    )
    for k in range(found, found + left):
        flags[holes[p * area + k]] = 1.0
    states[p] = wp.vec4i(now[0], now[1], now[2], found + left)


@wp.func
def take(
    pictures: wp.array[float],
    start: int,
    apart: int,
    lanes: ivec16,
    number: int,
    aside: wp.array[float],
    to: int,
):
    """Move pixels of a vector aside: of one picture, of which the band has three planes `apart`."""
    for k in range(number):
        for c in range(3):
            i = start + c * apart + lanes[k]
            aside[to + 3 * k + c] = pictures[i]
            pictures[i] = 0.0


@wp.kernel
def set_aside(
    flags: wp.array[float],
    wanted: wp.array[float],  # (3, H, pitch)
    number: int,
    height: int,
    width: int,
    depth: int,
    room: int,  # pixels that can be set aside
    top: int,
    bottom: int,
    first: int,
    count: int,  # bottom - top rows
    # outputs
    band: wp.array[float],  # 0 in their places
    band_wanted: wp.array[float],  # (3, bottom - top, pitch)
    aside: wp.array[float],  # (N, room, 3)
    aside_wanted: wp.array[float],  # (room, 3)
    slots: wp.array[int],  # (H, pitch) where a pixel is set aside
    ends: wp.array[int],  # (H + 1) pixels that are set aside before each row; the first is 0
):
    """A row of what is wanted; and of all pictures, its pixels that are a hole in one of them.

    Those that there is no room for are only counted, and stay in the band.
    """
    tid = wp.tid()
    if tid >= count:
        return
    y = first + tid
    pitch = pitch_of(width)
    apart = (bottom - top) * pitch
    here = y * pitch
    for c in range(3):
        for x in range(0, pitch, LANES):
            row = get(wanted, (c * height + top) * pitch + here + x)
            put(band_wanted, c * apart + here + x, row)
    before = vec16()
    for i in range(0, here, LANES):
        before += get(flags, top * pitch + i)
    slot = ends[top] + int(wp.dot(before, vec16(1.0)))
    for x in range(0, pitch, LANES):
        marks = get(flags, top * pitch + here + x)
        if wp.dot(marks, vec16(1.0)) > 0.0:
            lanes = ivec16()
            some = int(0)
            for j in range(LANES):
                if marks[j] > 0.0:
                    slots[top * pitch + here + x + j] = slot + some
                    lanes[some] = j
                    some += 1
            if slot + some <= room:
                for p in range(number):
                    start = 3 * p * depth * pitch + here + x
                    take(band, start, apart, lanes, some, aside, 3 * (p * room + slot))
                take(band_wanted, here + x, apart, lanes, some, aside_wanted, 3 * slot)
            slot += some
    ends[top + y + 1] = slot


@wp.kernel
def finish(
    holes: wp.array[int],
    slots: wp.array[int],
    scale: wp.array[float],
    states: wp.array[wp.vec4i],
    height: int,
    width: int,
    size: int,
    room: int,
    first: int,
    count: int,
    # outputs
    cells: wp.array[float],
    aside: wp.array[float],
    arrived: wp.array[int],  # (N) 0 where a prototype has nothing but holes
):
    """Fill the holes of each prototype, where they are set aside."""
    tid = wp.tid()
    if tid >= count:
        return
    p = first + tid
    pitch = pitch_of(width)
    found = states[p][3]
    arrived[p] = 1
    if found > 0:
        arrived[p] = fill(cells, 4 * p * size, (height + 1) / 2, (width + 1) / 2)
    if arrived[p] == 1:
        for k in range(found):
            i = holes[p * height * pitch + k]
            colour = between(cells, 4 * p * size, height, width, i / pitch, i % pitch)
            for c in range(3):
                aside[3 * (p * room + slots[i]) + c] = scale[i] / WHITE * colour[c]
