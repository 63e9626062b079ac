"""Which frames of a new person move as a model's prototypes do: by flow alone (CE05, Eq. 7).

A is the person with a model, B the new one; S carries A's reference to B's (`correspondence`).

    P_k* = argmin_n  sum_p w_f(p) |C'_k(S(p)) - C_n(S(p))|
    C_syn,k(S(p)) = S(p + C_k(p)) - S(p)

In the paper C' is C_syn. That holds B to moving in proportion to A wherever it is: lips of other
thickness, a longer chin or a badly marked point then count as different speech. What B's flows
really are tells how the two go together, so C_syn is calibrated on them. With V the first principal
directions of B's flows under w_f (of 512 of them, if there are more), and z_k = V C_syn,k,

    C'_k = V' (T z_k + o) + KEPT (C_syn,k - V' z_k),

where T, o carry the z_k to the same coordinates of the frames found so far, and so on until nothing
changes (as in iterative closest points; Besl & McKay 1992). T is drawn to the identity, as far as
the frames do not say otherwise, and frames that lie far off count less: some are wrong.

V is a mixture of B's flows, so C'_k is KEPT C_syn,k plus a mixture of B's flows: known on all of
B's pixels, whatever pixels it was found on.

With several pairs of reference frames all of this is done for each, and a prototype and a frame are
as far apart as in the pair that brings them nearer: where lips part or meet between a reference and
either of them, the flows from there say little.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mmmgpu.backends import Backend, default_threads, get_backend
from mmmgpu.basis import LIP, Basis
from mmmgpu.batches import in_parts
from mmmgpu.correspondence import Correspondence
from mmmgpu.parallel import Cancelled, map_ordered

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]

DIRECTIONS = 16  # principal directions of B's flows
LEARNED = 512  # of B's frames that they are found from: time grows with the square of their number
RIDGE = 1.0  # pull of T to the identity, in mean squares of a coordinate
SMOOTHING = 8.0  # of S: C_syn needs its slope, and marked points are a pixel or two off
KEPT = 0.5  # of what B's flows do not span
ROUNDS = 10  # of reweighting
NO_ENERGY = 1e-6  # of the first direction's: a direction with less is none


@dataclass(frozen=True)
class View:
    """A pair of reference frames, and all flows relative to them, on the pixels of their regions.

    correspondence: S, from A's region to B's, smoothed by `SMOOTHING`.
    flows_a: of A's prototypes, (M, h, w, 2) [px].
    flows_b: of B's frames, (N, h', w', 2) [px].
    """

    correspondence: Correspondence
    flows_a: F32
    flows_b: F32


@dataclass(frozen=True)
class Calibration:
    """C'_k = kept_v C_syn,k + sum_n mixture_vkn C_n in view v.

    kept: (V,). mixture: (V, M, N).
    """

    kept: F32
    mixture: F32


class FlowScan:
    """Eq. 7 for all frames of B: distances (V, M, N) [px], means over A's pixels under w_f.

    views: V reference pairs.
    """

    def __init__(self, source: Basis, views: Sequence[View], *, backend: str = "warp"):
        self._kernels = get_backend(backend)
        y, x = np.nonzero(source.w_f > LIP)
        weight = source.w_f[y, x]
        self._weight = (weight / weight.sum()).astype(np.float32)
        pixels = np.stack([x, y], axis=1)
        self._sides = [_side(v, pixels, self._weight, self._kernels) for v in views]

    def __call__(self, calibration: Calibration | None = None) -> Floats:
        """Distances of C_syn or, with a calibration, of C' to the flows of B's frames."""
        weight, found = self._kernels.to_device(self._weight), []
        for r, side in enumerate(self._sides):
            queries = calibrated(side.queries, side.corpus, calibration, r)
            found.append(distances(self._kernels, queries, side.on_device, weight))
        return np.array(found, np.float64)

    def calibrate(self, chosen: Numbers) -> Calibration:
        """The calibration on the frames `chosen` (M,) for the prototypes, in each view."""
        kept = np.ones(len(self._sides), np.float32)
        mixture = np.zeros((len(kept), len(chosen), len(self._sides[0].corpus)), np.float32)
        for r, side in enumerate(self._sides):
            if not len(side.directions):
                continue
            linear, offset = robust_map(side.z, side.y[chosen])
            wanted = side.z @ linear.T + offset - KEPT * side.z
            kept[r], mixture[r] = KEPT, wanted @ side.directions
        return Calibration(kept, mixture)


def distances(kernels: Backend, queries: F32, corpus: Any, weights: Any) -> F32:
    """Of fields (K, P, C) from a corpus on the device, (K, N): in parts if memory asks for it."""

    def scanned(part: slice) -> F32:
        some = kernels.to_device(queries[part])
        return kernels.to_host(kernels.distance_scan(some, corpus, weights))

    return np.concatenate(in_parts(scanned, len(queries)))


@dataclass(frozen=True)
class _Side:
    """A view on the pixels S(p).

    queries: C_syn of all prototypes, (M, P, 2) [px]. corpus: C_n, (N, P, 2) [px].
    directions: Mixtures of B's flows that are V, (D, N). z, y: V of both, (M, D) and (N, D).
    """

    queries: F32
    corpus: F32
    on_device: F32
    directions: Floats
    z: Floats
    y: Floats


def _side(view: View, pixels: Numbers, weight: F32, kernels: Backend) -> _Side:
    p = pixels.astype(np.float64)
    at = view.correspondence(p)
    moved = p + view.flows_a[:, pixels[:, 1], pixels[:, 0]]
    queries = (view.correspondence(moved) - at).astype(np.float32)
    points = np.broadcast_to(at.astype(np.float32), (len(view.flows_b), *at.shape)).copy()
    on_device = kernels.sample(*map(kernels.to_device, (view.flows_b, points)))
    corpus = np.asarray(kernels.to_host(on_device))
    learned = np.linspace(0, len(corpus) - 1, min(len(corpus), LEARNED)).round().astype(np.int64)
    some = corpus[learned]
    mixtures = principal_mixtures(_products(some, some, weight), DIRECTIONS)
    directions = np.zeros((len(mixtures), len(corpus)))
    directions[:, learned] = mixtures
    v = np.tensordot(mixtures, some, axes=1).astype(np.float32)
    z, y = _products(queries, v, weight), _products(corpus, v, weight)
    return _Side(queries, corpus, on_device, directions, z, y)


def _products(a: F32, b: F32, weight: F32) -> Floats:
    """Inner products of flows (m, P, 2) and (n, P, 2) under weights (P,), (m, n)."""
    weighted = (a * weight[:, None]).reshape(len(a), 2 * len(weight))
    return np.asarray(weighted @ b.reshape(len(b), 2 * len(weight)).T, np.float64)


def principal_mixtures(products: Floats, number: int) -> Floats:
    """Mixtures (D, N) of N flows with inner products (N, N): their first principal directions.

    D is `number`, or as many as there are. The mean is not taken off: no flow is the reference.
    """
    energy, vectors = np.linalg.eigh(products)
    energy, vectors = energy[::-1][:number], vectors[:, ::-1][:, :number]
    real = energy > max(NO_ENERGY * float(energy[0]), float(np.finfo(np.float32).tiny))
    return np.asarray((vectors[:, real] / np.sqrt(energy[real])).T)


def robust_map(z: Floats, y: Floats) -> tuple[Floats, Floats]:
    """T (D, D) and o (D,) with y_k = T z_k + o for most of the rows of z and y, (K, D).

    Minimises sum_k v_k |y_k - T z_k - o|^2 + RIDGE (mean of z^2) |T - I|^2, with v_k =
    min(1, m / e_k)^2, where e_k are the errors of the round before and m is their median.
    """
    size, tiny = z.shape[1], float(np.finfo(np.float64).tiny)
    wide = np.column_stack([z, np.ones(len(z))])
    pull = np.diag(np.append(np.full(size, RIDGE * (float(np.mean(z**2)) or 1.0)), 0.0))
    v = np.ones(len(z))
    for _ in range(ROUNDS):
        weighted = wide.T * v
        right = weighted @ y + pull @ np.eye(size + 1, size)
        solved = np.linalg.solve(weighted @ wide + pull, right)
        error = np.linalg.norm(y - wide @ solved, axis=1)
        v = np.maximum(error / max(float(np.median(error)), tiny), 1.0) ** -2.0
    return np.asarray(solved[:size].T), np.asarray(solved[size])


def calibrated(
    own: F32,
    corpus: F32,
    calibration: Calibration | None,
    r: int,
    mine: Numbers | slice = slice(None),
) -> F32:
    """C' of the prototypes `mine` in view r, (K, ..., 2), from C_syn and B's flows, (N, ..., 2)."""
    if calibration is None:
        return own
    mixed = np.tensordot(calibration.mixture[r, mine], corpus, axes=1)
    return np.asarray(calibration.kept[r] * own + mixed)


def synthetic_flows(
    views: Sequence[View],
    view: Numbers,
    shape: tuple[int, int],
    calibration: Calibration | None = None,
) -> F32:
    """C_syn,k or C'_k on B's own pixels, (M, h', w', 2) [px], in the view of prototype k.

    Where S(p) = q, C_syn,k is S(p + C_k(p)) - q; outside of A's region there is no flow.
    """
    q = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), axis=-1)
    flows = np.empty((len(view), *shape, 2), np.float32)
    for r, v in enumerate(views):
        mine = np.flatnonzero(view == r)
        p = v.correspondence.inverse(q)
        carry = partial(_carried, v.correspondence, q, p)
        carried = map_ordered(carry, v.flows_a[mine], threads=default_threads())
        for k, flow in zip(mine, carried, strict=True):
            flows[k] = flow
        flows[mine] = calibrated(flows[mine], v.flows_b, calibration, r, mine)
    return flows


def _carried(s: Correspondence, q: Numbers, p: Floats, flow: F32, _: Cancelled) -> Floats:
    """S(p + C(p)) - q for points q = S(p) of B, (h', w', 2), and a flow C on A's pixels."""
    at = p.astype(np.float32)
    return s(p + cv2.remap(flow, at[..., 0], at[..., 1], cv2.INTER_LINEAR)) - q
