"""The record of one learned person, and what every reader of it needs."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmmgpu.basis import Basis
from mmmgpu.dynamics import Dynamics, trajectory
from mmmgpu.errors import InputError
from mmmgpu.phonemes import PhonemeModels
from mmmgpu.phones import stand_in
from mmmgpu.tracked_clips import TrackedClip
from mmmgpu.tracks import Reference, Track
from mmmgpu.trajectories import synthesize_trajectory
from mmmgpu.trajectory_training import TrainedStream

Floats = NDArray[np.float64]

REGULARISED = "egp02"  # the trajectories of Eq. 3, which every model has


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
    alternatives: by name, the means (P, M - 1) and (P, M) that other ways of adaptation gave, for
        comparison; all else of the phoneme models is that of the trained ones.
    dynamics: by name (`mmmgpu.dynamics.MODELS`), other models of alpha and of beta.
    tracked: by name, the clips of a transfer or an adaptation, and their tracks.
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
    alternatives: dict[str, tuple[Floats, Floats]] = field(default_factory=dict)
    dynamics: dict[str, tuple[Dynamics, Dynamics]] = field(default_factory=dict)
    tracked: dict[str, TrackedClip] = field(default_factory=dict)

    @property
    def frame_size(self) -> tuple[int, int]:
        """(width, height) [px] of the video that the model was trained on."""
        return self.prototype_frames.shape[2], self.prototype_frames.shape[1]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model to one safetensors file."""
        from mmmgpu.model_files import save_model

        save_model(self, path)


def trajectories(
    model: Model, labels: Sequence[str], *, kind: str = "trained"
) -> tuple[Floats, Floats]:
    """Eq. 3 for both streams: alpha (T, M - 1) and beta (T, M) of a row of phones.

    labels: phone of every frame at `model.fps`, length T.
    kind: "trained"; "pooled", the estimates before training; or one of `model.alternatives`.
    """
    alpha, beta = (
        synthesize_trajectory(
            models,
            labels,
            smoothness=stream.smoothness,
            order=stream.constants.order,
            stand_in=stand_in,
        )
        for models, stream in zip(phonemes_of(model, kind), (model.alpha, model.beta), strict=True)
    )
    return alpha, beta


def moved_by(model: Model, labels: Sequence[str], movement: str) -> tuple[Floats, Floats]:
    """alpha (T, M - 1) and beta (T, M) of a row of phones, T >= 1, by one of the model's movements.

    movement: `REGULARISED`, or one of `model.dynamics`. In place of a phone that it has not seen
        goes the one that looks most like it.

    Raises:
        InputError: The model has no such movement.
    """
    if movement == REGULARISED:
        return trajectories(model, labels)
    known = frozenset(labels_known(model, movement))
    said = [stand_in(label, known) for label in labels]
    alpha, beta = model.dynamics[movement]
    return trajectory(alpha, said), trajectory(beta, said)


def labels_known(model: Model, movement: str) -> tuple[str, ...]:
    """The phones that one of the model's movements has seen; arguments and errors of `moved_by`."""
    if movement == REGULARISED:
        return model.alpha.trained.labels
    if movement not in model.dynamics:
        has = ", ".join([REGULARISED, *sorted(model.dynamics)])
        raise InputError(
            f"trajectory {movement!r}: the model has only {has}; use one of them or train it again"
        )
    return model.dynamics[movement][0].labels


def phonemes_of(model: Model, kind: str = "trained") -> tuple[PhonemeModels, PhonemeModels]:
    """The Gaussians of alpha and of beta; for `kind` see `trajectories`."""
    if kind == "pooled":
        return model.alpha.pooled, model.beta.pooled
    alpha, beta = model.alpha.trained, model.beta.trained
    if kind == "trained":
        return alpha, beta
    means = model.alternatives[kind]
    return replace(alpha, mean=means[0]), replace(beta, mean=means[1])


def project_on_simplex(beta: Floats) -> Floats:
    """The nearest rows with b >= 0 and sum b = 1; (T, M) -> (T, M) (Held, Wolfe & Crowder 1974)."""
    ranked = -np.sort(-beta, axis=1)
    excess = np.cumsum(ranked, axis=1) - 1
    count = (ranked > excess / np.arange(1, beta.shape[1] + 1)).sum(axis=1)
    shift = excess[np.arange(len(beta)), count - 1] / count
    return np.asarray(np.maximum(beta - shift[:, None], 0))
