"""Mouths of the built-in performer at any size: lifelike pictures and flows, without video.

The performer is drawn small and enlarged, for drawing takes much longer than what is measured.
"""

import functools

import cv2
import numpy as np

from mmmgpu.alignments import Segment
from mmmgpu.basis import make_basis
from mmmgpu.flows import matcher
from mmmgpu.performer import articulate, landmarks, performer, render
from mmmgpu.regions import region_around, region_from_box

SEED = 23  # the performer of the demo
DRAWN = 112  # [px] height and width that it is drawn at
PHONES = (
    *("SIL", "B", "IY", "M", "AA", "W", "UW", "F", "AE", "L", "OW", "S", "EH", "P", "AH", "D"),
    *("IY", "SH", "UW", "K", "AA", "N", "EY", "V", "ER", "G", "AE", "T", "OW", "SIL"),
)


@functools.cache
def drawn_mouths(number, side):
    """`number` different mouths, (number, side, side, 3) float32 in [0, 1]; the first is shut."""
    face = performer(SEED, size=(DRAWN, DRAWN))
    times = np.linspace(0, number / 25, len(PHONES) + 1)
    said = [Segment(phone, *t) for phone, *t in zip(PHONES, times, times[1:], strict=False)]
    motion = articulate(face, said, number, 25.0, np.random.default_rng(SEED))
    motion.pose[:] = 0
    lips = landmarks(face, motion, 0)[:20]
    mouth = (*lips.mean(axis=0), np.ptp(lips[:, 0]))
    x, y, w, h = region_around(mouth, (DRAWN, DRAWN)).box
    small = [f[y : y + h, x : x + w].astype(np.float32) / 255 for f in render(face, motion)]
    size = (side, side)
    return np.stack([cv2.resize(f, size, interpolation=cv2.INTER_LINEAR) for f in small])


@functools.cache
def drawn_basis(prototypes, side):
    """A basis of the first of them; its flows are those of dense inverse search."""
    images = drawn_mouths(prototypes, side)
    match = matcher("dis")
    flows = np.stack([match(images[0], image) for image in images])
    region = region_from_box((0, 0, side, side), (side, side))
    return make_basis(images, flows, 0, region)


def drawn_coordinates(prototypes, frames, *, shares=5.0, seed=0):
    """alpha (frames, M - 1) and beta (frames, M), all above zero; smaller `shares`: few large."""
    rng = np.random.default_rng(seed)
    alpha, beta = (rng.dirichlet(np.full(prototypes, shares), frames) for _ in range(2))
    return alpha[:, 1:], beta
