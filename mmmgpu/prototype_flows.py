"""From chosen frames to a basis: their pictures, and their flows from the reference frame."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mmmgpu.backends import default_threads
from mmmgpu.basis import Basis, make_basis
from mmmgpu.flows import best_of, extend_flows, matcher, path_to, shortest_paths
from mmmgpu.frames import Frames
from mmmgpu.parallel import Cancelled, map_ordered
from mmmgpu.progress import progress
from mmmgpu.regions import Region, mouth_mask

F32 = NDArray[np.float32]


def prototype_basis(
    frames: Frames,
    region: Region,
    chosen: NDArray[np.int64],
    origin: int,
    coordinates: F32,
    *,
    flow: str,
) -> Basis:
    """The basis of the frames `chosen`, each flow direct or along the path of similar frames.

    chosen: numbers of frames, (M,), `origin`, the reference, among them.
    coordinates: of all frames, as `prototypes.principal_coordinates`.
    flow: one of `flows.MATCHERS`.
    """
    match, mask = matcher(flow), mouth_mask(region)
    before = shortest_paths(coordinates, origin)
    paths = {int(i): path_to(int(i), before) for i in chosen}
    images = frames.crops({i for path in paths.values() for i in path}, region)
    pairs = [(origin, i) for i in paths] + [p for path in paths.values() for p in pairwise(path)]

    def step(pair: tuple[int, int], _: Cancelled) -> F32:
        return match(images[pair[0]], images[pair[1]])

    pairs = list(dict.fromkeys(pairs))
    found = map_ordered(step, pairs, threads=default_threads())
    steps = dict(zip(pairs, progress(found, "prototype flows", total=len(pairs)), strict=True))
    flows = []
    walked: dict[int, F32] = {}
    for i, path in paths.items():
        extend_flows(walked, path, steps)
        candidates = [steps[origin, i], *([walked[i]] if len(path) > 2 else [])]
        flows.append(best_of(images[origin], images[i], mask, candidates))
    stacked = np.stack([images[int(i)] for i in chosen])
    place = int(np.flatnonzero(chosen == origin)[0])
    return make_basis(stacked, np.stack(flows), place, region)
