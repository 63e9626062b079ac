"""Principal components of few rows with many columns, by the Gram matrix of the rows.

Rows may lie in several blocks side by side (shapes in one, textures in the other): the Gram matrix
of both together is the sum of theirs. Nothing is centred here.

    G = sum_b B_b B_b' = S U diag(v) U',   modes of block b = diag(S v)^(-1/2) U' B_b

with S rows and variances v. Over all blocks the modes are orthonormal.

Source: Turk & Pentland, "Eigenfaces for recognition" (J. Cognitive Neuroscience 3, 1991).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LEAST = 1e-10  # of the first variance: less is rounding
PART = 8192  # columns multiplied at a time in float64


@dataclass(frozen=True)
class Components:
    """axes: U, (S, r). variance: v, (r,), falling; r is the rank of the rows."""

    axes: Floats
    variance: Floats

    def modes(self, block: NDArray[np.floating], count: int) -> Floats:
        """The first `count` modes of a block (S, D): (count, D)."""
        scale = np.sqrt(len(self.axes) * self.variance[:count])
        turned = np.asarray((self.axes[:, :count] / scale).T, np.float64)
        parts = [turned @ block[:, a : a + PART] for a in range(0, block.shape[1], PART)]
        return np.concatenate(parts, axis=1)

    def count_for(self, share: float) -> int:
        """How many components have at least `share` of the variance."""
        total = np.cumsum(self.variance) / self.variance.sum()
        return min(int((total < share).sum()) + 1, len(total))

    def share_of(self, count: int) -> float:
        """The share of the variance that the first `count` components have."""
        return float(self.variance[:count].sum() / self.variance.sum())


def gram_of(block: NDArray[np.floating]) -> Floats:
    """B B' of rows (S, D), summed in float64: (S, S)."""
    gram = np.zeros((len(block), len(block)))
    for a in range(0, block.shape[1], PART):
        part = block[:, a : a + PART].astype(np.float64)
        gram += part @ part.T
    return gram


def principal_components(gram: Floats) -> Components:
    """Components of rows that are differences from their mean, by their Gram matrix (S, S).

    Each axis has the sign that makes its largest entry positive. Rows that do not differ have no
    components.
    """
    values, axes = np.linalg.eigh(gram)
    values, axes = values[::-1], axes[:, ::-1]
    real = values > LEAST * max(values[0], 0)
    axes = axes[:, real]
    largest = np.take_along_axis(axes, np.abs(axes).argmax(axis=0)[None], axis=0)
    return Components(axes * np.sign(largest), values[real] / len(gram))
