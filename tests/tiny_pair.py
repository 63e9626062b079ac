"""A with 5 prototypes and B with 7 frames, of a few hundred pixels, at random: for slow oracles."""

from functools import cache
from types import SimpleNamespace

import cv2
import numpy as np
from worlds import texture

from mmmgpu.basis import Basis
from mmmgpu.correspondence import rbf_correspondence
from mmmgpu.flow_matching import View
from mmmgpu.regions import Region, lip_mask, mouth_mask

COUNT, FRAMES = 5, 7


def smooth_flows(rng, count, h, w, size=2.0):
    """Random smooth flows, (count, h, w, 2) float32, of about `size` px; the first is none."""
    flows = [
        cv2.GaussianBlur(rng.standard_normal((h, w, 2)).astype(np.float32), (0, 0), 4)
        for _ in range(count)
    ]
    made = np.stack([size * f / np.abs(f).max() for f in flows])
    made[0] = 0
    return made.astype(np.float32)


def basis_of(images, flows, region):
    mouth = mouth_mask(region)
    return Basis(images, flows, 0, region, lip_mask(region), mouth, mouth)


@cache
def tiny_pair():
    """A of 5 prototypes, B of 7 frames in pictures of other sizes, and two views of them."""
    rng = np.random.default_rng(0)
    a, b = Region((0, 0, 22, 18), (10.5, 8.0, 9.0)), Region((0, 0, 25, 21), (12.0, 9.5, 11.0))
    pictures = [
        np.stack([texture(*r.shape, seed=10 * i + n) for n in range(number)])
        for i, (r, number) in enumerate(((a, COUNT), (b, FRAMES)))
    ]
    views = []
    for _ in range(2):
        marks = np.array([[2, 2], [9, 3], [18, 2], [4, 9], [11, 8], [17, 10], [6, 15], [14, 16.0]])
        marks += rng.uniform(-1, 1, marks.shape)
        moved = 1.15 * marks + rng.normal(0, 0.3, marks.shape)
        flows = (smooth_flows(rng, n, *r.shape) for r, n in ((a, COUNT), (b, FRAMES)))
        views.append(View(rbf_correspondence(marks, moved), *flows))
    source = basis_of(pictures[0], views[0].flows_a, a)
    target = basis_of(pictures[1], views[0].flows_b, b)
    return SimpleNamespace(
        source=source, target=target, views=views, view=np.array([0, 1, 1, 0, 0])
    )
