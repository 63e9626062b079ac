"""Weighted sums of images: 16 values a thread, then what is left over.

Eight terms at a time in float32, which leaves at most eight roundings of theirs, and those sums in
float64, for any number of images. Warp unrolls a loop with literal bounds: half the time.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

LANES = 16
BLOCK = 8  # terms summed in float32
vec16 = wp.types.vector(length=LANES, dtype=wp.float32)
vec16d = wp.types.vector(length=LANES, dtype=wp.float64)


@wp.kernel
def blend(
    images: wp.array2d[vec16],  # (M, S) as rows of S // 16 whole vectors
    weights: wp.array[float],  # (batch, M)
    number: int,  # M
    size: int,  # S
    first: int,
    count: int,
    # outputs
    blended: wp.array2d[vec16],  # (batch, S) as rows of S // 16 whole vectors
):
    tid = wp.tid()
    if tid >= count:
        return
    vectors = size / LANES
    b = (first + tid) / vectors
    v = (first + tid) % vectors
    total = vec16d()
    whole = number - number % BLOCK
    for begin in range(0, whole, BLOCK):
        part = vec16()
        for m in range(BLOCK):
            part += weights[b * number + begin + m] * images[begin + m, v]
        total += vec16d(part)
    rest = vec16()
    for m in range(whole, number):
        rest += weights[b * number + m] * images[m, v]
    blended[b, v] = vec16(total + vec16d(rest))


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
