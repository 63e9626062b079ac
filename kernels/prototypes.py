"""Prototypes moved along flows of the model and mixed: CE05, Eq. 2 in one launch.

The flow that is missing to a prototype, carried to its pixels, is a fixed sparse mean of the
model's flow less a fixed flow (see mmmgpu/backends/orientation.py). Along it the pixels are
splatted into an accumulator that belongs to the worker alone. What received too little is filled by
pull-push, where such a pixel is asked for.

Everything is done for 16 neighbours of a row at a time: those of them that move by the same whole
number of pixels are neighbours again where they arrive. So pictures are planes, one a channel, and
their rows are padded to whole vectors; a padded row is a pitch.
"""

import warp as wp

from mmmgpu.kernels.lanes import (
    HUGE,
    LANES,
    LAST,
    colours,
    fraction,
    get,
    inside,
    ivec16,
    least,
    one_later,
    pitch_of,
    put,
    share_of,
    uvec16,
    vec16,
    whole,
)
from mmmgpu.kernels.pyramid import fill

wp.set_module_options({"enable_backward": False})

NONE = wp.constant(2147483647)  # where a pixel that arrives nowhere goes
WHITE = wp.constant(65535.0)  # the brightest value of a texture


@wp.func
def starts_of(x: ivec16, y: ivec16, h: int, w: int, pitch: int):
    """Where the vector begins with which each pixel arrives at (x, y)."""
    start = ivec16()
    for j in range(LANES):
        across = wp.uint32(x[j] + 1) <= wp.uint32(w)
        down = wp.uint32(y[j] + 1) <= wp.uint32(h)
        start[j] = wp.where(across and down, y[j] * pitch + x[j] - j, NONE)
    return start


@wp.func
def going_to(start: ivec16, here: int):
    """1 for the pixels that go there, else 0."""
    v = vec16()
    for j in range(LANES):
        v[j] = wp.where(start[j] == here, 1.0, 0.0)
    return v


@wp.func
def others(start: ivec16, here: int):
    left = ivec16()
    for j in range(LANES):
        left[j] = wp.where(start[j] == here, NONE, start[j])
    return left


@wp.func
def add_rows(
    total: wp.array[float],
    t: int,
    pitch: int,
    upper_left: vec16,
    upper_right: vec16,
    lower_left: vec16,
    lower_right: vec16,
):
    put(total, t, get(total, t) + (upper_left + one_later(upper_right)))
    put(total, t + pitch, get(total, t + pitch) + (lower_left + one_later(lower_right)))


@wp.func
def add_plane(
    total: wp.array[float],
    t: int,
    pitch: int,
    value: vec16,
    upper_left: vec16,
    upper_right: vec16,
    lower_left: vec16,
    lower_right: vec16,
):
    """Add one channel of a vector to the two rows on which it arrives."""
    add_rows(
        total,
        t,
        pitch,
        wp.cw_mul(upper_left, value),
        wp.cw_mul(upper_right, value),
        wp.cw_mul(lower_left, value),
        wp.cw_mul(lower_right, value),
    )


@wp.func
def add_last(total: wp.array[float], t: int, pitch: int, upper: float, lower: float):
    """Add what the last pixel of a vector gives to the column right of it."""
    total[t] = total[t] + upper
    total[t + pitch] = total[t + pitch] + lower


@wp.func
def orient(
    m: int,
    fixed: wp.array[float],
    firsts: wp.array[int],
    deltas: wp.array[int],
    shares: wp.array[vec16],
    rows: wp.array[int],
    targets: wp.array[int],
    starts: wp.array[int],
    row_taps: wp.array[int],
    row_shares: wp.array[float],
    area: int,
    nodes: int,
    field: wp.array[float],
    there: int,
    residual: wp.array[float],
    here: int,
):
    """The flow that is missing to prototype `m`, for each of its pixels."""
    vectors = area / LANES
    for v in range(vectors):
        i = LANES * v
        x = -get(fixed, 2 * m * area + i)
        y = -get(fixed, (2 * m + 1) * area + i)
        for k in range(firsts[m * vectors + v], firsts[m * vectors + v + 1]):
            at = there + i + deltas[k]
            x += wp.cw_mul(shares[k], get(field, at))
            y += wp.cw_mul(shares[k], get(field, at + nodes))
        put(residual, here + i, x)
        put(residual, here + area + i, y)
    for row in range(rows[m], rows[m + 1]):
        right = float(0.0)
        down = float(0.0)
        for j in range(starts[row], starts[row + 1]):
            at = there + row_taps[j]
            right += row_shares[j] * field[at]
            down += row_shares[j] * field[at + nodes]
        s = targets[row]
        if s < area:
            residual[here + s] = right - fixed[2 * m * area + s]
            residual[here + area + s] = down - fixed[(2 * m + 1) * area + s]
        else:
            field[there + s] = right
            field[there + nodes + s] = down


