"""Trajectories of model coordinates, and their CSV files for editing by hand.

One row a frame: time [s], phone, alpha of every prototype but the reference, beta of every one.
"""

import csv
import io
import os
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mmmgpu.errors import InputError
from mmmgpu.files import write_text

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Trajectory:
    """What the mouth does: one row a frame.

    labels: phone of each frame, length T.
    alpha: movement, (T, M - 1). beta: texture, (T, M), rows >= 0 that sum to 1.
    fps: frames a second.
    """

    labels: tuple[str, ...]
    alpha: Floats
    beta: Floats
    fps: Fraction

    def __len__(self) -> int:
        return len(self.labels)


def write_trajectory(trajectory: Trajectory, path: str | os.PathLike[str]) -> None:
    """Write a trajectory as CSV."""
    m = trajectory.beta.shape[1]
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    names = [f"alpha{i}" for i in range(m - 1)] + [f"beta{i}" for i in range(m)]
    rows.writerow(["time", "phone", *names])
    for t, label in enumerate(trajectory.labels):
        values = [*trajectory.alpha[t], *trajectory.beta[t]]
        time = float(t / trajectory.fps)
        rows.writerow([f"{time:.4f}", label, *(f"{value:.6g}" for value in values)])
    write_text(path, text.getvalue())


def read_trajectory(path: str | os.PathLike[str], prototypes: int, fps: Fraction) -> Trajectory:
    """Read a trajectory for a model of so many `prototypes` at `fps` frames a second.

    Raises:
        InputError: No such file, a wrong number of columns, a value that is no finite number, beta
            below 0 or all 0. A beta that does not sum to 1 is scaled.
    """
    path = Path(path)
    columns = 2 + 2 * prototypes - 1
    try:
        rows = list(csv.reader(io.StringIO(path.read_text("utf-8"))))
    except (OSError, UnicodeDecodeError, csv.Error) as e:
        raise InputError(f"{path}: cannot be read as CSV ({e}); give a saved trajectory") from e
    if len(rows) < 2:
        raise InputError(f"{path}: has no frames; give a trajectory saved by speak")
    values = np.array([_numbers(path, n, row, columns) for n, row in enumerate(rows[1:], start=2)])
    alpha, beta = values[:, : prototypes - 1], values[:, prototypes - 1 :]
    bad = np.flatnonzero((beta < 0).any(axis=1) | (beta.sum(axis=1) <= 0))
    if bad.size:
        raise InputError(f"{path}:{bad[0] + 2}: beta must be >= 0 and not all 0; correct the row")
    labels = tuple(row[1] for row in rows[1:])
    return Trajectory(labels, alpha, beta / beta.sum(axis=1, keepdims=True), fps)


def _numbers(path: Path, line: int, row: list[str], columns: int) -> list[float]:
    if len(row) != columns:
        raise InputError(
            f"{path}:{line}: has {len(row)} columns, this model needs {columns}; "
            "use a trajectory that was saved with the same model"
        )
    try:
        values = [float(cell) for cell in row[2:]]
    except ValueError as e:
        raise InputError(f"{path}:{line}: {e}; correct the row") from e
    if not np.isfinite(values).all():
        raise InputError(f"{path}:{line}: holds NaN or infinity; correct the row")
    return values
