"""Dense optical flow and its concatenation along paths of similar frames (EGP02, docs/model.md).

A flow a -> b, shape (H, W, 2) = (dx, dy) [px], says where the pixels of a are found in b. Direct
flow fails where two pictures differ much; a path through pictures that resemble each other does
not.
"""

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
Matcher = Callable[[F32, F32], F32]

NEIGHBOURS = 8  # edges of a frame in the graph
ROW = 128  # points read at a time
LEAST = 16  # [px] width and height of a picture that flow is looked for in


def matcher(name: str = "dis") -> Matcher:
    """A function (image a, image b) -> flow a -> b [px] for RGB images in [0, 1], (H, W, 3).

    name: ``"dis"`` (dense inverse search, Kroeger et al. 2016), ``"farneback"`` or ``"tvl1"``.
    """
    own = threading.local()  # OpenCV's algorithms keep buffers: every thread needs its own

    def flow(a: F32, b: F32) -> F32:
        if not hasattr(own, "algorithm"):
            own.algorithm = _ALGORITHMS[name]()
        found: F32 = own.algorithm.calc(_gray(a), _gray(b), None)
        return found

    return flow


def at_scale(match: Matcher, scale: float) -> Matcher:
    """`match` in pictures `scale` times as wide, at most 1; flows are those of the whole ones."""

    def flow(a: F32, b: F32) -> F32:
        h, w = a.shape[:2]
        size = (max(LEAST, math.ceil(scale * w)), max(LEAST, math.ceil(scale * h)))
        small_a, small_b = (_shrunk(image, size) for image in (a, b))
        found = cv2.resize(match(small_a, small_b), (w, h), interpolation=cv2.INTER_LINEAR)
        return np.asarray(found * np.array([w / size[0], h / size[1]], np.float32), np.float32)

    return match if scale == 1 else flow


def _shrunk(image: F32, size: tuple[int, int]) -> F32:
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


def _dis() -> Any:
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setFinestScale(0)
    dis.setGradientDescentIterations(25)
    return dis


_ALGORITHMS: dict[str, Callable[[], Any]] = {
    "dis": _dis,
    "farneback": cv2.FarnebackOpticalFlow.create,
    "tvl1": cv2.optflow.DualTVL1OpticalFlow.create,
}
MATCHERS = tuple(_ALGORITHMS)


def _gray(image: F32) -> NDArray[np.uint8]:
    bytes_ = np.clip(image * 255 + 0.5, 0, 255).astype(np.uint8)
    gray: NDArray[np.uint8] = cv2.cvtColor(bytes_, cv2.COLOR_RGB2GRAY)
    return gray


def pull(field: F32, flow: F32) -> F32:
    """`field` read at p + flow(p): backward warp, bilinear, border repeated. Shape of `field`."""
    h, w = flow.shape[:2]
    x = np.arange(w, dtype=np.float32) + flow[..., 0]
    y = np.arange(h, dtype=np.float32)[:, None] + flow[..., 1]
    seen = cv2.remap(field, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(seen, np.float32)


def read_at(field: F32, points: F32) -> F32:
    """`field` (H, W, C) at `points` (n, 2) = (x, y) [px], (n, C): bilinear, border repeated."""
    n = len(points)
    # no side of the result may be 32768 long
    table = np.resize(points, (math.ceil(n / ROW), ROW, 2))
    x, y = table[..., 0], table[..., 1]
    seen = cv2.remap(field, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(seen.reshape(-1, field.shape[2])[:n], np.float32)


def concatenate(first: F32, second: F32) -> F32:
    """Flow a -> c from flows a -> b and b -> c: ``C(p) = first(p) + second(p + first(p))``."""
    return first + pull(second, first)


def explanation_error(reference: F32, image: F32, flow: F32, mask: F32) -> float:
    """How badly `flow` explains `image`: mean squared difference of the pulled image, weighted."""
    missed = (pull(image, flow) - reference) ** 2
    by_colour = mask.ravel() @ missed.reshape(mask.size, -1)
    return float(by_colour.mean() / mask.sum())


def best_flow(
    reference: F32, image: F32, mask: F32, via: list[tuple[F32, F32]], match: Matcher
) -> F32:
    """The flow reference -> image that explains the image best: direct, or through a waypoint.

    via: waypoints as (waypoint image, flow reference -> waypoint).
    """
    flows = [match(reference, image)]
    flows += [concatenate(to_waypoint, match(waypoint, image)) for waypoint, to_waypoint in via]
    return best_of(reference, image, mask, flows)


def best_of(reference: F32, image: F32, mask: F32, flows: Sequence[F32]) -> F32:
    """That of several flows reference -> image which explains the image best."""
    errors = [explanation_error(reference, image, f, mask) for f in flows]
    return flows[int(np.argmin(errors))]


def shortest_paths(coordinates: NDArray[np.floating[Any]], start: int) -> NDArray[np.int64]:
    """Predecessor of every frame on its shortest path from `start`, shape (N,); `start`: -1.

    Dijkstra on the graph of the `NEIGHBOURS` nearest frames; an edge is as long as the Euclidean
    distance of the whitened PCA coordinates, shape (N, d), which is Mahalanobis. Parts of the graph
    that do not touch are joined by an edge from `start`.
    """
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import dijkstra
    from scipy.spatial import cKDTree

    n = len(coordinates)
    distance, neighbour = cKDTree(coordinates).query(coordinates, k=min(NEIGHBOURS + 1, n))
    distance, neighbour = distance.reshape(n, -1), neighbour.reshape(n, -1)
    rows = np.repeat(np.arange(n), neighbour.shape[1])
    lengths = distance.ravel() + 1e-9  # equal frames still need an edge
    edges = csr_matrix((lengths, (rows, neighbour.ravel())), shape=(n, n))
    length, before = dijkstra(edges, directed=False, indices=start, return_predecessors=True)
    before = np.asarray(before, np.int64)
    before[~np.isfinite(length)] = start
    before[start] = -1
    return before


def path_to(target: int, before: NDArray[np.int64]) -> list[int]:
    """Frames from the start of `before` (see `shortest_paths`) to `target`, both included."""
    path = [target]
    while before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return path[::-1]


def extend_flows(
    flows: dict[int, F32], path: Sequence[int], steps: Mapping[tuple[int, int], F32]
) -> None:
    """Add the flows from the first frame of `path` to all its frames that `flows` lacks.

    They are concatenated from `steps`, flows between frames; paths of one tree share them.
    """
    for a, b in pairwise(path):
        if b not in flows:
            flows[b] = concatenate(flows[a], steps[a, b]) if a in flows else steps[a, b]
