"""The record of one learned person, and what every reader of it needs."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmmgpu.basis import Basis
from mmmgpu.phones import stand_in
from mmmgpu.tracks import Reference, Track
from mmmgpu.trajectories import synthesize_trajectory
from mmmgpu.trajectory_training import TrainedStream

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Calm:
    """The background that the model brings along: the stillest clip it was trained on.

    data: the encoded file, as it was given, shape (n,) uint8.
    suffix: its file name suffix, with the dot.
    track: its poses and exposure.
    """

    data: NDArray[np.uint8]
    suffix: str
    track: Track


@dataclass(frozen=True)
class Model:
    """A person's mouth and how it moves with each phone.

    basis: prototypes and flows (Eq. 1-2).
    reference: what new clips are registered to.
    alpha, beta: phoneme models of movement (M - 1 dimensions) and texture (M) (Eq. 3-5).
    fps: frames a second at which the phoneme models hold.
    prototype_frames: the full pictures the prototypes were cut from, (M, H, W, 3) uint8.
    sources: clip name and frame number of every prototype.
    calm: background for `speak`.
    notes: what training found and chose, for reports; plain JSON values.
    """

    basis: Basis
    reference: Reference
    alpha: TrainedStream
    beta: TrainedStream
    fps: Fraction
    prototype_frames: NDArray[np.uint8]
    sources: tuple[tuple[str, int], ...]
    calm: Calm
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def frame_size(self) -> tuple[int, int]:
        """(width, height) [px] of the video that the model was trained on."""
        return self.prototype_frames.shape[2], self.prototype_frames.shape[1]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model to one safetensors file."""
        from mmmgpu.model_files import save_model

        save_model(self, path)


def trajectories(
    model: Model, labels: Sequence[str], *, trained: bool = True
) -> tuple[Floats, Floats]:
    """Eq. 3 for both streams: alpha (T, M - 1) and beta (T, M) of a row of phones.

    labels: phone of every frame at `model.fps`, length T.
    trained: False uses the pooled estimates in place of the trained ones.
    """
    streams = []
    for stream in (model.alpha, model.beta):
        streams.append(
            synthesize_trajectory(
                stream.trained if trained else stream.pooled,
                labels,
                smoothness=stream.smoothness,
                order=stream.constants.order,
                stand_in=stand_in,
            )
        )
    return streams[0], streams[1]


def project_on_simplex(beta: Floats) -> Floats:
    """The nearest rows with b >= 0 and sum b = 1; (T, M) -> (T, M) (Held, Wolfe & Crowder 1974)."""
    ranked = -np.sort(-beta, axis=1)
    excess = np.cumsum(ranked, axis=1) - 1
    count = (ranked > excess / np.arange(1, beta.shape[1] + 1)).sum(axis=1)
    shift = excess[np.arange(len(beta)), count - 1] / count
    return np.asarray(np.maximum(beta - shift[:, None], 0))