@wp.func
def splat(
    m: int,
    textures: wp.array[uvec16],
    h: int,
    w: int,
    pitch: int,
    residual: wp.array[float],
    there: int,
    total: wp.array[float],
    here: int,
    step: int,
):
    """Carry the pixels of prototype `m`, each to the four around where it arrives."""
    area = h * pitch
    lane = ivec16()
    for j in range(LANES):
        lane[j] = j
    one = vec16(1.0)
    for v in range(area / LANES):
        i = LANES * v
        qx = get(residual, there + i)
        qy = get(residual, there + area + i)
        right = whole(qx)
        down = whole(qy)
        fx = fraction(qx, right)
        fy = fraction(qy, down)
        x = right + lane + ivec16(i % pitch)
        y = down + ivec16(i / pitch)
        gx = inside(one - fx, x, w)
        fx = inside(fx, x + ivec16(1), w)
        gy = inside(one - fy, y, h)
        fy = inside(fy, y + ivec16(1), h)
        upper_left = wp.cw_mul(gx, gy)
        upper_right = wp.cw_mul(fx, gy)
        lower_left = wp.cw_mul(gx, fy)
        lower_right = wp.cw_mul(fx, fy)
        red = colours(textures[(3 * m * area + i) / LANES])
        green = colours(textures[((3 * m + 1) * area + i) / LANES])
        blue = colours(textures[((3 * m + 2) * area + i) / LANES])
        start = starts_of(x, y, h, w, pitch)
        if start[LAST] != NONE:
            t = here + start[LAST] + LANES
            a = upper_right[LAST]
            b = lower_right[LAST]
            add_last(total, t, pitch, a * red[LAST], b * red[LAST])
            add_last(total, t + step, pitch, a * green[LAST], b * green[LAST])
            add_last(total, t + 2 * step, pitch, a * blue[LAST], b * blue[LAST])
            add_last(total, t + 3 * step, pitch, a, b)
        first = least(start)
        while first != NONE:
            same = going_to(start, first)
            a00 = wp.cw_mul(same, upper_left)
            a10 = wp.cw_mul(same, upper_right)
            a01 = wp.cw_mul(same, lower_left)
            a11 = wp.cw_mul(same, lower_right)
            t = here + first
            add_plane(total, t, pitch, red, a00, a10, a01, a11)
            add_plane(total, t + step, pitch, green, a00, a10, a01, a11)
            add_plane(total, t + 2 * step, pitch, blue, a00, a10, a01, a11)
            add_rows(total, t + 3 * step, pitch, a00, a10, a01, a11)
            start = others(start, first)
            first = least(start)


@wp.func
def least_asked(total: wp.array[float], weight: int, area: int, scale: wp.array[float]):
    """The least weight at a pixel that is asked for."""
    low = vec16(HUGE)
    for i in range(0, area, LANES):
        s = get(scale, i)
        n = get(total, weight + i)
        for j in range(LANES):
            low[j] = wp.where(s[j] > 0.0 and n[j] < low[j], n[j], low[j])
    return wp.min(low)


@wp.func
def normalise(total: wp.array[float], here: int, step: int, area: int, hole: float):
    """From sums to means and a weight of 1, and nothing in holes."""
    for i in range(0, area, LANES):
        n = get(total, here + 3 * step + i)
        share = share_of(n, hole)
        for c in range(4):
            at = here + c * step + i
            put(total, at, wp.cw_mul(share, get(total, at)))


