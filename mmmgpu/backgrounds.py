"""The video that a synthetic mouth is put on, made as long as the speech."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mmmgpu.files import write_bytes
from mmmgpu.models import Model
from mmmgpu.tracks import Track, track_clip
from mmmgpu.videos import probe, read_frames

BYTES_KEPT = 128 * 2**20  # of frames, to go back over when the speech is longer than the background


@dataclass(frozen=True)
class Background:
    """A clip and how it is seen from the model's reference."""

    path: Path
    fps: Fraction
    track: Track


@contextmanager
def open_background(model: Model, path: Path | None) -> Iterator[Background]:
    """The clip at `path`, registered; without one, the model's own calm clip.

    Raises:
        InputError: The clip cannot be read, or the model's head is not found in it.
    """
    if path is not None:
        fps = probe(path, minimum_frames=2).fps
        yield Background(path, fps, track_clip(path, model.reference))
        return
    with tempfile.TemporaryDirectory(prefix="mmmgpu-") as folder:
        own = Path(folder) / f"calm{model.calm.suffix}"
        write_bytes(own, model.calm.data.tobytes())
        yield Background(own, probe(own).fps, model.calm.track)


def extended(background: Background, length: float) -> Iterator[tuple[NDArray[np.uint8], int]]:
    """Yield `length` frames with their numbers: forth, then back and forth over the last ones.

    `length` may be infinite.

    Going back over the frames just seen has no jump. As many are kept as `BYTES_KEPT` holds.
    """
    kept: list[tuple[NDArray[np.uint8], int]] = []
    shown = 0
    for t, frame in enumerate(read_frames(background.path)):
        if shown == length:
            return
        kept.append((frame, t))
        if len(kept) > max(2, BYTES_KEPT // frame.nbytes):
            kept.pop(0)
        yield frame, t
        shown += 1
    there_and_back = kept[-2:0:-1] + kept  # the turning points are not shown twice
    while shown < length:
        for item in there_and_back:
            if shown == length:
                return
            yield item
            shown += 1
