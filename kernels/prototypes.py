"""Prototypes moved along flows of the model and mixed: CE05, Eq. 2 in one launch.

The flow that is missing to a prototype, carried to its pixels, is a fixed sparse mean of the
model's flow less a fixed flow (see mmmgpu/backends/orientation.py). Along it the pixels are
splatted into an accumulator that belongs to the worker alone. What received too little is filled by
pull-push, of which only the coarse levels and the pixels that are asked for are computed.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(1.0e8)  # [px] beyond any picture, inside int32
vec2 = wp.types.vector(length=2, dtype=float)
vec4 = wp.types.vector(length=4, dtype=float)  # red, green, blue and weight
TAPS = 6
shares_t = wp.types.vector(length=TAPS, dtype=float)
taps_t = wp.types.vector(length=TAPS, dtype=int)


@wp.func
def splat(total: wp.array[vec4], here: int, h: int, w: int, sy: int, sx: int, q: vec2, value: vec4):
    """Add pixel (sx, sy), carried along `q`, to the four pixels around where it arrives."""
    right = wp.floor(q[0])
    down = wp.floor(q[1])
    x = sx + int(wp.clamp(right, -FAR, FAR))
    y = sy + int(wp.clamp(down, -FAR, FAR))
    fx = q[0] - right
    fy = q[1] - down
    gx = 1.0 - fx
    gy = 1.0 - fy
    t = here + y * w + x
    if x >= 0 and x + 1 < w and y >= 0 and y + 1 < h:
        total[t] = total[t] + (gx * gy) * value
        total[t + 1] = total[t + 1] + (fx * gy) * value
        total[t + w] = total[t + w] + (gx * fy) * value
        total[t + w + 1] = total[t + w + 1] + (fx * fy) * value
    else:
        for tap in range(4):
            dx = tap % 2
            dy = tap / 2
            if x + dx >= 0 and x + dx < w and y + dy >= 0 and y + dy < h:
                share = wp.where(dx == 1, fx, gx) * wp.where(dy == 1, fy, gy)
                total[t + dy * w + dx] = total[t + dy * w + dx] + share * value


@wp.func
def move(
    m: int,
    images: wp.array[vec4],
    fixed: wp.array[vec2],
    taps: wp.array[taps_t],
    shares: wp.array[shares_t],
    rows: wp.array[int],
    targets: wp.array[int],
    starts: wp.array[int],
    row_taps: wp.array[int],
    row_shares: wp.array[float],
    h: int,
    w: int,
    field: wp.array[vec2],
    there: int,
    total: wp.array[vec4],
    here: int,
):
    """Splat all pixels of prototype `m`; nothing is in the accumulator."""
    area = h * w
    for y in range(h):
        for x in range(w):
            i = m * area + y * w + x
            k = taps[i]
            if k[0] >= 0:
                share = shares[i]
                near = -fixed[i]
                for tap in range(TAPS):
                    near += share[tap] * field[there + k[tap]]
                splat(total, here, h, w, y, x, near, images[i])
    for row in range(rows[m], rows[m + 1]):
        far = vec2()
        for j in range(starts[row], starts[row + 1]):
            far += row_shares[j] * field[there + row_taps[j]]
        s = targets[row]
        if s < area:
            i = m * area + s
            splat(total, here, h, w, s / w, s % w, far - fixed[i], images[i])
        else:
            field[there + s] = far


@wp.func
def mean(sum: vec4, least: float):
    """The mean and a weight of 1 where at least that weight arrived, else nothing."""
    if sum[3] < least:
        return vec4()
    share = 1.0 / sum[3]
    return vec4(share * sum[0], share * sum[1], share * sum[2], 1.0)


@wp.func
def between(cells: wp.array[vec4], coarse: int, h: int, w: int, y: int, x: int):
    """The pixel (x, y) of a level of h x w, interpolated from the next one, which is complete."""
    columns = (w + 1) / 2
    x0 = x / 2
    x1 = wp.clamp(x0 + 2 * (x % 2) - 1, 0, columns - 1)
    y0 = coarse + y / 2 * columns
    y1 = coarse + wp.clamp(y / 2 + 2 * (y % 2) - 1, 0, (h - 1) / 2) * columns
    near = 0.75 * cells[y0 + x0] + 0.25 * cells[y0 + x1]
    far = 0.75 * cells[y1 + x0] + 0.25 * cells[y1 + x1]
    return 0.75 * near + 0.25 * far


@wp.func
def pull(cells: wp.array[vec4], fine: int, h: int, w: int):
    """The level after the one of h x w at `fine`: sums over blocks of 2 x 2."""
    coarse = fine + h * w
    columns = (w + 1) / 2
    for y in range((h + 1) / 2):
        upper = fine + 2 * y * w
        lower = fine + wp.min(2 * y + 1, h - 1) * w
        double = wp.where(2 * y + 1 < h, 1.0, 0.5)
        for x in range(columns):
            left = 2 * x
            right = wp.min(left + 1, w - 1)
            sum = cells[upper + left] + cells[upper + right]
            sum += cells[lower + left] + cells[lower + right]
            share = wp.where(left + 1 < w, double, 0.5 * double)
            cells[coarse + y * columns + x] = share * sum


@wp.func
def fill(cells: wp.array[vec4], first: int, height: int, width: int):
    """Pull-push of a level of sums and all that follow. Returns the sum of all weights."""
    h = int(height)
    w = int(width)
    at = int(first)
    levels = int(1)
    while h > 1 or w > 1:
        pull(cells, at, h, w)
        at += h * w
        h = (h + 1) / 2
        w = (w + 1) / 2
        levels += 1
    number = int(cells[at][3])
    for up in range(levels):
        h = int(height)
        w = int(width)
        at = int(first)
        for _ in range(levels - 1 - up):
            at += h * w
            h = (h + 1) / 2
            w = (w + 1) / 2
        for y in range(h):
            for x in range(w):
                i = at + y * w + x
                if cells[i][3] > 0.0:
                    cells[i] = mean(cells[i], 1.0)
                elif up > 0:
                    cells[i] = between(cells, at + h * w, h, w, y, x)
    return number


@wp.func
def show(out: wp.array[float], i: int, colour: vec4, more: int):
    """Write a colour, or add it."""
    for c in range(3):
        if more == 1:
            out[3 * i + c] = out[3 * i + c] + colour[c]
        else:
            out[3 * i + c] = colour[c]


@wp.func
def settle(
    total: wp.array[vec4],
    here: int,
    h: int,
    w: int,
    hole: float,
    places: wp.array[int],
    scale: wp.array[float],
    weight: float,
    more: int,
    out: wp.array[float],
    start: int,
    cells: wp.array[vec4],
    first: int,
    holes: wp.array[int],
):
    """Show what arrived, and what is filled, at pixels that have a place; empty the accumulator.

    Returns 0 where nothing arrived.
    """
    columns = (w + 1) / 2
    gaps = int(0)
    for y in range((h + 1) / 2):
        for x in range(columns):
            block = vec4()
            for tap in range(4):
                ty = 2 * y + tap / 2
                tx = 2 * x + tap % 2
                if ty < h and tx < w:
                    i = ty * w + tx
                    colour = mean(total[here + i], hole)
                    total[here + i] = vec4()
                    block += colour
                    if places[i] >= 0:
                        if colour[3] > 0.0:
                            show(out, start + places[i], weight * scale[i] * colour, more)
                        else:
                            holes[here + gaps] = i
                            gaps += 1
            cells[first + y * columns + x] = block
    if gaps == 0:
        return 1
    number = fill(cells, first, (h + 1) / 2, columns)
    for j in range(gaps):
        i = holes[here + j]
        colour = between(cells, first, h, w, i / w, i % w)
        show(out, start + places[i], weight * scale[i] * colour, more)
    return number


@wp.kernel
def mix_prototypes(
    flows: wp.array[vec2],  # (frames, H * W) [px] of the model, frames is 1 or the mixtures
    images: wp.array[vec4],  # (M, H * W), weight 1
    fixed: wp.array[vec2],  # (M, H * W) [px] taken off the mean of a flow
    taps: wp.array[taps_t],  # (M, H * W, 6) pixels of the mean; first -1: there is a row for it
    shares: wp.array[shares_t],  # (M, H * W, 6) their shares
    rows: wp.array[int],  # (M + 1) first row of each prototype
    targets: wp.array[int],  # (rows) what a row is for: a pixel, or from H * W on a cell
    starts: wp.array[int],  # (rows + 1) its first tap
    row_taps: wp.array[int],  # pixels, or from H * W on cells of rows before
    row_shares: wp.array[float],
    parts: wp.array[int],  # (mixtures + 1) first member of each mixture
    members: wp.array[int],  # (parts[mixtures]) prototypes
    weights: wp.array[float],  # (parts[mixtures]) their weights
    places: wp.array[int],  # (H * W) where a pixel is written, -1 for nowhere
    scale: wp.array[float],  # (H * W) of what is written
    frames: int,
    mixtures: int,
    asked: int,  # P places
    height: int,
    width: int,
    size: int,  # of a pyramid without its finest level
    nodes: int,  # H * W and cells of a prototype
    hole: float,
    workers: int,
    first: int,
    count: int,
    # outputs
    total: wp.array[vec4],  # (workers, H * W) scratch
    cells: wp.array[vec4],  # (workers, size) scratch
    holes: wp.array[int],  # (workers, H * W) scratch
    field: wp.array[vec2],  # (workers, nodes) scratch
    mixed: wp.array[float],  # (mixtures, P, 3)
    arrived: wp.array[int],  # (mixtures,) 0 where a prototype has nothing but holes
):
    tid = wp.tid()
    if tid >= count:
        return
    worker = first + tid
    area = height * width
    for i in range(area):
        total[worker * area + i] = vec4()
    for job in range(worker, mixtures, workers):
        if frames > 1 or job == worker:
            for i in range(area):
                field[worker * nodes + i] = flows[job % frames * area + i]
        arrived[job] = 1
        if parts[job] == parts[job + 1]:
            for i in range(3 * asked):
                mixed[3 * job * asked + i] = 0.0
        for part in range(parts[job], parts[job + 1]):
            move(
                members[part],
                images,
                fixed,
                taps,
                shares,
                rows,
                targets,
                starts,
                row_taps,
                row_shares,
                height,
                width,
                field,
                worker * nodes,
                total,
                worker * area,
            )
            number = settle(
                total,
                worker * area,
                height,
                width,
                hole,
                places,
                scale,
                weights[part],
                wp.where(part > parts[job], 1, 0),
                mixed,
                job * asked,
                cells,
                worker * size,
                holes,
            )
            arrived[job] = wp.min(arrived[job], number)
