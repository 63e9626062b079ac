"""Matching by synthesis: which frames of a new person show what a model's prototypes show.

A is the person with a model, B the new one. Frames are first chosen by flow (`flow_matching`), then
by flow and texture together. Prototype k of A is beta_k of the other prototypes of A, warped to it
(CE05, Eq. 8); the same beta_k of B's candidates, warped along the flow that prototype k has in B's
face, is what B should look like (Eq. 9), and is compared with every frame (Eq. 10),

    P_k** = argmin_n  sum_p w_t(p) |I_syn,k(p) - I_n(p)|.

A candidate changes what the others are made of: all are chosen again, until nothing changes.
Both pictures of Eq. 10 are smoothed first: flows are good to a fraction of a pixel, and where the
edges of teeth and lips are sharper than that, they would count as different textures.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mmmgpu.analysis import solve_simplex
from mmmgpu.backends import Backend, get_backend
from mmmgpu.backends.planes import picture, planes
from mmmgpu.basis import MOUTH, Basis
from mmmgpu.batches import in_parts
from mmmgpu.errors import DeviceMemoryError
from mmmgpu.flow_matching import FlowScan, View, distances, synthetic_flows
from mmmgpu.synthesis import HOLE, NO_TEXTURE

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]
Choice = Callable[[Floats], tuple[Numbers, float]]  # costs (M, N) -> candidates, their sum

BALANCE = 0.5  # t of the paper
MOST_ITERATIONS = 30
SMOOTHED = 0.02  # of the mouth's width: deviation of the Gaussian that smooths textures


@dataclass(frozen=True)
class Matching:
    """Which frames were candidates on the way, and why.

    chosen: The frame of B for each prototype, (M,).
    flow_history: Candidates of flow matching: by C_syn, then after each calibration, (J + 1, M).
    history: Candidates after flow matching and after each iteration, (I + 1, M).
    flow_distance, texture_distance: Of those candidates, each over its median at the start,
        (I + 1, M); textures are made of the candidates before.
    view: Which `View` brings each prototype nearest to its candidate by flow, (M,).
    texture: beta of Eq. 8, column k for prototype k, (M, M).
    outcome: "fixed point", "cycle" or "limit".
    """

    chosen: Numbers
    flow_history: Numbers
    history: Numbers
    flow_distance: Floats
    texture_distance: Floats
    view: Numbers
    texture: Floats
    outcome: str


def match_prototypes(
    source: Basis,
    target: Basis,
    views: Sequence[View],
    *,
    fixed: Sequence[tuple[int, int]] = (),
    balance: float = BALANCE,
    iterations: int = MOST_ITERATIONS,
    backend: str = "warp",
) -> Matching:
    """Choose a frame of B for each prototype of A.

    Args:
        source: A's prototypes, (M, h, w, 3), and masks.
        target: All frames of B in place of prototypes, (N, h', w', 3), and B's masks; its flows are
            not looked at.
        views: Reference pairs; a prototype and a frame are compared in the one that brings them
            nearer.
        fixed: Pairs (prototype, frame) that are known.
        balance: t in [0, 1]: 1 is Eq. 7 alone, 0 is Eq. 10 alone.
        iterations: At most so many, of flow matching and of both together.
        backend: A name for `mmmgpu.backends.get_backend`.
    """
    rows = np.arange(len(source.images))

    def choose(cost: Floats) -> tuple[Numbers, float]:
        chosen = cost.argmin(axis=1).astype(np.int64)
        for k, n in fixed:
            chosen[k] = n
        return chosen, float(cost[rows, chosen].sum())

    scan = FlowScan(source, views, backend=backend)
    flow_history, start = _match_flows(scan, choose, iterations)
    calibration = scan.calibrate(start)
    distances = scan(calibration)
    view = distances[:, rows, start].argmin(axis=0)
    flow = distances.min(axis=0)
    flow /= _median(flow)
    beta = texture_coordinates(source, views, view, backend=backend)
    flows = synthetic_flows(views, view, target.w_t.shape, calibration)
    texture_scan = _TextureScan(target, views, view, flows, beta, backend)
    first = texture_scan(start)
    unit = _median(first)
    apart = [first[rows, start] / unit]

    def by_both(chosen: Numbers) -> tuple[Numbers, float]:
        texture = (first if chosen is start else texture_scan(chosen)) / unit
        new, cost = choose(balance * flow + (1 - balance) * texture)
        apart.append(texture[rows, new])
        return new, cost

    history, chosen, outcome = settle(by_both, start, iterations)
    return Matching(
        chosen=chosen,
        flow_history=flow_history,
        history=history,
        flow_distance=flow[rows, history],
        texture_distance=np.array(apart),
        view=view,
        texture=beta,
        outcome=outcome,
    )


def _match_flows(scan: FlowScan, choose: Choice, iterations: int) -> tuple[Numbers, Numbers]:
    """Flow matching: candidates on the way, and the last ones."""

    def again(chosen: Numbers) -> tuple[Numbers, float]:
        return choose(scan(scan.calibrate(chosen)).min(axis=0))

    history, chosen, _ = settle(again, choose(scan().min(axis=0))[0], iterations)
    return history, chosen


def settle(
    step: Callable[[Numbers], tuple[Numbers, float]], start: Numbers, iterations: int
) -> tuple[Numbers, Numbers, str]:
    """Repeat `chosen, cost = step(chosen)` until candidates come again.

    Returns: All candidates, (I + 1, M); the last ones or, of a cycle, those of least cost; "fixed
        point", "cycle" or "limit".
    """
    history, outcome, first = [start], "limit", 0
    costs: list[float] = []
    while len(costs) < iterations and outcome == "limit":
        new, cost = step(history[-1])
        first = len(costs)
        costs.append(cost)
        seen = [i for i, old in enumerate(history) if np.array_equal(old, new)]
        if seen:
            outcome = "fixed point" if seen[-1] == first else "cycle"
            first = seen[-1]
        history.append(new)
    return np.array(history), history[first + 1 + int(np.argmin(costs[first:]))], outcome


def _median(distances: Floats) -> float:
    """The median, 1 where it is 0: a unit for distances of one kind."""
    return float(np.median(distances)) or 1.0


def texture_coordinates(
    source: Basis, views: Sequence[View], view: Numbers, *, backend: str = "warp"
) -> Floats:
    """Eq. 8: beta_{i,k} of prototype k of A in the other prototypes, column k, (M, M)."""
    kernels, beta = get_backend(backend), np.zeros((len(view), len(view)))
    root = np.where(source.w_t > MOUTH, np.sqrt(source.w_t), 0).astype(np.float32)[..., None]
    for r, v in enumerate(views):
        mine = np.flatnonzero(view == r)
        if len(mine):
            beta[:, mine] = _columns(source.images, v.flows_a, root, mine, kernels)
    return beta


def _columns(images: F32, flows: F32, root: F32, mine: Numbers, kernels: Backend) -> Floats:
    """Columns `mine` (K,) of beta, (M, K), all of one view; nothing stays on the device.

    root: sqrt(w_t), (h, w, 1).
    """
    held = kernels.hold_prototypes(images, flows, HOLE)
    scale, wanted = kernels.to_device(planes(root)[0]), planes(images * root)
    every, beta = np.arange(len(images)), np.zeros((len(images), len(mine)))

    def products(k: int, others: Numbers) -> F32:
        image = kernels.to_device(wanted[k])
        found = kernels.prototype_equations(held, planes(flows[k]), others, image, scale)
        return kernels.to_host(found)

    for column, k in enumerate(mine):
        others = every[every != k]
        found = products(k, others)
        beta[others, column] = solve_simplex(found[:-1], found[-1])
    return beta


class _TextureScan:
    """Eq. 9-10 for changing candidates: distances (M, N), mean over B's pixels under w_t.

    flows: Those that the prototypes have in B's face, (M, h', w', 2). beta: of Eq. 8.
    """

    def __init__(
        self,
        target: Basis,
        views: Sequence[View],
        view: Numbers,
        flows: F32,
        beta: Floats,
        backend: str,
    ):
        self._target, self._views, self._view = target, views, view
        self._kernels = get_backend(backend)
        self._flows, self._beta = planes(flows), np.where(beta > NO_TEXTURE, beta, 0)
        self._pixels = np.flatnonzero(target.w_t > MOUTH)
        weight = target.w_t.ravel()[self._pixels]
        self._held: list[list[tuple[Numbers, Any]]] = [[] for _ in views]
        frames = np.stack([self._seen(image) for image in target.images])
        self._frames, self._weight = map(self._kernels.to_device, (frames, weight / weight.sum()))

    def __call__(self, candidates: Numbers) -> Floats:
        made = np.empty((len(self._view), len(self._pixels), 3), np.float32)
        for r in range(len(self._views)):
            mine = np.flatnonzero(self._view == r)
            if len(mine):
                made[mine] = self._syntheses(r, mine, candidates)
        return distances(self._kernels, made, self._frames, self._weight).astype(np.float64)

    def _seen(self, image: F32) -> F32:
        """`image` (h', w', 3), smoothed, at the pixels that count, (P, 3)."""
        smooth = cv2.GaussianBlur(image, (0, 0), SMOOTHED * self._target.region.mouth[2])
        return np.asarray(smooth.reshape(-1, 3)[self._pixels], np.float32)

    def _syntheses(self, r: int, mine: Numbers, candidates: Numbers) -> F32:
        """I_syn of the prototypes `mine` (K,), all of view r, at the pixels that count, (K, P, 3).

        A frame that is the candidate of several prototypes is warped once.
        """
        flows, width = self._flows[mine], self._target.w_t.shape[1]
        weights = np.zeros((len(mine), len(self._target.images)), np.float32)
        np.add.at(weights.T, candidates, self._beta[:, mine])
        frames = np.flatnonzero(weights.any(axis=0))
        made = self._sum_of_held(r, frames, flows, weights)
        if made is None:
            made = self._sum_in_parts(r, frames, flows, weights)
        return np.stack([self._seen(picture(one, width)) for one in made])

    def _sum_of_held(self, r: int, frames: Numbers, flows: F32, weights: F32) -> F32 | None:
        """Mixtures (K, 3, h', pitch) of `frames`; None, and nothing is held, if memory is short."""
        try:
            return self._sum(self._hold(r, frames), flows, weights)
        except DeviceMemoryError:
            self._held = [[] for _ in self._views]
            return None

    def _sum_in_parts(self, r: int, frames: Numbers, flows: F32, weights: F32) -> F32:
        """The same of as many frames at a time as memory allows, none of which is kept."""

        def summed(part: slice) -> F32:
            return self._sum([self._prototypes(r, frames[part])], flows, weights)

        made: F32 = np.sum(in_parts(summed, len(frames)), axis=0)
        return made

    def _sum(self, parts: list[tuple[Numbers, Any]], flows: F32, weights: F32) -> F32:
        """Mixtures (K, 3, h', pitch) of all that is held in `parts`."""
        made = np.zeros((len(flows), 3, *flows.shape[2:]), np.float32)
        for frames, held in parts:
            shares = weights[:, frames]
            some = np.flatnonzero(shares.any(axis=1))
            made[some] += self._mixed(held, flows[some], shares[some])
        return made

    def _mixed(self, held: Any, flows: F32, shares: F32) -> F32:
        """Mixtures (K, 3, h', pitch) of what is held; in parts if need be."""
        k = self._kernels
        everywhere = k.to_device(np.ones(flows.shape[2:], np.float32))

        def mixed(part: slice) -> F32:
            return k.to_host(
                k.mix_prototypes(held, k.to_device(flows[part]), shares[part], everywhere)
            )

        return np.concatenate(in_parts(mixed, len(flows)))

    def _hold(self, r: int, frames: Numbers) -> list[tuple[Numbers, Any]]:
        """Frames held for view r, `frames` (n,) among them: most were candidates before."""
        parts = self._held[r]
        new = np.setdiff1d(frames, np.concatenate([frames[:0], *(part for part, _ in parts)]))
        if len(new):
            parts.append(self._prototypes(r, new))
        return parts

    def _prototypes(self, r: int, frames: Numbers) -> tuple[Numbers, Any]:
        """Frames and what is on the device of them, with their flows in view r."""
        given = self._target.images[frames], self._views[r].flows_b[frames]
        return frames, self._kernels.hold_prototypes(*given, HOLE)
