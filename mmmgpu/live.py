"""Labels in, pictures out: a mouth that moves while its words are still being made.

Every frame comes as soon as its label does, and memory does not grow. So only those movements will
do that need nothing of what follows: `hmm`, `slds` and `dpds` of `mmmgpu.dynamics`.
"""

import math
from collections.abc import Iterable, Iterator
from itertools import tee

import numpy as np
from numpy.typing import NDArray

from mmmgpu.backgrounds import extended, open_background
from mmmgpu.compositing import composite_matched, looked_at
from mmmgpu.errors import InputError
from mmmgpu.models import Model, labels_known, project_on_simplex
from mmmgpu.phones import stand_in
from mmmgpu.speaking import check_articulation, focused, scale_about, silent_mouth
from mmmgpu.synthesis import mouths, prepare_synthesis

Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]


def live(
    model: Model,
    labels: Iterable[str],
    *,
    movement: str = "dpds",
    articulation: float = 1.0,
    backend: str = "warp",
) -> Iterator[Picture]:
    """Yield a frame (H, W, 3) RGB for each label, on the model's own background.

    Frames are quickest within `mmmgpu.parallel.one_thread_each`: each is small.

    Args:
        model: A trained model.
        labels: The phone of every frame at `model.fps`; they may have no end. In place of one that
            the model has not seen goes the one that looks most like it.
        movement: One of `model.dynamics` that makes a frame of each label alone.
        articulation: Scales the movement about the silent mouth, 0.5 to 1.5.
        backend: A name for `mmmgpu.backends.get_backend`.

    Raises:
        InputError: The model has no such movement, or it needs the labels that follow;
            `articulation` is outside 0.5 to 1.5. Raised before the first label is taken.
    """
    alpha, beta = live_coordinates(model, labels, movement=movement, articulation=articulation)
    shown = looked_at(model.basis.cover)
    synthesizer = prepare_synthesis(model.basis, shown=shown, backend=backend)
    return _on_background(model, mouths(synthesizer, alpha, beta, batch=1))


def live_coordinates(
    model: Model, labels: Iterable[str], *, movement: str, articulation: float
) -> tuple[Iterator[Floats], Iterator[Floats]]:
    """alpha (M - 1,) and beta (M,) of each label; arguments and errors of `live`.

    The two are to be taken in turns.
    """
    check_articulation(articulation)
    known = frozenset(labels_known(model, movement))
    streams = model.dynamics.get(movement)
    if streams is None or not streams[0].comparable:
        found = sorted(name for name, pair in model.dynamics.items() if pair[0].comparable)
        raise InputError(
            f"trajectory {movement!r} needs the labels that follow; for a stream of labels use one "
            f"of {', '.join(found) or 'hmm, slds, dpds (train the model again)'}"
        )
    rows = tee(stand_in(label, known) for label in labels)
    silent = silent_mouth(model)
    alpha = (scale_about(a, silent[0], articulation) for a in streams[0].generate(rows[0]))
    beta = (scale_about(b, silent[1], articulation) for b in streams[1].generate(rows[1]))
    return alpha, (focused(project_on_simplex(b[None]))[0] for b in beta)


def _on_background(model: Model, images: Iterator[NDArray[np.float32]]) -> Iterator[Picture]:
    basis = model.basis
    with open_background(model, None) as background:
        track = background.track
        pairs = zip(images, extended(background, math.inf), strict=False)
        for i, (image, (frame, t)) in enumerate(pairs):
            rng, pose = np.random.default_rng(i), track.poses[t]
            yield composite_matched(frame, image, basis.cover, pose, track, basis.region, rng)
