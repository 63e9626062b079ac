"""Matching by synthesis: which frames of a new person show what a model's prototypes show.

A is the person with a model, B the new one; S carries A's reference to B's (`correspondence`).
Frames are first chosen by flow (CE05, Eq. 7),

    P_k* = argmin_n  sum_p w_f(p) |C_syn,k(S(p)) - C_n(S(p))|
    C_syn,k(S(p)) = S(p + C_k(p)) - S(p),

then by flow and texture together. Prototype k of A is beta_k of the other prototypes of A, warped
to it (Eq. 8); the same beta_k of B's candidates, warped along C_syn,k, is what B should look like
(Eq. 9), and is compared with every frame (Eq. 10),

    P_k** = argmin_n  sum_p w_t(p) |I_syn,k(p) - I_n(p)|.

A candidate changes what the others are made of: all are chosen again, until nothing changes.
Both pictures of Eq. 10 are smoothed first: flows are good to a fraction of a pixel, and where the
edges of teeth and lips are sharper than that, they would count as different textures.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mmmgpu.analysis import solve_simplex
from mmmgpu.backends import default_threads, get_backend
from mmmgpu.basis import LIP, MOUTH, Basis
from mmmgpu.correspondence import Correspondence
from mmmgpu.flows import explanation_error
from mmmgpu.parallel import map_ordered
from mmmgpu.synthesis import NO_TEXTURE, warp_prototypes

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]

BALANCE = 0.5  # t of the paper
MOST_ITERATIONS = 30
SMOOTHED = 0.02  # of the mouth's width: deviation of the Gaussian that smooths textures


@dataclass(frozen=True)
class View:
    """A pair of reference frames, and all flows relative to them, on the pixels of their regions.

    reference_a: The prototype that is A's frame of the pair.
    correspondence: S, from A's region to B's.
    flows_a: of A's prototypes, (M, h, w, 2) [px].
    flows_b: of B's frames, (N, h', w', 2) [px].
    """

    reference_a: int
    correspondence: Correspondence
    flows_a: F32
    flows_b: F32


@dataclass(frozen=True)
class Matching:
    """Which frames were candidates on the way, and why.

    chosen: The frame of B for each prototype, (M,).
    history: Candidates after flow matching and after each iteration, (I + 1, M).
    flow_distance, texture_distance: Of those candidates, each over its median, (I + 1, M); the
        first texture distances are those of the first iteration.
    view: Which `View` was used for each prototype, (M,).
    texture: beta of Eq. 8, column k for prototype k, (M, M).
    outcome: "fixed point", "cycle" or "limit".
    """

    chosen: Numbers
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
        views: Reference pairs; every prototype uses the one whose reference it is nearer to.
        fixed: Pairs (prototype, frame) that are known.
        balance: t in [0, 1]: 1 is Eq. 7 alone, 0 is Eq. 10 alone.
        iterations: At most so many.
        backend: A name for `mmmgpu.backends.get_backend`.
    """
    view = nearest_view(source, views)
    flow = flow_distances(source, views, view, backend=backend)
    flow = flow / _median(flow)
    beta = texture_coordinates(source, views, view, backend=backend)
    scan = _TextureScan(target, views, view, beta, backend)

    def choose(cost: Floats) -> Numbers:
        chosen = cost.argmin(axis=1)
        for k, n in fixed:
            chosen[k] = n
        return np.asarray(chosen, np.int64)

    rows, history = np.arange(len(flow)), [choose(flow)]
    texture = scan(history[0])
    scale, outcome = _median(texture), "limit"
    costs: list[float] = []
    apart = [(flow[rows, history[0]], texture[rows, history[0]] / scale)]
    while len(costs) < iterations and outcome == "limit":
        texture = scan(history[-1]) / scale if costs else texture / scale
        cost = balance * flow + (1 - balance) * texture
        new = choose(cost)
        costs.append(float(cost[rows, new].sum()))
        apart.append((flow[rows, new], texture[rows, new]))
        seen = [i for i, old in enumerate(history) if np.array_equal(old, new)]
        history.append(new)
        if seen:
            outcome = "fixed point" if seen[-1] == len(history) - 2 else "cycle"
    first = seen[-1] if outcome == "cycle" else len(costs) - 1
    best = first + 1 + int(np.argmin(costs[first:]))
    return Matching(
        chosen=history[best],
        history=np.array(history),
        flow_distance=np.array([f for f, _ in apart]),
        texture_distance=np.array([t for _, t in apart]),
        view=view,
        texture=beta,
        outcome=outcome,
    )


def _median(distances: Floats) -> float:
    """The median, 1 where it is 0: a unit for distances of one kind."""
    return float(np.median(distances)) or 1.0


def nearest_view(source: Basis, views: Sequence[View]) -> Numbers:
    """Which view each prototype of A is nearer to: whose flow explains it better, (M,).

    Flow magnitude would not tell: where lips part or meet, a flow may be small and wrong.
    """
    errors = [
        [
            explanation_error(source.images[v.reference_a], image, flow, source.w_t)
            for image, flow in zip(source.images, v.flows_a, strict=True)
        ]
        for v in views
    ]
    return np.asarray(np.argmin(errors, axis=0), np.int64)


