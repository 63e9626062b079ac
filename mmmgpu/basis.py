"""The multidimensional morphable model proper: prototypes, their flows, and where they count."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mmmgpu.regions import Region, cover_mask, lip_mask, mouth_mask

F32 = NDArray[np.float32]

LIP, MOUTH = 0.02, 0.01  # least w_f and w_t of a pixel that counts
MARGIN = 4  # [px] kept around the pixels that count


@dataclass(frozen=True)
class Basis:
    """Prototype images I_i and flows C_i of one person's mouth region (CE05, Eq. 1-2).

    images: (M, h, w, 3) RGB in [0, 1].
    flows: (M, h, w, 2) [px] from the reference to each prototype; that of the reference is 0.
    reference: which prototype is the reference.
    region: where the prototypes lie in the reference frame.
    w_f: lip mask, (h, w) in [0, 1]: where flows are compared.
    w_t: mouth mask, (h, w) in [0, 1]: where textures are compared.
    cover: (h, w) in [0, 1]: how much of the model a composite shows.
    """

    images: F32
    flows: F32
    reference: int
    region: Region
    w_f: F32
    w_t: F32
    cover: F32

    @property
    def moving(self) -> NDArray[np.int64]:
        """The prototypes other than the reference: the M - 1 dimensions of alpha."""
        return np.delete(np.arange(len(self.images)), self.reference)

    def flow(self, alpha: NDArray[np.floating]) -> F32:
        """Eq. 1: ``C_syn = sum_i alpha_i C_i``; alpha (M - 1,) -> (h, w, 2) [px]."""
        weights = np.insert(alpha, self.reference, 0.0).astype(np.float32)
        summed: F32 = np.tensordot(weights, self.flows, axes=1)
        return summed


def around(counts: NDArray[np.bool_]) -> tuple[slice, slice]:
    """The rows and columns that hold the pixels that count, (h, w), with a margin."""
    rows, columns = np.nonzero(counts)
    h, w = counts.shape
    return (
        slice(max(0, int(rows.min()) - MARGIN), min(h, int(rows.max()) + 1 + MARGIN)),
        slice(max(0, int(columns.min()) - MARGIN), min(w, int(columns.max()) + 1 + MARGIN)),
    )


def still_outside(flows: F32, cover: F32) -> F32:
    """`flows` (..., h, w, 2) fading to 0 where `cover` (h, w) does: outside, the head is rigid."""
    return np.asarray(flows * np.minimum(1, 2 * cover)[..., None], np.float32)


def part_of(region: Region, inside: tuple[slice, slice]) -> Region:
    """The rows and columns `inside` of a region."""
    (top, bottom), (left, right) = ((s.start, s.stop) for s in inside)
    box = (region.box[0] + left, region.box[1] + top, right - left, bottom - top)
    return Region(box, region.mouth)


def cut(basis: Basis, inside: tuple[slice, slice]) -> Basis:
    """The rows and columns `inside` of a basis."""
    return Basis(
        np.ascontiguousarray(basis.images[:, inside[0], inside[1]]),
        np.ascontiguousarray(basis.flows[:, inside[0], inside[1]]),
        basis.reference,
        part_of(basis.region, inside),
        *(np.ascontiguousarray(mask[inside]) for mask in (basis.w_f, basis.w_t, basis.cover)),
    )


def make_basis(images: F32, flows: F32, reference: int, region: Region) -> Basis:
    """A `Basis` whose flows fade to 0 where its cover does, with the masks of `region`."""
    cover = cover_mask(region)
    still = still_outside(flows, cover)
    still[reference] = 0
    w_f, w_t = lip_mask(region), mouth_mask(region)
    return Basis(images, still, reference, region, w_f, w_t, cover)
