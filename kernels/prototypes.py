"""Prototypes moved along flows of the model, each by itself or mixed: CE05, Eq. 2 in one launch.

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
    """Splat all pixels of prototype `m`."""
    area = h * w
    for i in range(area):
        total[here + i] = vec4()
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
def mean(total: vec4, least: float):
    """The mean and a weight of 1 where at least that weight arrived, else nothing."""
    if total[3] >= least:
        return total * (1.0 / total[3])
    return vec4()


@wp.func
def pull(total: wp.array[vec4], fine: int, h: int, w: int, hole: float, finest: int):
    """The level after the one at `fine`: sums over the valid pixels of blocks, and their number."""
    coarse = fine + h * w
    columns = (w + 1) / 2
    for y in range((h + 1) / 2):
        upper = fine + 2 * y * w
        lower = fine + wp.min(2 * y + 1, h - 1) * w
        double = wp.where(2 * y + 1 < h, 1.0, 0.5)
        for x in range(columns):
            left = 2 * x
            right = wp.min(left + 1, w - 1)
            a = total[upper + left]
            b = total[upper + right]
            c = total[lower + left]
            d = total[lower + right]
            if finest == 1:
                a = mean(a, hole)
                b = mean(b, hole)
                c = mean(c, hole)
                d = mean(d, hole)
            share = wp.where(left + 1 < w, double, 0.5 * double)
            total[coarse + y * columns + x] = share * (a + b + c + d)


@wp.func
def between(total: wp.array[vec4], fine: int, h: int, w: int, y: int, x: int):
    """The pixel (x, y) of the level at `fine`, interpolated from the next one."""
    columns = (w + 1) / 2
    x0 = x / 2
    x1 = wp.clamp(x0 + 2 * (x % 2) - 1, 0, columns - 1)
    y0 = fine + h * w + y / 2 * columns
    y1 = fine + h * w + wp.clamp(y / 2 + 2 * (y % 2) - 1, 0, (h - 1) / 2) * columns
    near = 0.75 * total[y0 + x0] + 0.25 * total[y0 + x1]
    far = 0.75 * total[y1 + x0] + 0.25 * total[y1 + x1]
    return 0.75 * near + 0.25 * far


@wp.func
def fill(total: wp.array[vec4], here: int, height: int, width: int, hole: float):
    """Pull-push of all levels but the finest. Returns the number of pixels that are no holes."""
    h = int(height)
    w = int(width)
    at = int(here)
    levels = int(0)
    while h > 1 or w > 1:
        pull(total, at, h, w, hole, wp.where(levels == 0, 1, 0))
        at += h * w
        h = (h + 1) / 2
        w = (w + 1) / 2
        levels += 1
    number = int(total[at][3] + 0.5)
    total[at] = mean(total[at], 0.5)
    for up in range(1, levels):
        h = int(height)
        w = int(width)
        at = int(here)
        for _ in range(levels - up):
            at += h * w
            h = (h + 1) / 2
            w = (w + 1) / 2
        for y in range(h):
            for x in range(w):
                i = at + y * w + x
                if total[i][3] >= 0.5:
                    total[i] = mean(total[i], 0.5)
                else:
                    total[i] = between(total, at, h, w, y, x)
    return number


@wp.func
def put(out: wp.array[float], i: int, colour: vec4):
    for c in range(3):
        out[3 * i + c] = colour[c]


@wp.func
def add(out: wp.array[float], i: int, colour: vec4):
    for c in range(3):
        out[3 * i + c] = out[3 * i + c] + colour[c]


@wp.kernel
def move_prototypes(
    flow: wp.array[vec2],  # (H * W) [px] of the model
    images: wp.array[vec4],  # (M, H * W), weight 1
    fixed: wp.array[vec2],  # (M, H * W) [px] taken off the mean of `flow`
    taps: wp.array[taps_t],  # (M, H * W, 6) pixels of the mean; first -1: there is a row for it
    shares: wp.array[shares_t],  # (M, H * W, 6) their shares
    rows: wp.array[int],  # (M + 1) first row of each prototype
    targets: wp.array[int],  # (rows) what a row is for: a pixel, or from H * W on a cell
    starts: wp.array[int],  # (rows + 1) its first tap
    row_taps: wp.array[int],  # pixels, or from H * W on cells of rows before
    row_shares: wp.array[float],
    used: wp.array[int],  # (n,) prototypes
    pixels: wp.array[int],  # (P,) that are asked for
    scale: wp.array[float],  # (P,) of what is written there
    number: int,  # n
    asked: int,  # P
    height: int,
    width: int,
    size: int,  # of a pyramid
    nodes: int,  # H * W and cells of a prototype
    hole: float,
    workers: int,
    first: int,
    count: int,
    # outputs
    total: wp.array[vec4],  # (workers, size) scratch
    field: wp.array[vec2],  # (workers, nodes) scratch
    moved: wp.array[float],  # (n, P, 3)
    arrived: wp.array[int],  # (n,) 0 where a prototype has nothing but holes
):
    tid = wp.tid()
    if tid >= count:
        return
    here = (first + tid) * size
    there = (first + tid) * nodes
    for i in range(height * width):
        field[there + i] = flow[i]
    for job in range(first + tid, number, workers):
        move(
            used[job],
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
            there,
            total,
            here,
        )
        arrived[job] = asked
        for i in range(asked):
            sum = total[here + pixels[i]]
            if sum[3] >= hole:
                put(moved, job * asked + i, scale[i] * mean(sum, hole))
            else:
                arrived[job] -= 1
        if arrived[job] < asked:
            arrived[job] = fill(total, here, height, width, hole)
            for i in range(asked):
                s = pixels[i]
                if total[here + s][3] < hole:
                    colour = between(total, here, height, width, s / width, s % width)
                    put(moved, job * asked + i, scale[i] * colour)


@wp.kernel
def mix_prototypes(
    flows: wp.array[vec2],  # (frames, H * W) [px] of the model
    images: wp.array[vec4],  # (M, H * W), weight 1
    fixed: wp.array[vec2],  # (M, H * W) [px] taken off the mean of a flow
    taps: wp.array[taps_t],  # (M, H * W, 6) pixels of the mean; first -1: there is a row for it
    shares: wp.array[shares_t],  # (M, H * W, 6) their shares
    rows: wp.array[int],  # (M + 1) first row of each prototype
    targets: wp.array[int],  # (rows) what a row is for: a pixel, or from H * W on a cell
    starts: wp.array[int],  # (rows + 1) its first tap
    row_taps: wp.array[int],  # pixels, or from H * W on cells of rows before
    row_shares: wp.array[float],
    weights: wp.array[float],  # (frames, M); a prototype without weight is not looked at
    pixels: wp.array[int],  # (P,) that are asked for
    frames: int,
    number: int,  # M
    asked: int,  # P
    height: int,
    width: int,
    size: int,  # of a pyramid
    nodes: int,  # H * W and cells of a prototype
    hole: float,
    workers: int,
    first: int,
    count: int,
    # outputs
    total: wp.array[vec4],  # (workers, size) scratch
    field: wp.array[vec2],  # (workers, nodes) scratch
    mixed: wp.array[float],  # (frames, P, 3)
    arrived: wp.array[int],  # (frames,) 0 where a prototype has nothing but holes
):
    tid = wp.tid()
    if tid >= count:
        return
    here = (first + tid) * size
    there = (first + tid) * nodes
    area = height * width
    for job in range(first + tid, frames, workers):
        for i in range(area):
            field[there + i] = flows[job * area + i]
        for i in range(3 * asked):
            mixed[3 * job * asked + i] = 0.0
        arrived[job] = 1
        for m in range(number):
            weight = weights[job * number + m]
            if weight != 0.0:
                move(
                    m,
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
                    there,
                    total,
                    here,
                )
                gaps = int(0)
                for i in range(asked):
                    sum = total[here + pixels[i]]
                    if sum[3] >= hole:
                        add(mixed, job * asked + i, weight * mean(sum, hole))
                    else:
                        gaps += 1
                if gaps > 0:
                    if fill(total, here, height, width, hole) == 0:
                        arrived[job] = 0
                    for i in range(asked):
                        s = pixels[i]
                        if total[here + s][3] < hole:
                            colour = between(total, here, height, width, s / width, s % width)
                            add(mixed, job * asked + i, weight * colour)
