"""Pictures channel by channel, in rows padded to whole vectors: what kernels/prototypes reads.

A picture (h, w, C) becomes planes (C, h, pitch). What pads a row counts nowhere.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]

LANES = 16  # floats of a vector, as in the kernels


def pitch_of(width: int) -> int:
    """Pixels of a padded row."""
    return -(-width // LANES) * LANES


def planes(pictures: NDArray[Any]) -> NDArray[Any]:
    """Pictures (..., h, w, C) as planes (..., C, h, pitch), padded with 0."""
    *batch, h, w, channels = pictures.shape
    padded = np.zeros((*batch, channels, h, pitch_of(w)), pictures.dtype)
    padded[..., :w] = np.moveaxis(pictures, -1, -3)
    return padded


def picture(planes: F32, width: int) -> F32:
    """Planes (C, h, pitch) as a picture (h, width, C), for C > 1."""
    return np.asarray(cv2.merge(list(planes[..., :width])), np.float32)
