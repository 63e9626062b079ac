"""A drawn person with known landmarks, and an appearance model of all but one of the clips."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pairs import write_landmarks

from mmmgpu.aam_training import fit_aam
from mmmgpu.appearances import Aam
from mmmgpu.landmarks import read_landmarks
from mmmgpu.videos import read_frames

PARAMETERS = 10


@dataclass(frozen=True)
class Drawn:
    """aam: of `clips`. held_out: a clip that it was not made of. folder: of the landmarks."""

    aam: Aam
    clips: tuple[Path, ...]
    held_out: Path
    folder: Path

    def points(self, clip):
        """The landmarks (T, N, 2) [px] that the model uses."""
        return read_landmarks(self.folder, clip)[:, list(self.aam.rows)]

    def frame(self, clip, t):
        """One frame (H, W, 3)."""
        return next(read_frames(clip, start=t, stop=t + 1))


def make_drawn_aam(world):
    write_landmarks(world)
    clips, folder = world.clips[:-1], world.alignments
    aam = fit_aam(clips, folder, parameters=PARAMETERS)
    return Drawn(aam, clips, world.clips[-1], folder)


def random_features(aam, count, *, seed=0):
    """Features (T, n) such as the model's frames have."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, len(aam.variance))) * np.sqrt(aam.variance)


def with_few_textures(aam, count):
    """The model with fewer texture modes for fitting."""
    return replace(
        aam,
        texture_modes=aam.texture_modes[:count],
        texture_variance=aam.texture_variance[:count],
    )