@wp.func
def show(
    total: wp.array[float],
    here: int,
    step: int,
    area: int,
    hole: float,
    weight: float,
    scale: wp.array[float],
    more: int,
    out: wp.array[float],
    start: int,
):
    """Write the means, or add them, and empty the accumulator."""
    for i in range(0, area, LANES):
        n = get(total, here + 3 * step + i)
        share = weight * wp.cw_mul(get(scale, i), share_of(n, hole))
        for c in range(3):
            at = here + c * step + i
            colour = wp.cw_mul(share, get(total, at))
            if more == 1:
                colour += get(out, start + c * area + i)
            put(out, start + c * area + i, colour)
            put(total, at, vec16())
        put(total, here + 3 * step + i, vec16())


@wp.kernel
def mix_prototypes(
    flows: wp.array[float],  # (frames, 2, H, pitch) [px] of the model; frames: 1 or the mixtures
    textures: wp.array[uvec16],  # (M, 3, H, pitch) of 65535
    fixed: wp.array[float],  # (M, 2, H, pitch) [px] taken off the mean of a flow
    firsts: wp.array[int],  # (M * H * pitch / 16 + 1) first part of each vector's means
    deltas: wp.array[int],  # (parts) how much further on in the flow a part lies
    shares: wp.array[vec16],  # (parts) the pixels' shares in it
    rows: wp.array[int],  # (M + 1) first row of each prototype
    targets: wp.array[int],  # (rows) what a row is for: a pixel, or from H * pitch + 16 on a cell
    starts: wp.array[int],  # (rows + 1) its first tap
    row_taps: wp.array[int],  # pixels or cells, of rows before
    row_shares: wp.array[float],
    parts: wp.array[int],  # (mixtures + 1) first member of each mixture
    members: wp.array[int],  # (parts[mixtures]) prototypes
    weights: wp.array[float],  # (parts[mixtures]) their weights
    scale: wp.array[float],  # (H, pitch) of what is written; 0 where nothing is asked for
    frames: int,
    mixtures: int,
    height: int,
    width: int,
    size: int,  # of a pyramid without its finest level
    nodes: int,  # 16, pixels, 16, and cells of a prototype
    hole: float,
    workers: int,
    first: int,
    count: int,
    # outputs
    total: wp.array[float],  # (workers, 4, H * pitch + 2 (pitch + 32)) scratch: sums
    cells: wp.array[float],  # (workers, 4 size) scratch
    field: wp.array[float],  # (workers, 2, nodes) scratch
    residual: wp.array[float],  # (workers, 2, H, pitch) scratch
    mixed: wp.array[float],  # (mixtures, 3, H, pitch)
    arrived: wp.array[int],  # (mixtures,) 0 where a prototype has nothing but holes
):
    tid = wp.tid()
    if tid >= count:
        return
    worker = first + tid
    pitch = pitch_of(width)
    area = height * pitch
    step = area + 2 * (pitch + 2 * LANES)
    for i in range(0, 4 * step, LANES):
        put(total, 4 * worker * step + i, vec16())
    for i in range(2 * nodes):
        field[2 * worker * nodes + i] = 0.0
    here = 4 * worker * step + pitch + 2 * LANES
    there = 2 * worker * nodes + LANES
    for job in range(worker, mixtures, workers):
        if frames > 1 or job == worker:
            for i in range(0, area, LANES):
                x = 2 * (job % frames) * area + i
                put(field, there + i, get(flows, x))
                put(field, there + nodes + i, get(flows, x + area))
        arrived[job] = 1
        if parts[job] == parts[job + 1]:
            for i in range(0, 3 * area, LANES):
                put(mixed, 3 * job * area + i, vec16())
        for part in range(parts[job], parts[job + 1]):
            orient(
                members[part],
                fixed,
                firsts,
                deltas,
                shares,
                rows,
                targets,
                starts,
                row_taps,
                row_shares,
                area,
                nodes,
                field,
                there,
                residual,
                2 * worker * area,
            )
            splat(
                members[part],
                textures,
                height,
                width,
                pitch,
                residual,
                2 * worker * area,
                total,
                here,
                step,
            )
            if least_asked(total, here + 3 * step, area, scale) < hole:
                normalise(total, here, step, area, hole)
                some = fill(total, here, step, height, width, scale, cells, 4 * worker * size)
                arrived[job] = wp.min(arrived[job], some)
            more = wp.where(part > parts[job], 1, 0)
            out = 3 * job * area
            show(total, here, step, area, hole, weights[part] / WHITE, scale, more, mixed, out)
