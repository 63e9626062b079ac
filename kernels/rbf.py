"""A map made of Gaussians and an affine part (CE05, Eq. 6): 16 points a thread.

Gaussians in float32, sums in float64. Gaussians of eight terms come first, and then their sums: the
compiler makes vectors of four of all that leads to float64. In the last thread lanes beyond the
points do the last point again, and are not written.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

LANES = 16
BLOCK = 8
FAR = wp.constant(3.0e38)  # squares beyond float32 stay finite: 0 times them is 0
LEAST = wp.constant(-126.0)  # 2 to it is nothing, but no denormal number
ROUND = wp.constant(12582912.0)  # 1.5 2^23: added to a number, it leaves the nearest whole one
LOG2_E = wp.constant(1.44269504)
vec16 = wp.types.vector(length=LANES, dtype=wp.float32)
vec16d = wp.types.vector(length=LANES, dtype=wp.float64)
vec16i = wp.types.vector(length=LANES, dtype=wp.int32)
block16 = wp.types.matrix(shape=(BLOCK, LANES), dtype=wp.float32)


@wp.func
def decay(x: vec16):
    """2^x for x <= 0, within 2e-7 of it: 2^n 2^r, |r| <= 1/2, the best polynomial with 2^0 = 1."""
    within = wp.max(x, vec16(LEAST))
    shifted = within + vec16(ROUND)
    r = within - (shifted - vec16(ROUND))
    p = 1.3264726e-3 * r + vec16(9.6715130e-3)
    p = wp.cw_mul(p, r) + vec16(5.5507336e-2)
    p = wp.cw_mul(p, r) + vec16(2.4022242e-1)
    p = wp.cw_mul(p, r) + vec16(6.9314700e-1)
    p = wp.cw_mul(p, r) + vec16(1.0)
    power = wp.cast(shifted, vec16i) * 8388608  # 2^23: what ROUND adds is shifted out
    return wp.cast(wp.cast(p, vec16i) + power, vec16)


@wp.kernel
def evaluate_rbf(
    points: wp.array[float],  # (P, 2) = (x, y) [px]
    centres: wp.array[float],  # (N, 2) [px]
    weights: wp.array[float],  # (N, 2) [px]
    affine: wp.array[float],  # (2, 3), columns for 1, x and y
    number: int,  # P
    terms: int,  # N
    sharpness: float,  # [1/px^2]
    first: int,
    count: int,
    # outputs
    mapped: wp.array[float],  # (P, 2) [px]
):
    tid = wp.tid()
    if tid >= count:
        return
    start = (first + tid) * LANES
    x = vec16()
    y = vec16()
    for lane in range(LANES):
        p = wp.min(start + lane, number - 1)
        x[lane] = points[2 * p]
        y[lane] = points[2 * p + 1]
    u = vec16d(wp.float64(affine[0]))
    u += wp.float64(affine[1]) * vec16d(x) + wp.float64(affine[2]) * vec16d(y)
    v = vec16d(wp.float64(affine[3]))
    v += wp.float64(affine[4]) * vec16d(x) + wp.float64(affine[5]) * vec16d(y)
    falling = -LOG2_E * sharpness
    phi = block16()
    for begin in range(0, terms, BLOCK):
        some = wp.min(BLOCK, terms - begin)
        for i in range(some):
            dx = x - vec16(centres[2 * (begin + i)])
            dy = y - vec16(centres[2 * (begin + i) + 1])
            square = wp.min(wp.cw_mul(dx, dx) + wp.cw_mul(dy, dy), vec16(FAR))
            phi[i] = decay(falling * square)
        for i in range(some):
            wide = vec16d(phi[i])
            u += wp.float64(weights[2 * (begin + i)]) * wide
            v += wp.float64(weights[2 * (begin + i) + 1]) * wide
    for lane in range(wp.min(LANES, number - start)):
        mapped[2 * (start + lane)] = float(u[lane])
        mapped[2 * (start + lane) + 1] = float(v[lane])
