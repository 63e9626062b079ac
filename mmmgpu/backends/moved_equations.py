"""Normal equations of prototypes moved along a flow, a band of rows at a time, without pictures."""

import math
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmmgpu.arrays import F32, check_some_valid
from mmmgpu.backends.held import MARGIN, Prototypes
from mmmgpu.backends.launches import COLOURS, PIECE, Launches
from mmmgpu.backends.planes import LANES

BAND = 48  # rows of all moved prototypes at a time
RING = 32  # rows of sums of each, at first
ASIDE = 4  # of so many pixels one can be set aside, at first

Shape = tuple[tuple[int, ...], Any]


def moved_equations(
    k: Launches, held: Prototypes, flow: F32, used: NDArray[np.int64], wanted: Any, scale: Any
) -> Any:
    """`Backend.prototype_equations`: again with more room where that was too little."""
    if not len(used):
        return k.empty(1, 0)
    padded = k.to_device(np.pad(flow.ravel(), LANES))
    given = padded, k.to_device(used.astype(np.int32)), wanted, scale
    ring, room, products = min(RING, held.ring), held.height * held.pitch // ASIDE + 1, None
    try:
        while products is None:
            products, ring, room = _products(k, held, given, ring, room)
    except BaseException:
        k.wait()  # what is launched uses arrays that would be freed
        raise
    return products


def _products(
    k: Launches, held: Prototypes, given: tuple[Any, Any, Any, Any], ring: int, room: int
) -> tuple[Any, int, int]:
    """Run kernels/prototype_equations with so many rows of sums, and so many pixels set aside.

    Returns: The products, or None where there is too little room; and how much to begin with then.
    """
    flow, used, wanted, scale = given
    number, height, width, pitch = used.shape[0], held.height, held.width, held.pitch
    s = _scratch(k, held, number, ring, room)
    ring, room, depth = s.total.shape[0] // number, s.aside.shape[0], s.band.shape[2]
    bands = list(pairwise([*range(0, height, depth), height]))
    sizes = [COLOURS * (bottom - top) * pitch for top, bottom in bands]  # values of an image
    most = sum(math.ceil(n / PIECE) for n in (*sizes, COLOURS * room))
    parts, pieces = k.empty(most, number + 1, number), 0
    flags = k.zeros(height, pitch)
    ends = k.zeros(height + 1, dtype=np.int32)
    for (top, bottom), size in zip(bands, sizes, strict=True):
        inputs = [flow, *held.arrays, used, scale, height, width, held.pyramid, ring, held.nodes]
        inputs += [held.hole, depth, top, bottom]
        outputs = [s.residual, s.opens, s.states, s.total, s.cells, s.places, s.steps, s.holes]
        k.launch_on("prototype_equations.advance", number, inputs, [*outputs, flags, s.band])
        inputs = [flags, wanted, number, height, width, depth, room, top, bottom]
        outputs = [s.band, s.band_wanted, s.aside, s.aside_wanted, s.slots, ends]
        k.launch_on("prototype_equations.set_aside", bottom - top, inputs, outputs)
        stride = COLOURS * depth * pitch
        pieces = k.multiply(s.band, s.band_wanted, stride, size, pieces, parts, k.launch_on)
    needed, found = int(k.to_host(s.states)[:number, 0].max()), int(k.to_host(ends)[height])
    if needed > ring or found > room:
        return None, max(needed, ring), max(found + found // ASIDE, room)  # for next frames too
    arrived = k.empty(number, dtype=np.int32)
    inputs = [s.holes, s.slots, scale, s.states, height, width, held.pyramid, room]
    k.launch_on("prototype_equations.finish", number, inputs, [s.cells, s.aside, arrived])
    check_some_valid(k.to_host(arrived))
    pieces = k.multiply(
        s.aside, s.aside_wanted, COLOURS * room, COLOURS * found, pieces, parts, k.launch_on
    )
    return k.add_up(parts, pieces), needed, found


def _scratch(k: Launches, held: Prototypes, number: int, ring: int, room: int) -> SimpleNamespace:
    """What the kernels keep of each prototype, and of the pixels that are set aside."""
    height, pitch = held.height, held.pitch
    depth = min(height, BAND)
    prototype: dict[str, Shape] = {
        "residual": ((2, held.nodes), np.float32),
        "opens": ((height + 1,), np.int32),
        "states": ((4,), np.int32),
        "cells": ((COLOURS + 1, held.pyramid), np.float32),
        "places": ((2, pitch), np.int32),
        "steps": ((7, pitch), np.float32),
        "holes": ((height, pitch), np.int32),
        "band": ((COLOURS, depth, pitch), np.float32),
    }
    pixel: dict[str, Shape] = {  # the kernels see as many values as (number, room, COLOURS)
        "aside": ((number, COLOURS), np.float32),
        "aside_wanted": ((COLOURS,), np.float32),
    }
    arrays = k.kept("equations", number, list(prototype.values()))
    set_aside = k.kept("aside", room, list(pixel.values()))
    (total,) = k.kept("sums", number * ring, [((pitch + MARGIN, COLOURS + 1), np.float32)])
    (slots,) = k.kept("slots", height, [((pitch,), np.int32)])
    (band_wanted,) = k.kept("wanted", depth, [((COLOURS, pitch), np.float32)])
    named = dict(zip([*prototype, *pixel], [*arrays, *set_aside], strict=True))
    return SimpleNamespace(**named, total=total, slots=slots, band_wanted=band_wanted)