def flow_distances(
    source: Basis, views: Sequence[View], view: Numbers, *, backend: str = "warp"
) -> Floats:
    """Eq. 7: how far the flow of each frame of B is from that of each prototype of A, (M, N) [px].

    Sums over A's pixels, weighted by w_f, over the sum of the weights.
    """
    kernels = get_backend(backend)
    y, x = np.nonzero(source.w_f > LIP)
    p, weight = np.stack([x, y], axis=1).astype(np.float64), source.w_f[y, x]
    distance = np.empty((len(view), len(views[0].flows_b)))
    for r, v in enumerate(views):
        mine = np.flatnonzero(view == r)
        if not len(mine):
            continue
        at = v.correspondence(p)
        queries = v.correspondence(p + v.flows_a[mine][:, y, x]) - at  # C_syn at S(p), (K, P, 2)
        points = np.broadcast_to(at.astype(np.float32), (len(v.flows_b), *at.shape))
        corpus = kernels.sample(*map(kernels.to_device, (v.flows_b, points.copy())))
        moved = (kernels.to_device(a) for a in (queries.astype(np.float32), weight))
        query, importance = moved
        distance[mine] = kernels.to_host(kernels.distance_scan(query, corpus, importance))
    return distance / float(weight.sum())


def texture_coordinates(
    source: Basis, views: Sequence[View], view: Numbers, *, backend: str = "warp"
) -> Floats:
    """Eq. 8: beta_{i,k} of prototype k of A in the other prototypes, column k, (M, M)."""
    kernels = get_backend(backend, 1)
    bases = [replace(source, flows=v.flows_a) for v in views]
    pixels = np.flatnonzero(source.w_t > MOUTH)
    weight = np.sqrt(source.w_t.ravel()[pixels])
    every = np.arange(len(view))

    def one(k: int, _: Any) -> Floats:
        others = every[every != k]
        basis = bases[view[k]]
        warped = kernels.to_host(warp_prototypes(basis, basis.flows[k], others, kernels))
        warped = warped.reshape(len(others), -1, 3)
        column = np.zeros(len(every))
        column[others] = _fit_mixture(warped, source.images[k], pixels, weight)
        return column

    return np.stack(list(map_ordered(one, every.tolist(), threads=default_threads())), axis=1)


def _fit_mixture(warped: F32, image: F32, pixels: NDArray[np.int64], weight: F32) -> Floats:
    """The weights (n,) on the simplex with which pictures mix to `image` best.

    warped: (n, h w, 3). image: (h, w, 3). pixels, weight: those that count, and sqrt(w_t) there.
    """
    a = (warped[:, pixels] * weight[:, None]).reshape(len(warped), -1)
    b = (image.reshape(-1, 3)[pixels] * weight[:, None]).ravel()
    return solve_simplex(a @ a.T, a @ b)


def synthetic_flows(views: Sequence[View], view: Numbers, shape: tuple[int, int]) -> F32:
    """C_syn,k on B's own pixels, (M, h', w', 2) [px]: where S(p) = q, it is S(p + C_k(p)) - q.

    Outside of A's region there is no flow.
    """
    q = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), axis=-1)
    origins = [v.correspondence.inverse(q) for v in views]
    flows = np.empty((len(view), *shape, 2), np.float32)
    for k, r in enumerate(view):
        p, v = origins[r], views[r]
        at = p.astype(np.float32)
        moved = cv2.remap(v.flows_a[k], at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        flows[k] = v.correspondence(p + moved) - q
    return flows


class _TextureScan:
    """Eq. 9-10 for changing candidates: distances (M, N), mean over B's pixels under w_t.

    A synthesis whose own candidates have not changed is not made again.
    """

    def __init__(
        self,
        target: Basis,
        views: Sequence[View],
        view: Numbers,
        beta: Floats,
        backend: str,
    ):
        self._target, self._views, self._view, self._beta = target, views, view, beta
        self._flows = synthetic_flows(views, view, target.w_t.shape)
        self._kernels, self._one = get_backend(backend), get_backend(backend, 1)
        self._pixels = np.flatnonzero(target.w_t > MOUTH)
        weight = target.w_t.ravel()[self._pixels]
        frames = np.stack([self._seen(image) for image in target.images])
        self._frames, self._weight = map(self._kernels.to_device, (frames, weight / weight.sum()))
        self._made: dict[int, tuple[bytes, F32]] = {}

    def __call__(self, candidates: Numbers) -> Floats:
        numbers = range(len(self._view))
        work = [(k, candidates) for k in numbers]
        made = list(map_ordered(self._synthesis, work, threads=default_threads()))
        queries = self._kernels.to_device(np.stack(made))
        scanned = self._kernels.distance_scan(queries, self._frames, self._weight)
        return np.asarray(self._kernels.to_host(scanned), np.float64)

    def _seen(self, image: F32) -> F32:
        """`image` (h', w', 3), smoothed, at the pixels that count, (P, 3)."""
        smooth = cv2.GaussianBlur(image, (0, 0), SMOOTHED * self._target.region.mouth[2])
        return np.asarray(smooth.reshape(-1, 3)[self._pixels], np.float32)

    def _synthesis(self, item: tuple[int, Numbers], _: Any) -> F32:
        """I_syn,k at the pixels that count, (P, 3)."""
        k, candidates = item
        used = np.flatnonzero(self._beta[:, k] > NO_TEXTURE)
        frames = candidates[used]
        known = self._made.get(k)
        if known is not None and known[0] == frames.tobytes():
            return known[1]
        flows = self._views[self._view[k]].flows_b[frames]
        basis = replace(self._target, images=self._target.images[frames], flows=flows)
        every = np.arange(len(used))
        warped = self._one.to_host(warp_prototypes(basis, self._flows[k], every, self._one))
        made = self._seen(np.tensordot(self._beta[used, k].astype(np.float32), warped, axes=1))
        self._made[k] = (frames.tobytes(), made)
        return made
