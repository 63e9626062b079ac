"""Re-orientation along fixed flows (CE05, Eq. 2), prepared once for all frames.

The residual flow C_syn - C_i is carried to the pixels of prototype i by a forward warp along C_i,
and holes are filled. C_i never changes, so this is one sparse linear map for each prototype:

    W_F(C_syn - C_i, C_i) = L_i C_syn - L_i C_i

Most pixels are means of at most six pixels of C_syn. Those of more, and holes, have rows of their
own; so have the cells of the pull-push pyramid that holes are interpolated from, which the rows of
holes refer to like pixels. Not here: warping along the result, whose pattern is new in every frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from mmmgpu.arrays import F32, check_some_valid
from mmmgpu.backends.reference import landings

I32 = NDArray[np.int32]
Numbers = NDArray[np.int64]

TAPS = 6  # of a pixel without a row of its own, as in kernels/prototypes
OWN_ROW = -1  # first tap of a pixel with a row of its own


@dataclass(frozen=True)
class Orientations:
    """L_i of M prototypes of h x w pixels. A node is a pixel, or from h w on a cell.

    taps, shares: pixels of C_syn and their shares in each pixel, (M, h w, 6); the first tap is -1
        where the pixel has a row of its own.
    fixed: L_i C_i, (M, h w, 2) [px].
    rows: first row of each prototype, (M + 1,).
    targets: the node that each row gives, (R,).
    starts: first tap of each row, (R + 1,).
    row_taps, row_shares: nodes and their shares, (starts[R],).
    nodes: of the prototype that has most.
    """

    taps: I32
    shares: F32
    fixed: F32
    rows: I32
    targets: I32
    starts: I32
    row_taps: I32
    row_shares: F32
    nodes: int


def orient(flows: F32, hole: float) -> Orientations:
    """L_i of the flows C_i, (M, h, w, 2) [px]; pixels that get less weight than `hole` are filled.

    Raises:
        InputError: A flow leaves no pixel in the picture.
    """
    number, h, w, _ = flows.shape
    taps = np.empty((number, h * w, TAPS), np.int32)
    shares = np.empty((number, h * w, TAPS), np.float32)
    fixed = np.empty((number, h * w, 2), np.float32)
    rows: list[Any] = []
    targets: list[Numbers] = []
    offsets, lengths = [], []
    for i, flow in enumerate(flows):
        pixels, valid = _splatted(flow, hole)
        members, through = _filling(valid)
        cells, holes = members @ pixels, np.flatnonzero(~valid)
        many = np.flatnonzero(np.diff(pixels.indptr) > TAPS)
        taps[i], shares[i] = _regular(pixels)
        taps[i, many, 0] = taps[i, holes, 0] = OWN_ROW
        own = flow.reshape(-1, 2).astype(np.float64)
        carried = pixels @ own
        carried[holes] = through @ (cells @ own)
        fixed[i] = carried
        through.indices += h * w
        rows += [cells, pixels[many], through]
        targets += [h * w + np.arange(cells.shape[0]), many, holes]
        lengths.append(cells.shape[0] + len(many) + len(holes))
        offsets.append(cells.shape[0])
    counts = np.concatenate([np.diff(r.indptr) for r in rows])
    return Orientations(
        taps=taps,
        shares=shares,
        fixed=fixed,
        rows=_starts(lengths),
        targets=np.concatenate(targets).astype(np.int32),
        starts=_starts(counts),
        row_taps=np.concatenate([r.indices for r in rows]).astype(np.int32),
        row_shares=np.concatenate([r.data for r in rows]).astype(np.float32),
        nodes=h * w + max(offsets),
    )


def _starts(lengths: Sequence[int] | NDArray[Any]) -> I32:
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)


def _splatted(flow: F32, hole: float) -> tuple[Any, NDArray[np.bool_]]:
    """The forward warp along `flow` as shares of sources in targets, and which are no holes (h, w).

    The rows of holes are empty.
    """
    h, w, _ = flow.shape
    target, source, share = landings(flow)
    splat = sparse.csr_matrix((share.astype(np.float64), (target, source)), shape=(h * w, h * w))
    splat.eliminate_zeros()
    weight = np.asarray(splat.sum(axis=1)).ravel()
    valid = weight.astype(np.float32) >= np.float32(hole)
    check_some_valid(valid.sum(keepdims=True))
    scale = np.divide(1, weight, where=valid, out=np.zeros_like(weight))
    pixels = sparse.diags(scale) @ splat
    pixels.eliminate_zeros()
    return pixels, valid.reshape(h, w)


def _regular(pixels: Any) -> tuple[I32, F32]:
    """The first `TAPS` taps of every pixel and their shares, (h w, 6); what is missing has none."""
    there = np.arange(TAPS) < np.diff(pixels.indptr)[:, None]
    at = np.where(there, pixels.indptr[:-1, None] + np.arange(TAPS), 0)
    return pixels.indices[at], np.where(there, pixels.data[at], 0).astype(np.float32)


def _filling(valid: NDArray[np.bool_]) -> tuple[Any, Any]:
    """Pull-push as shares: of pixels in cells (C, h w), and of cells in holes (holes, C).

    Only the cells are there that a hole needs and that have a valid pixel.
    """
    h, w = valid.shape
    y, x = np.divmod(np.arange(h * w), w)
    inside = valid.ravel()
    empty = np.flatnonzero(~inside)
    needs = sparse.identity(len(empty), format="csr")
    cells, through = [sparse.csr_matrix((0, h * w))], [sparse.csr_matrix((len(empty), 0))]
    level = 0
    while len(empty):
        needs = needs @ _between(empty, h, w)
        level, h, w = level + 1, (h + 1) // 2, (w + 1) // 2
        cell = (y >> level) * w + (x >> level)
        number = np.bincount(cell[inside], minlength=h * w)
        needed = np.unique(needs.indices)
        full, empty = needed[number[needed] > 0], needed[number[needed] == 0]
        place = np.full(h * w, -1)
        place[full] = np.arange(len(full))
        member = np.flatnonzero(inside & (place[cell] >= 0))
        share = (1 / number[cell[member]], (place[cell[member]], member))
        cells.append(sparse.csr_matrix(share, shape=(len(full), len(cell))))
        through.append(needs[:, full])
        needs = needs[:, empty]
    return sparse.vstack(cells, format="csr"), sparse.hstack(through, format="csr")


def _between(pixels: Numbers, h: int, w: int) -> Any:
    """Some pixels of a level of h x w, interpolated from the next coarser one: (n, cells)."""
    rows, columns = (h + 1) // 2, (w + 1) // 2
    y, x = np.divmod(pixels, w)
    y0, x0 = y // 2, x // 2
    y1 = np.clip(y0 + 2 * (y % 2) - 1, 0, rows - 1)
    x1 = np.clip(x0 + 2 * (x % 2) - 1, 0, columns - 1)
    cell = np.stack([y0 * columns + x0, y0 * columns + x1, y1 * columns + x0, y1 * columns + x1])
    share = np.repeat([0.5625, 0.1875, 0.1875, 0.0625], len(pixels))
    pixel = np.tile(np.arange(len(pixels)), 4)
    return sparse.csr_matrix((share, (pixel, cell.ravel())), shape=(len(pixels), rows * columns))
