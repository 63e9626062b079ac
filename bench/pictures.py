"""Whole synthesis and analysis of frames, as `speak` and `train` do them."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from mmmgpu.analysis import analyze, prepare_analysis
from mmmgpu.backends import default_threads, get_backend
from mmmgpu.backends.planes import picture, planes
from mmmgpu.backends.reference import Reference
from mmmgpu.basis import MOUTH
from mmmgpu.bench.drawn import drawn_basis, drawn_coordinates, drawn_mouths
from mmmgpu.bench.timing import Contender, Work
from mmmgpu.parallel import map_ordered, one_thread_each
from mmmgpu.synthesis import mouths, prepare_synthesis

PROTOTYPES, SIDE, FRAMES = 46, 256, 8
EQUAL = 1e-4  # of pictures in [0, 1]
ALIKE = 0.03  # of the scale of model coordinates: flows are found anew in slightly other pictures
CARRIED = 2 * 6 * 2 + 8 * 4 + 2 * 3 + 8  # operations of a pixel of a prototype
NO_FLOW = 1e-4  # [px] at which an inverse flow is done
STEPS = 20


def picture_works(backends, peers):
    """Makers of the `Work` of synthesis and analysis, by name."""
    return {
        "synthesis": partial(synthesis_work, backends, peers),
        "mouths": partial(mouths_work, backends),
        "analysis": partial(analysis_work, backends),
    }


def synthesis_work(backends, peers, prototypes=PROTOTYPES, side=SIDE, frames=FRAMES):
    """Frames with every prototype in them, the whole region."""
    basis = drawn_basis(prototypes, side)
    coordinates = drawn_coordinates(prototypes, frames)
    contenders = {name: synthesis(basis, coordinates, name) for name in backends}
    whole = np.ones((side, side), bool)
    if "opencv" in peers:
        contenders["opencv + numpy"] = Contender(lambda: remapped(basis, *coordinates))
    name = f"synthesis, {prototypes} prototypes of {side}x{side}"
    return frames_of(name, basis, coordinates, whole, contenders, backends[0])


def mouths_work(backends, prototypes=PROTOTYPES, side=SIDE, frames=FRAMES):
    """The same where only the mouth will be looked at."""
    basis = drawn_basis(prototypes, side)
    coordinates, shown = drawn_coordinates(prototypes, frames), basis.w_t > 0
    contenders = {name: synthesis(basis, coordinates, name, shown) for name in backends}
    name = f"the same, the mouth's {int(shown.sum())} pixels"
    return frames_of(name, basis, coordinates, shown, contenders, backends[0])


def frames_of(name, basis, coordinates, shown, contenders, chained):
    """The work of synthesis where pictures are shown: each prototype read and carried once.

    The reference makes the first frame, a chain of the operations of the backend `chained` all.
    """
    first, frames = tuple(c[:1] for c in coordinates), len(coordinates[0])
    pixels = len(basis.images) * int(shown.sum())
    return Work(
        name,
        synthesis(basis, first, "numpy", shown).load(),
        contenders,
        bytes=frames * (pixels * 5 * 4 + int(shown.sum()) * 3 * 4),
        operations=frames * pixels * CARRIED,
        items=frames,
        unit="frame",
        part=1 / frames,
        checked=np.s_[:1],
        whole=partial(made_by_chain, basis, coordinates, shown, chained),
    )


class Chain(Reference):
    """The reference, but prototypes are moved by single operations of one of our backends."""

    def __init__(self, name):
        self.kernels = get_backend(name)

    def move_prototypes(self, held, flow, used, scale):
        own = held.flows[used]
        to = picture(flow[0], own.shape[2])
        oriented = self.filled_warp(to - own, own, held.hole)
        return planes(self.filled_warp(held.images[used], oriented, held.hole)) * scale

    def filled_warp(self, fields, flows, hole):
        """Host arrays in, and out."""
        k = self.kernels
        return k.to_host(k.fill_holes(*k.forward_warp(*map(k.to_device, (fields, flows))), hole))


def made_by_chain(basis, coordinates, shown, name):
    """All frames by the chain of operations that synthesis is one launch of."""
    prepared = prepare_synthesis(basis, shown=shown, backend="numpy")
    return np.stack(list(mouths(replace(prepared, kernels=Chain(name)), *coordinates)))


def synthesis(basis, coordinates, name, shown=None):
    """Synthesis by one of our backends, prepared once; pictures in host memory."""

    def load():
        synthesizer = prepare_synthesis(basis, shown=shown, backend=name)
        return lambda: np.stack(list(mouths(synthesizer, *coordinates)))

    return Contender(load, tolerance=EQUAL)


def remapped(basis, alpha, beta):
    """What OpenCV offers: backward warps along inverse flows.

    That is not quite the same picture: 0.004 of the scale off in the mean, 0.14 at worst. The flow
    of each prototype is inverted once. A frame then takes two `remap` a prototype: one carries the
    residual flow to the prototype, the other reads the prototype against it.
    """
    h, w = basis.images.shape[1:3]
    x, y = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    grid = np.stack([x, y], -1)
    back = [inverse(flow, grid) for flow in basis.flows]

    def one(a, b):
        flow, total = basis.flow(a), np.zeros((h, w, 3), np.float32)
        for i, image in enumerate(basis.images):
            moved = _read(flow - basis.flows[i], grid + back[i])
            cv2.scaleAdd(_read(image, grid - moved), float(b[i]), total, total)
        return np.clip(total, 0, 1)

    return lambda: np.stack([one(a, b) for a, b in zip(alpha, beta, strict=True)])


def inverse(flow, grid):
    """q with q(p + flow(p)) = -flow(p), by fixed-point iteration."""
    back = -flow
    for _ in range(STEPS):
        back = -_read(flow, grid + back)
    return back


def _read(field, places):
    options = {"interpolation": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_REPLICATE}
    return cv2.remap(field, places, None, **options)


def analysis_work(backends, prototypes=PROTOTYPES, side=SIDE, frames=FRAMES):
    """Mouths that are no prototypes, several at a time on one thread each."""
    basis, images = basis_and_mouths(prototypes, side, frames)
    pixels, products = int((basis.w_t > MOUTH).sum()), prototypes * (prototypes + 3) // 2
    return Work(
        f"analysis, {prototypes} prototypes of {side}x{side}",
        analysis(basis, images[:1], get_backend("numpy")).load(),
        {name: analysis(basis, images, get_backend(name, 1)) for name in backends},
        bytes=frames * pixels * prototypes * 5 * 4,
        operations=frames * pixels * (prototypes * CARRIED + products * 3 * 2),
        items=frames,
        unit="frame",
        part=1 / frames,
        checked=np.s_[:1],
        whole=partial(analyzed_by_chain, basis, images, backends[0]),
    )


def basis_and_mouths(prototypes, side, frames):
    """A basis, and mouths that are none of its prototypes."""
    basis = drawn_basis(prototypes, side)
    mouths = drawn_mouths(prototypes + frames, side)
    known = {image.tobytes() for image in basis.images}
    return basis, [image for image in mouths if image.tobytes() not in known][:frames]


def analyzed_by_chain(basis, images, name):
    """All frames by prototypes that single operations moved."""
    return analysis(basis, images, Chain(name)).load()()


def analysis(basis, images, kernels):
    """Analysis by a backend, as rows of alpha and beta."""

    def load():
        analyzer = prepare_analysis(basis, kernels)

        def one(image, _):
            return analyze(analyzer, image)

        def run():
            with one_thread_each():
                found = list(map_ordered(one, images, threads=default_threads()))
            return tuple(np.stack(part) for part in zip(*found, strict=True))

        return run

    return Contender(load, tolerance=ALIKE)
