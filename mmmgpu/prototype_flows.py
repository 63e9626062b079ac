"""From chosen frames to a basis: their pictures, and their flows from the reference frame."""

import numpy as np
from numpy.typing import NDArray

from mmmgpu.basis import Basis, make_basis
from mmmgpu.corpus_steps import Frames
from mmmgpu.flows import best_flow, extend_flows, matcher, path_to, shortest_paths
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
    images = frames.crops(sorted({i for path in paths.values() for i in path}), region)
    flows = []
    walked: dict[int, F32] = {}
    for i, path in progress(list(paths.items()), "prototype flows"):
        via = []
        if len(path) > 2:
            extend_flows(walked, path[:-1], images, match)
            via.append((images[path[-2]], walked[path[-2]]))
        flows.append(best_flow(images[origin], images[i], mask, via, match))
    stacked = np.stack([images[int(i)] for i in chosen])
    place = int(np.flatnonzero(chosen == origin)[0])
    return make_basis(stacked, np.stack(flows), place, region)
