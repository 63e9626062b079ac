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
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmmgpu.arrays import F32, check_some_valid
from mmmgpu.backends import default_threads
from mmmgpu.backends.planes import LANES, pitch_of, planes
from mmmgpu.backends.reference import landings

I32 = NDArray[np.int32]
Numbers = NDArray[np.int64]
Floats = NDArray[np.float64]
Entries = tuple[Numbers, Numbers, Floats]  # rows, columns and values of a sparse matrix


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
        starts=_starts(np.concatenate([r.lengths for r in rows])),
        row_taps=np.concatenate([r.taps for r in rows]).astype(np.int32),
        row_shares=np.concatenate([r.shares for r in rows]).astype(np.float32),
        nodes=h * pitch_of(w) + max(len(o.rows[0].lengths) for o in done),
    )


@dataclass(frozen=True)
class _Rows:
    """Rows of a sparse matrix: taps of each, (n,), and these with their shares, (lengths.sum(),).

    `scipy.sparse` would take an eighth of the time to a new process's first frame to load.
    """

    lengths: Numbers
    taps: Numbers
    shares: Floats


@dataclass(frozen=True)
class _Oriented:
    """Of one prototype: shares (h, w); number of parts of each vector; parts (n, 3).

    rows, targets: of cells and of holes, and which nodes these are.
    """

    shares: F32
    counts: Numbers
    parts: I32
    rows: tuple[_Rows, _Rows]
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
    holes = _padded(np.flatnonzero(~valid), w)
    targets = np.concatenate([first_cell + np.arange(len(cells.lengths)), holes])
    cells = replace(cells, taps=_padded(cells.taps, w))
    through = replace(through, taps=first_cell + through.taps)
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


def _filling(valid: NDArray[np.bool_]) -> tuple[_Rows, _Rows]:
    """Pull-push as shares: of pixels in cells, and of cells in holes.

    Only the cells are there that a hole needs and that have a valid pixel.
    """
    h, w = valid.shape
    y, x = _divided(np.arange(h * w), w)
    inside = valid.ravel()
    empty = np.flatnonzero(~inside)
    hole, top, left = np.arange(len(empty)), y[empty], x[empty]
    needs = np.zeros((len(empty), 3, 3))  # of holes, in the 3 x 3 cells from top left on
    needs[:, 0, 0] = 1
    cells = [(hole[:0], hole[:0], np.empty(0))]
    through = [(hole[:0], hole[:0], np.empty(0))]
    level, count = 0, 0
    while len(hole):
        (rows, top), (columns, left) = _coarser(top, h), _coarser(left, w)
        needs = rows.swapaxes(1, 2) @ needs @ columns
        level, h, w = level + 1, (h + 1) // 2, (w + 1) // 2
        cell = (y >> level) * w + (x >> level)
        number = np.bincount(cell[inside], minlength=h * w)
        k, down, right = np.nonzero(needs)
        by = (top[k] + down) * w + left[k] + right
        full = number[by] > 0
        k, down, right, by = k[full], down[full], right[full], by[full]
        used = np.flatnonzero(np.bincount(by))  # `np.unique` would load masked arrays: 0.02 s
        place = np.full(h * w, -1)
        place[used] = np.arange(count, count + len(used))
        count += len(used)
        member = np.flatnonzero(inside & (place[cell] >= 0))
        cells.append((place[cell[member]], member, 1 / number[cell[member]]))
        through.append((hole[k], place[by], needs[k, down, right]))
        needs[k, down, right] = 0
        more = needs.any(axis=(1, 2))
        hole, top, left, needs = hole[more], top[more], left[more], needs[more]
    return _in_rows(cells, count), _in_rows(through, len(empty))


def _coarser(first: Numbers, number: int) -> tuple[Floats, Numbers]:
    """Three neighbours of a row of `number`, interpolated from three of the next coarser one.

    first: number of the first neighbour, (n,): -1 or more. Their shares, (n, 3 fine, 3 coarse), and
    the first coarse one.
    """
    fine = first[:, None] + np.arange(3)
    near = fine // 2
    far = np.clip(near + 2 * (fine % 2) - 1, 0, (number + 1) // 2 - 1)
    begin = (first - 1) // 2
    coarse = begin[:, None, None] + np.arange(3)
    return 0.75 * (near[:, :, None] == coarse) + 0.25 * (far[:, :, None] == coarse), begin


def _in_rows(parts: Sequence[Entries], number: int) -> _Rows:
    """All entries together, in the order of their rows, of which there are `number`."""
    row, tap, share = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.argsort(row, kind="stable")
    return _Rows(np.bincount(row, minlength=number), tap[order], share[order])
