"""Re-orientation along fixed flows (CE05, Eq. 2), prepared once for all frames.

The residual flow C_syn - C_i is carried to the pixels of prototype i by a forward warp along C_i,
and holes are filled. C_i never changes, so this is one sparse linear map for each prototype:

    W_F(C_syn - C_i, C_i) = L_i C_syn - L_i C_i

The pixels of a vector, 16 neighbours of a row, mostly come from neighbours in C_syn. So the map is
kept in parts: for a vector and a distance, the shares that its pixels have in those so much further
on. Holes have rows of their own; so have the cells of the pull-push pyramid that they are
interpolated from, which the rows of holes refer to like pixels. Not here: warping along the result,
whose pattern is new in every frame.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from mmmgpu.arrays import F32, check_some_valid
from mmmgpu.backends import default_threads
from mmmgpu.backends.planes import LANES, pitch_of, planes
from mmmgpu.backends.reference import landings

I32 = NDArray[np.int32]
Numbers = NDArray[np.int64]

NOWHERE = 2e8  # [px] fixed flow of what pads a row: it carries beyond any picture


@dataclass(frozen=True)
class Orientations:
    """L_i of M prototypes of h x w pixels. Rows are padded to `pitch` pixels, whole vectors.

    A node is a pixel, or from h pitch + 16 on a cell.

    fixed: L_i C_i, (M, 2, h, pitch) [px].
    firsts: first part of each vector, (M h pitch / 16 + 1,).
    deltas: how many pixels further on a part lies, (parts,).
    shares: of the vector's pixels in it, (parts, 16).
    rows: first row of each prototype, (M + 1,).
    targets: the node that each row gives, (R,).
    starts: first tap of each row, (R + 1,).
    row_taps, row_shares: nodes and their shares, (starts[R],).
    nodes: places of a flow with 16 before it, 16 after it, and the cells of the prototype that has
        most.
    """

    fixed: F32
    firsts: I32
    deltas: I32
    shares: F32
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
    _, h, w, _ = flows.shape
    with ThreadPoolExecutor(default_threads()) as pool:
        done = list(pool.map(_orient_one, flows, repeat(hole)))
    fixed = planes(np.stack([o.fixed for o in done]))
    fixed[..., w:] = NOWHERE
    rows = [rows for o in done for rows in o.rows]
    return Orientations(
        fixed=fixed,
        firsts=_starts(np.concatenate([o.parts.counts for o in done])),
        deltas=np.concatenate([o.parts.deltas for o in done]),
        shares=np.concatenate([o.parts.shares for o in done]),
        rows=_starts([len(o.targets) for o in done]),
        targets=np.concatenate([o.targets for o in done]).astype(np.int32),
        starts=_starts(np.concatenate([np.diff(r.indptr) for r in rows])),
        row_taps=np.concatenate([r.indices for r in rows]).astype(np.int32),
        row_shares=np.concatenate([r.data for r in rows]).astype(np.float32),
        nodes=h * pitch_of(w) + 2 * LANES + max(o.rows[0].shape[0] for o in done),
    )


@dataclass(frozen=True)
class _Parts:
    """Of one prototype: parts of each vector (h pitch / 16,); deltas (n,); shares (n, 16)."""

    counts: Numbers
    deltas: I32
    shares: F32


@dataclass(frozen=True)
class _Oriented:
    """L_i: fixed (h, w, 2); parts; sparse rows of cells and of holes; which nodes these are."""

    fixed: F32
    parts: _Parts
    rows: tuple[Any, Any]
    targets: Numbers


def _orient_one(flow: F32, hole: float) -> _Oriented:
    h, w, _ = flow.shape
    first_cell = h * pitch_of(w) + LANES
    pixels, valid = _splatted(flow, hole)
    members, through = _filling(valid)
    cells, holes = members @ pixels, np.flatnonzero(~valid)
    own = flow.reshape(-1, 2).astype(np.float64)
    fixed = pixels @ own
    fixed[holes] = through @ (cells @ own)
    cells.indices = _padded(cells.indices, w)
    through.indices += first_cell
    targets = np.concatenate([first_cell + np.arange(cells.shape[0]), _padded(holes, w)])
    carried = fixed.reshape(h, w, 2).astype(np.float32)
    return _Oriented(carried, _parts(pixels, w), (cells, through), targets)


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


def _parts(pixels: Any, width: int) -> _Parts:
    """Shares of pixels in pixels, sparse (h w, h w), by vector and distance."""
    area = pixels.shape[0] // width * pitch_of(width)
    target = _padded(np.repeat(np.arange(pixels.shape[0]), np.diff(pixels.indptr)), width)
    delta = _padded(pixels.indices, width) - target
    vector, lane = np.divmod(target, LANES)
    part, which = np.unique(vector * (2 * area) + delta + area, return_inverse=True)
    shares = np.zeros((len(part), LANES), np.float32)
    shares[which, lane] = pixels.data
    counts = np.bincount(part // (2 * area), minlength=area // LANES)
    return _Parts(counts, (part % (2 * area) - area).astype(np.int32), shares)


def _padded(pixels: NDArray[Any], width: int) -> Numbers:
    """Numbers of pixels in padded rows."""
    y, x = np.divmod(pixels.astype(np.int64), width)
    return y * pitch_of(width) + x


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
