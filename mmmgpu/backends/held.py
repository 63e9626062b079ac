"""Prototypes that stay on a device."""

from dataclasses import dataclass
from typing import Any

from mmmgpu.backends.planes import pitch_of

MARGIN = 40  # pixels of a row of sums beside the picture, as in kernels/rings


@dataclass(frozen=True)
class Prototypes:
    """Prototypes of height x width pixels on a device.

    arrays: As the kernels of kernels/prototypes take them, from `textures` to `row_shares`.
    number, height, width: M and the size of a prototype.
    nodes: See `mmmgpu.backends.orientation.Orientations`.
    hole: Less weight makes a pixel a hole.
    """

    arrays: tuple[Any, ...]
    number: int
    height: int
    width: int
    nodes: int
    hole: float

    @property
    def pitch(self) -> int:
        """Pixels of a padded row."""
        return pitch_of(self.width)

    @property
    def ring(self) -> int:
        """Rows of sums for any flow: a power of two, not less than the height."""
        return 1 << (self.height - 1).bit_length()

    @property
    def pyramid(self) -> int:
        """Cells of all levels of a picture but the finest, in padded rows."""
        height, width = (self.height + 1) // 2, (self.width + 1) // 2
        size = height * pitch_of(width)
        while (height, width) != (1, 1):
            height, width = (height + 1) // 2, (width + 1) // 2
            size += height * pitch_of(width)
        return size
