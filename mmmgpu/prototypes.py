"""The choice of prototypes: PCA of the mouth, k-means, the real frame nearest to each centre.

Frames are compared as small masked pictures ("thumbnails"); whitened PCA coordinates make the
Euclidean distance of k-means the Mahalanobis distance (docs/model.md, after EGP02).
"""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from mmmgpu.errors import InputError

Floats = NDArray[np.float64]

COMPONENTS = 15
LEAST_VARIANCE = 1e-9  # of the first component's: less is rounding, not to be whitened


def principal_coordinates(thumbnails: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
    """Whitened PCA coordinates of every frame of every clip, stacked: (N, 15 at most).

    thumbnails: one array (T, k) a clip; they are read twice, one after the other, never all at once
    (give a lazy sequence for a long corpus).
    """
    from sklearn.decomposition import IncrementalPCA

    first = len(thumbnails[0][0])
    components = min(COMPONENTS, first, sum(len(t) for t in thumbnails))
    pca = IncrementalPCA(components, whiten=True)
    for batch in _batches(thumbnails, components):
        pca.partial_fit(batch)
    variance = pca.explained_variance_
    real = max(1, int((variance > LEAST_VARIANCE * variance[0]).sum()))
    parts = [pca.transform(np.asarray(t, np.float64))[:, :real] for t in thumbnails if len(t)]
    return np.concatenate(parts).astype(np.float32)


def _batches(thumbnails: Iterable[NDArray[np.uint8]], least: int) -> Iterable[Floats]:
    """Clips joined until a batch has four times `least` frames; a short rest joins the last."""
    held: list[Floats] = []
    ready: Floats | None = None
    for thumbnail in thumbnails:
        held.append(np.asarray(thumbnail, np.float64))
        if sum(len(h) for h in held) >= 4 * least:
            if ready is not None:
                yield ready
            ready, held = np.concatenate(held), []
    rest = ([] if ready is None else [ready]) + held
    yield np.concatenate(rest)


def choose_prototypes(
    coordinates: NDArray[np.float32], count: int, *, seed: int
) -> NDArray[np.int64]:
    """The `count` frames nearest to the k-means centres of (N, d) coordinates, sorted, distinct.

    Raises:
        InputError: There are fewer frames than prototypes.
    """
    from sklearn.cluster import KMeans

    if len(coordinates) < count:
        raise InputError(
            f"{len(coordinates)} usable frames are too few for {count} prototypes; "
            "give more video or --prototypes a smaller number"
        )
    centres = KMeans(count, n_init=4, random_state=seed).fit(coordinates).cluster_centers_
    chosen: list[int] = []
    for centre in centres:
        order = np.argsort(((coordinates - centre) ** 2).sum(axis=1))
        chosen.append(next(int(i) for i in order if int(i) not in chosen))
    return np.array(sorted(chosen))


def most_neutral(
    coordinates: NDArray[np.float32], chosen: NDArray[np.int64], silent: NDArray[np.bool_]
) -> int:
    """Which of `chosen` is nearest to the typical silent frame: the reference (index into it).

    silent: frames without speech, (N,); where there are none all frames count.
    """
    typical = np.median(coordinates[silent] if silent.any() else coordinates, axis=0)
    return int(((coordinates[chosen] - typical) ** 2).sum(axis=1).argmin())
