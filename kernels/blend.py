"""Weighted sums of images: 64 values of one result or 16 of four a thread, then what is left over.

Eight terms at a time in float32, which leaves at most eight roundings of theirs, and those sums in
float64, for any number of images. Warp unrolls a loop with literal bounds: half the time.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

LANES = 16
BLOCK = 8  # terms summed in float32
VECTORS = wp.constant(4)  # of one result
TOGETHER = 4  # results for which each image is read once
vec16 = wp.types.vector(length=LANES, dtype=wp.float32)
vec16d = wp.types.vector(length=LANES, dtype=wp.float64)


@wp.kernel
def blend(
    images: wp.array2d[vec16],  # (M, S) as rows of S // 16 whole vectors
    weights: wp.array[float],  # (1, M)
    number: int,  # M
    size: int,  # S
    first: int,
    count: int,
    # outputs
    blended: wp.array2d[vec16],  # (1, S) as S // 16 whole vectors
):
    tid = wp.tid()
    if tid >= count:
        return
    start = VECTORS * (first + tid)
    whole = number - number % BLOCK
    for v in range(start, wp.min(start + VECTORS, size / LANES)):
        total = vec16d()
        for begin in range(0, whole, BLOCK):
            part = vec16()
            for m in range(BLOCK):
                part += weights[begin + m] * images[begin + m, v]
            total += vec16d(part)
        rest = vec16()
        for m in range(whole, number):
            rest += weights[m] * images[m, v]
        blended[0, v] = vec16(total + vec16d(rest))


@wp.kernel
def blend_together(
    images: wp.array2d[vec16],  # (M, S) as rows of S // 16 whole vectors
    weights: wp.array[float],  # (batch, M)
    number: int,  # M
    size: int,  # S
    batch: int,
    first: int,
    count: int,
    # outputs
    blended: wp.array2d[vec16],  # (batch, S) as rows of S // 16 whole vectors
):
    tid = wp.tid()
    if tid >= count:
        return
    vectors = size / LANES
    v = (first + tid) % vectors
    b0 = (first + tid) / vectors * TOGETHER
    b1 = wp.min(b0 + 1, batch - 1)  # the last one again, where there are fewer
    b2 = wp.min(b0 + 2, batch - 1)
    b3 = wp.min(b0 + 3, batch - 1)
    total0 = vec16d()
    total1 = vec16d()
    total2 = vec16d()
    total3 = vec16d()
    whole = number - number % BLOCK
    for begin in range(0, whole, BLOCK):
        part0 = vec16()
        part1 = vec16()
        part2 = vec16()
        part3 = vec16()
        for m in range(BLOCK):
            values = images[begin + m, v]
            part0 += weights[b0 * number + begin + m] * values
            part1 += weights[b1 * number + begin + m] * values
            part2 += weights[b2 * number + begin + m] * values
            part3 += weights[b3 * number + begin + m] * values
        total0 += vec16d(part0)
        total1 += vec16d(part1)
        total2 += vec16d(part2)
        total3 += vec16d(part3)
    rest0 = vec16()
    rest1 = vec16()
    rest2 = vec16()
    rest3 = vec16()
    for m in range(whole, number):
        values = images[m, v]
        rest0 += weights[b0 * number + m] * values
        rest1 += weights[b1 * number + m] * values
        rest2 += weights[b2 * number + m] * values
        rest3 += weights[b3 * number + m] * values
    blended[b0, v] = vec16(total0 + vec16d(rest0))
    blended[b1, v] = vec16(total1 + vec16d(rest1))
    blended[b2, v] = vec16(total2 + vec16d(rest2))
    blended[b3, v] = vec16(total3 + vec16d(rest3))


@wp.kernel
def blend_rest(
    images: wp.array[float],  # (M, S)
    weights: wp.array[float],  # (batch, M)
    number: int,  # M
    size: int,  # S
    first: int,
    count: int,
    # outputs
    blended: wp.array[float],  # (batch, S), the last S % 16 of each row are written
):
    tid = wp.tid()
    if tid >= count:
        return
    rest = size % LANES
    b = (first + tid) / rest
    p = size - rest + (first + tid) % rest
    total = wp.float64(0.0)
    for m in range(number):
        total += wp.float64(weights[b * number + m]) * wp.float64(images[m * size + p])
    blended[b * size + p] = float(total)
