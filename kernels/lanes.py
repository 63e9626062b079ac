"""Vectors of 16 neighbours in a row of a plane, and what kernels do with them lane by lane.

A plane is one channel of a picture in rows padded to whole vectors; a padded row is a pitch. Loops
over lanes become vectors where their bounds are literal and nothing in them minds NaN.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(1.0e8)  # [px] beyond any picture, inside int32
HUGE = wp.constant(1.0e30)
LANES = 16
HALF = 8  # lanes
vec16 = wp.types.vector(length=LANES, dtype=float)
vec8 = wp.types.vector(length=HALF, dtype=float)
ivec16 = wp.types.vector(length=LANES, dtype=int)
uvec16 = wp.types.vector(length=LANES, dtype=wp.uint16)


@wp.func
def get(values: wp.array[float], i: int):
    """The vector of values i ... i + 15."""
    here = wp.array(ptr=values.ptr + wp.uint64(4) * wp.uint64(i), shape=(1,), dtype=vec16)
    return here[0]


@wp.func
def put(values: wp.array[float], i: int, v: vec16):
    here = wp.array(ptr=values.ptr + wp.uint64(4) * wp.uint64(i), shape=(1,), dtype=vec16)
    here[0] = v


@wp.func
def address(values: wp.array[float], i: int):
    """Of values[i]: for loops in which to find those of many arrays would take most of the time."""
    return values.ptr + wp.uint64(4) * wp.uint64(i)


@wp.func
def vector_at(address: wp.uint64):
    here = wp.array(ptr=address, shape=(1,), dtype=vec16)
    return here[0]


@wp.func
def one_at(address: wp.uint64):
    here = wp.array(ptr=address, shape=(1,), dtype=float)
    return here[0]


@wp.func
def place_at(address: wp.uint64):
    here = wp.array(ptr=address, shape=(1,), dtype=int)
    return here[0]


@wp.func
def colour_at(address: wp.uint64):
    """The vector of 4 values there."""
    here = wp.array(ptr=address, shape=(1,), dtype=wp.vec4)
    return here[0]


@wp.func
def add_at(address: wp.uint64, v: vec8):
    """Add to the vector of 8 values there."""
    here = wp.array(ptr=address, shape=(1,), dtype=vec8)
    here[0] = here[0] + v


@wp.func
def get_half(values: wp.array[float], i: int):
    """The vector of values i ... i + 7."""
    here = wp.array(ptr=values.ptr + wp.uint64(4) * wp.uint64(i), shape=(1,), dtype=vec8)
    return here[0]


@wp.func
def put_half(values: wp.array[float], i: int, v: vec8):
    here = wp.array(ptr=values.ptr + wp.uint64(4) * wp.uint64(i), shape=(1,), dtype=vec8)
    here[0] = v


@wp.func
def put_whole(values: wp.array[int], i: int, n: ivec16):
    here = wp.array(ptr=values.ptr + wp.uint64(4) * wp.uint64(i), shape=(1,), dtype=ivec16)
    here[0] = n


@wp.func
def pitch_of(width: int):
    return (width + LANES - 1) / LANES * LANES


@wp.func
def colours(texture: uvec16):
    v = vec16()
    for j in range(LANES):
        v[j] = float(texture[j])
    return v


@wp.func
def within_reach(q: float):
    return wp.where(q < -FAR, -FAR, wp.where(q > FAR, FAR, q))


@wp.func
def whole(q: vec16):
    """floor(q)."""
    n = ivec16()
    for j in range(LANES):
        n[j] = int(wp.floor(within_reach(q[j])))
    return n


@wp.func
def fraction(q: vec16, n: ivec16):
    f = vec16()
    for j in range(LANES):
        f[j] = within_reach(q[j]) - float(n[j])
    return f


@wp.func
def within(v: vec16, number: int):
    """The first so many values, else 0."""
    first = vec16()
    for j in range(LANES):
        first[j] = wp.where(j < number, v[j], 0.0)
    return first


@wp.func
def share_of(n: vec16, least: float):
    """One over the weight where it is enough, else 0."""
    share = vec16()
    for j in range(LANES):
        share[j] = wp.where(n[j] >= least, 1.0 / n[j], 0.0)
    return share


@wp.func
def pairs(left: vec16, right: vec16):
    """Sums of neighbours."""
    v = vec16()
    for j in range(HALF):
        v[j] = left[2 * j] + left[2 * j + 1]
        v[j + HALF] = right[2 * j] + right[2 * j + 1]
    return v
