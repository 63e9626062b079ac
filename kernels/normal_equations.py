"""Inner products of images with each other and with one more: a Gram matrix, and beside it the
right-hand side of a least-squares fit.

`multiply` adds up a piece of all images, for blocks of 4 x 4 products, of which 4 x 2 share their
loads: in float32, 16 lanes of 64 terms. What is wanted stands after the last image. `add_up` adds
the pieces in float64.
"""

import warp as wp

from mmmgpu.kernels.lanes import LANES, address, one_at, vec16, vector_at

wp.set_module_options({"enable_backward": False})

PIECE = wp.constant(1024)  # values: of 50 images they fit into L2, of eight into L1
ROWS = wp.constant(4)  # of a block


@wp.func
def image_at(
    images: wp.array[float], wanted: wp.array[float], r: int, number: int, stride: int, start: int
):
    """The address of an image, or of what is wanted, from value `start` on."""
    image = address(images, wp.min(r, number - 1) * stride + start)
    return wp.where(r < number, image, address(wanted, start))


@wp.func
def store(
    parts: wp.array[float],
    start: int,
    r: int,
    c: int,
    number: int,
    total: vec16,
    a: wp.uint64,
    b: wp.uint64,
    whole: int,
    length: int,
):
    """A product: its 16 sums, and what is left over after the last whole vector."""
    product = wp.dot(total, vec16(1.0))
    for i in range(whole, length):
        product += one_at(a + wp.uint64(4 * i)) * one_at(b + wp.uint64(4 * i))
    if r <= number and c < number:
        parts[start + r * number + c] = product


@wp.kernel
def multiply(
    images: wp.array[float],  # (M, stride)
    wanted: wp.array[float],  # (S,)
    number: int,  # M
    stride: int,  # values from one image to the next
    size: int,  # S
    before: int,  # pieces that are multiplied already
    first: int,
    count: int,
    # outputs
    parts: wp.array[float],  # (pieces, M + 1, M), where the row is not before the column
):
    tid = wp.tid()
    if tid >= count:
        return
    blocks = number / ROWS + 1
    pairs = blocks * (blocks + 1) / 2
    piece = (first + tid) / pairs
    column = (first + tid) % pairs  # of the triangle of blocks, row after row
    row = int(0)
    while column > row:
        row += 1
        column -= row
    begin = piece * PIECE
    length = wp.min(PIECE, size - begin)
    whole = length - length % LANES
    end = wp.uint64(4 * whole)
    start = (before + piece) * (number + 1) * number
    r = ROWS * row
    a0 = image_at(images, wanted, r, number, stride, begin)
    a1 = image_at(images, wanted, r + 1, number, stride, begin)
    a2 = image_at(images, wanted, r + 2, number, stride, begin)
    a3 = image_at(images, wanted, r + 3, number, stride, begin)
    for c in range(ROWS * column, wp.min(ROWS * column + ROWS, number), 2):
        b0 = image_at(images, wanted, c, number, stride, begin)
        b1 = image_at(images, wanted, c + 1, number, stride, begin)
        total00 = vec16()
        total10 = vec16()
        total20 = vec16()
        total30 = vec16()
        total01 = vec16()
        total11 = vec16()
        total21 = vec16()
        total31 = vec16()
        i = wp.uint64(0)
        while i < end:
            x0 = vector_at(a0 + i)
            x1 = vector_at(a1 + i)
            x2 = vector_at(a2 + i)
            x3 = vector_at(a3 + i)
            y0 = vector_at(b0 + i)
            total00 += wp.cw_mul(x0, y0)
            total10 += wp.cw_mul(x1, y0)
            total20 += wp.cw_mul(x2, y0)
            total30 += wp.cw_mul(x3, y0)
            y1 = vector_at(b1 + i)
            total01 += wp.cw_mul(x0, y1)
            total11 += wp.cw_mul(x1, y1)
            total21 += wp.cw_mul(x2, y1)
            total31 += wp.cw_mul(x3, y1)
            i += wp.uint64(4 * LANES)
        store(parts, start, r, c, number, total00, a0, b0, whole, length)
        store(parts, start, r + 1, c, number, total10, a1, b0, whole, length)
        store(parts, start, r + 2, c, number, total20, a2, b0, whole, length)
        store(parts, start, r + 3, c, number, total30, a3, b0, whole, length)
        store(parts, start, r, c + 1, number, total01, a0, b1, whole, length)
        store(parts, start, r + 1, c + 1, number, total11, a1, b1, whole, length)
        store(parts, start, r + 2, c + 1, number, total21, a2, b1, whole, length)
        store(parts, start, r + 3, c + 1, number, total31, a3, b1, whole, length)


@wp.kernel
def add_up(
    parts: wp.array[float],  # (pieces, M + 1, M)
    pieces: int,
    number: int,  # M
    first: int,
    count: int,
    # outputs
    products: wp.array[float],  # (M + 1, M)
):
    tid = wp.tid()
    if tid >= count:
        return
    i = (first + tid) / number
    j = (first + tid) % number
    place = wp.max(i, j) * number + wp.min(i, j)
    total = wp.float64(0.0)
    for piece in range(pieces):
        total += wp.float64(parts[piece * (number + 1) * number + place])
    products[first + tid] = float(total)
