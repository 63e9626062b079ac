"""Re-orientation along fixed flows (CE05, Eq. 2), prepared once for all frames.

The residual flow C_syn - C_i is carried to the pixels of prototype i by a forward warp along C_i,
and holes are filled. C_i never changes, so neither does which pixels give to which: a mean over

    (1 - |x(s) + u(s) - x(t)|) (1 - |y(s) + v(s) - y(t)|),      C_i(s) = (u, v),

for each pixel t, over the sources s that arrive around it. The pixels of a vector, 16 neighbours of
a row, mostly come from neighbours. So their sources are kept in parts: for a vector and a distance,
for which of its pixels the one so much further on is a source. Shares follow from C_i, which takes
less room than they would. Holes have rows of shares; so have the cells of the pull-push pyramid
that they are interpolated from. Not here: warping along the result, whose pattern is new in every
frame.
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


@dataclass(frozen=True)
class Orientations:
    """Of M prototypes of h x w pixels. Rows are padded to `pitch` pixels, whole vectors.

    A node is a pixel, or from h pitch on a cell.

    flows: C_i, (M, 2, h, pitch) [px].
    shares: one over the weight of each pixel, 0 in holes, (M, h, pitch).
    firsts: first part of each vector, (M h pitch / 16 + 1,).
    parts: how far right and down a part lies, and which of 16 pixels have a source there, as bits;
        (parts, 3).
    rows: first row of each prototype, (M + 1,).
    targets: the node that each row gives, (R,).
    starts: first tap of each row, (R + 1,).
    row_taps, row_shares: nodes and their shares, (starts[R],).
    nodes: pixels of a prototype, and cells of the prototype that has most.
    """

    flows: F32
    shares: F32
    firsts: I32
    parts: I32
    rows: I32
    targets: I32
    starts: I32
    row_taps: I32
    row_shares: F32
    nodes: int


def orient(flows: F32, hole: float) -> Orientations:
    """What re-orientation along C_i, (M, h, w, 2) [px], needs; less weight than `hole` is a hole.

    Raises:
        InputError: A flow leaves no pixel in the picture.
    """
    _, h, w, _ = flows.shape
    with ThreadPoolExecutor(default_threads()) as pool:
        done = list(pool.map(_orient_one, flows, repeat(hole)))
    rows = [rows for o in done for rows in o.rows]
    return Orientations(
        flows=planes(flows),
        shares=planes(np.stack([o.shares for o in done])[..., None])[:, 0],
        firsts=_starts(np.concatenate([o.counts for o in done])),
        parts=np.concatenate([o.parts for o in done]),
        rows=_starts([len(o.targets) for o in done]),
        targets=np.concatenate([o.targets for o in done]).astype(np.int32),
        starts=_starts(np.concatenate([np.diff(r.indptr) for r in rows])),
        row_taps=np.concatenate([r.indices for r in rows]).astype(np.int32),
        row_shares=np.concatenate([r.data for r in rows]).astype(np.float32),
        nodes=h * pitch_of(w) + max(o.rows[0].shape[0] for o in done),
    )


@dataclass(frozen=True)
class _Oriented:
    """Of one prototype: shares (h, w); number of parts of each vector; parts (n, 3); sparse rows.

    rows, targets: of cells and of holes, and which nodes these are.
    """

    shares: F32
    counts: Numbers
    parts: I32
    rows: tuple[Any, Any]
    targets: Numbers


def _orient_one(flow: F32, hole: float) -> _Oriented:
    h, w, _ = flow.shape
    first_cell = h * pitch_of(w)
    target, source, share = landings(flow)
    weight = np.bincount(target, share, minlength=h * w).reshape(h, w)
    valid = weight.astype(np.float32) >= np.float32(hole)
    check_some_valid(valid.sum(keepdims=True))
    used = valid.ravel()[target] & (share > 0)
    cells, through = _filling(valid)
    cells.indices = _padded(cells.indices, w)
    through.indices += first_cell
    holes = _padded(np.flatnonzero(~valid), w)
    targets = np.concatenate([first_cell + np.arange(cells.shape[0]), holes])
    shares = np.divide(1, weight, where=valid, out=np.zeros_like(weight)).astype(np.float32)
    counts, parts = _parts(target[used], source[used], h, w)
    return _Oriented(shares, counts, parts, (cells, through), targets)


def _starts(lengths: Sequence[int] | NDArray[Any]) -> I32:
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)


def _parts(target: Numbers, source: Numbers, h: int, w: int) -> tuple[Numbers, I32]:
    """Which pixels are sources of which, by vector and distance: numbers of parts, and these."""
    (y, x), (down, right) = _divided(target, w), _divided(source, w)
    across, lane = _divided(x, LANES)
    vector = y * (pitch_of(w) // LANES) + across
    reach = 2 * w - 1
    distance = (down - y + h - 1) * reach + right - x + w - 1
    given = (vector * ((2 * h - 1) * reach) + distance) * LANES + lane
    given.sort()
    part, lane = _divided(given, LANES)
    starts = np.flatnonzero(np.diff(part, prepend=-1))
    lanes = np.add.reduceat(1 << lane, starts)
    vector, distance = _divided(part[starts], (2 * h - 1) * reach)
    down, right = _divided(distance, reach)
    parts = np.stack([right - w + 1, down - h + 1, lanes], axis=1).astype(np.int32)
    return np.bincount(vector, minlength=h * pitch_of(w) // LANES), parts


def _divided(numbers: Numbers, by: int) -> tuple[Numbers, Numbers]:
    """Quotients and remainders; `divmod` of NumPy takes twice as long."""
    quotient = numbers // by
    return quotient, numbers - quotient * by


def _padded(pixels: NDArray[Any], width: int) -> Numbers:
    """Numbers of pixels in padded rows."""
    y, x = _divided(pixels.astype(np.int64), width)
    return y * pitch_of(width) + x


def _filling(valid: NDArray[np.bool_]) -> tuple[Any, Any]:
    """Pull-push as shares: of pixels in cells (C, h w), and of cells in holes (holes, C).

    Only the cells are there that a hole needs and that have a valid pixel.
    """
    h, w = valid.shape
    y, x = _divided(np.arange(h * w), w)
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
    y, x = _divided(pixels, w)
    y0, x0 = y // 2, x // 2
    y1 = np.clip(y0 + 2 * (y % 2) - 1, 0, rows - 1)
    x1 = np.clip(x0 + 2 * (x % 2) - 1, 0, columns - 1)
    cell = np.stack([y0 * columns + x0, y0 * columns + x1, y1 * columns + x0, y1 * columns + x1])
    share = np.repeat([0.5625, 0.1875, 0.1875, 0.0625], len(pixels))
    pixel = np.tile(np.arange(len(pixels)), 4)
    return sparse.csr_matrix((share, (pixel, cell.ravel())), shape=(len(pixels), rows * columns))
