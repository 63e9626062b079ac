"""Analysis: the model coordinates of a real mouth image (docs/model.md).

alpha starts as the regularised least squares fit of the frame's flow,

    min_a  sum_p w_f(p) |C(p) - sum_i a_i C_i(p)|^2 + r |a|^2,

and is then re-estimated from what synthesis and frame still differ by: Gauss-Newton steps on the
difference of the pictures, pulled back to the reference, where its Jacobian is -grad I . C_i. That
is flow between synthesis and frame, kept to the flows that the model has. beta is the quadratic
programme

    min_b  sum_p w_t(p) |I(p) - sum_i b_i I_i^warped(p)|^2,   b >= 0,  sum b = 1,

on the prototypes warped along C_syn(alpha), as synthesis warps them.
"""

from dataclasses import dataclass

import cv2
import daqp
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from mmmgpu.backends import Backend
from mmmgpu.basis import LIP, MOUTH, Basis, around, cut
from mmmgpu.errors import InputError
from mmmgpu.flows import Matcher, best_flow, matcher, pull
from mmmgpu.synthesis import NO_TEXTURE, warp_prototypes

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]

FLOW_RIDGE = 1e-3  # r, as a share of the mean diagonal of the Gram matrix of the flows
STEP_RIDGE = 3e-4  # the same for a Gauss-Newton step
TEXTURE_RIDGE = 1e-6  # the same for beta: makes the programme strictly convex
STEPS = 2  # Gauss-Newton steps
OUTLIER = 0.2  # a pixel that differs by more than this counts less in a step
WAYPOINTS = 1  # prototypes tried as waypoints of the flow to a frame
NEAREST = 16  # prototypes that the first estimate of beta is made of
STILL = 1e-6  # [px^2] mean square of a flow that is none
THUMBNAIL = 24  # [px] width of the pictures in which the nearest prototypes are looked for


@dataclass(frozen=True)
class Analyzer:
    """What analysis needs of a basis, computed once.

    basis: cut to the rectangle `inside` in which the masks are not zero.
    pixels: indices of the n reference pixels with w_f above 0.02; weight (n,): w_f there.
    along_x, along_y: the prototype flows there, (n, M - 1) float32 each.
    gram: Cholesky factor of the regularised Gram matrix of the flows.
    energy: mean diagonal of the Gram matrix.
    texture_pixels: indices of the pixels with w_t above 0.01; texture_weight: sqrt(w_t) there.
    thumbnails: small masked prototypes, (M, k).
    """

    basis: Basis
    inside: tuple[slice, slice]
    match: Matcher
    pixels: NDArray[np.int64]
    weight: F32
    along_x: F32
    along_y: F32
    gram: tuple[Floats, bool]
    energy: float
    texture_pixels: NDArray[np.int64]
    texture_weight: F32
    thumbnails: F32


def prepare_analysis(basis: Basis, *, flow: str = "dis") -> Analyzer:
    """Compute what does not change from frame to frame; `flow` is one of `flows.MATCHERS`.

    Raises:
        InputError: The prototypes do not move against each other.
    """
    inside = around((basis.w_t > MOUTH) | (basis.w_f > LIP))
    basis = cut(basis, inside)
    pixels = np.flatnonzero(basis.w_f > LIP)
    weight = basis.w_f.ravel()[pixels]
    moving = basis.flows[basis.moving].reshape(len(basis.moving), -1, 2)[:, pixels]
    x, y = moving[..., 0].T, moving[..., 1].T
    gram = (x.T * weight) @ x + (y.T * weight) @ y
    energy = float(np.trace(gram)) / len(gram)
    if energy < STILL * float(weight.sum()):
        raise InputError(
            "the mouth never moves in the prototypes; give clips of speech, or --region X,Y,W,H"
        )
    regular = gram.astype(np.float64) + FLOW_RIDGE * energy * np.eye(len(gram))
    texture = np.flatnonzero(basis.w_t > MOUTH)
    return Analyzer(
        basis=basis,
        inside=inside,
        match=matcher(flow),
        pixels=pixels,
        weight=weight,
        along_x=np.ascontiguousarray(x),
        along_y=np.ascontiguousarray(y),
        gram=cho_factor(regular),
        energy=energy,
        texture_pixels=texture,
        texture_weight=np.sqrt(basis.w_t.ravel()[texture]),
        thumbnails=np.stack([thumbnail(image, basis.w_t) for image in basis.images]),
    )


def byte_thumbnail(image: F32, mask: F32) -> NDArray[np.uint8]:
    """`thumbnail` of a picture in [0, 1] in whole grey levels: what is kept of every frame."""
    return np.round(thumbnail(image, mask) * 255).astype(np.uint8)


def thumbnail(image: F32, mask: F32) -> F32:
    """A small masked copy of `image` (h, w, 3) as a vector, for comparing frames at a glance."""
    h, w = image.shape[:2]
    size = (THUMBNAIL, max(1, round(THUMBNAIL * h / w)))
    small = cv2.resize(image * mask[..., None], size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32).ravel()


def analyze(analyzer: Analyzer, image: F32, kernels: Backend) -> tuple[Floats, Floats]:
    """(alpha (M - 1,), beta (M,)) of a region `image`, (h, w, 3) in [0, 1]."""
    image = np.ascontiguousarray(image[analyzer.inside])
    small = thumbnail(image, analyzer.basis.w_t)
    order = np.argsort(((analyzer.thumbnails - small) ** 2).sum(axis=1))
    alpha = fit_flow(analyzer, _flow_to(analyzer, image, order))
    used = np.sort(order[:NEAREST])
    for _ in range(STEPS):
        beta, made = _fit_texture(analyzer, image, alpha, used, kernels)
        alpha = _refine(analyzer, image, alpha, made)
        used = np.flatnonzero(beta > NO_TEXTURE)
    every = np.arange(len(analyzer.thumbnails))
    return alpha, _fit_texture(analyzer, image, alpha, every, kernels)[0]


def _flow_to(analyzer: Analyzer, image: F32, order: NDArray[np.int64]) -> F32:
    """Flow from the reference to `image`, direct or through the first prototypes of `order`."""
    basis = analyzer.basis
    near = [i for i in order[: WAYPOINTS + 1] if i != basis.reference][:WAYPOINTS]
    via = [(basis.images[i], basis.flows[i]) for i in near]
    return best_flow(basis.images[basis.reference], image, basis.w_t, via, analyzer.match)


def fit_flow(analyzer: Analyzer, flow: F32) -> Floats:
    """alpha (M - 1,) of a flow from the reference, (h, w, 2) [px]."""
    at = flow.reshape(-1, 2)[analyzer.pixels] * analyzer.weight[:, None]
    right = at[:, 0] @ analyzer.along_x + at[:, 1] @ analyzer.along_y
    alpha: Floats = cho_solve(analyzer.gram, right.astype(np.float64))
    return alpha


def _refine(analyzer: Analyzer, image: F32, alpha: Floats, made: F32) -> Floats:
    """One Gauss-Newton step of alpha on the difference between its synthesis `made` and `image`.

    With e = I - I_syn and g = grad I, both read at p + C_syn(p), and weights w(p):
        (sum_p w C_i' (g g') C_j + r) da_j = -sum_p w C_i' g e - r a_i.
    """
    basis = analyzer.basis
    mean = (made + image) / 2
    slopes = [np.asarray(cv2.Scharr(mean, -1, *axis)) / 32 for axis in ((1, 0), (0, 1))]
    flow = basis.flow(alpha)
    fields = [np.asarray(field, np.float32) for field in (image - made, *slopes)]
    error, gx, gy = (_pulled(analyzer, field, flow) for field in fields)
    w = analyzer.weight / (1 + (error**2).sum(axis=1) / OUTLIER**2)
    xx, xy, yy = ((w * (a * b).sum(axis=1))[:, None] for a, b in ((gx, gx), (gx, gy), (gy, gy)))
    x, y = analyzer.along_x, analyzer.along_y
    normal = x.T @ (xx * x + xy * y) + y.T @ (xy * x + yy * y)
    right = (w * (gx * error).sum(axis=1)) @ x + (w * (gy * error).sum(axis=1)) @ y
    ridge = STEP_RIDGE * float(np.trace(normal)) / len(normal)
    regular = normal.astype(np.float64) + ridge * np.eye(len(normal))
    step: Floats = cho_solve(cho_factor(regular), -right - ridge * alpha)
    return alpha + step


def _pulled(analyzer: Analyzer, field: F32, flow: F32) -> F32:
    """`field` (h, w, 3) read at p + flow(p) for the pixels of the analyzer, (n, 3)."""
    seen = pull(field, flow)
    return seen.reshape(-1, seen.shape[-1])[analyzer.pixels]


def _fit_texture(
    analyzer: Analyzer, image: F32, alpha: Floats, used: NDArray[np.int64], kernels: Backend
) -> tuple[Floats, F32]:
    """beta (M,), zero outside `used`, and the synthesis with it, (h, w, 3)."""
    basis = analyzer.basis
    on_device = warp_prototypes(basis, basis.flow(alpha), used, kernels)
    warped = kernels.to_host(on_device).reshape(len(used), -1, 3)
    beta = np.zeros(len(basis.images))
    beta[used] = fit_mixture(warped, image, analyzer.texture_pixels, analyzer.texture_weight)
    made = beta[used].astype(np.float32) @ warped.reshape(len(used), -1)
    return beta, made.reshape(image.shape)


def fit_mixture(warped: F32, image: F32, pixels: NDArray[np.int64], weight: F32) -> Floats:
    """The weights (n,) on the simplex with which pictures mix to `image` best.

    warped: (n, h w, 3). image: (h, w, 3). pixels, weight: those that count, and sqrt(w_t) there.
    """
    a = (warped[:, pixels] * weight[:, None]).reshape(len(warped), -1)
    b = (image.reshape(-1, 3)[pixels] * weight[:, None]).ravel()
    return solve_simplex(a @ a.T, a @ b)


def solve_simplex(gram: F32, right: F32) -> Floats:
    """min_b b' G b / 2 - h' b with b >= 0, sum b = 1; G (n, n), h (n,) -> b (n,)."""
    n = len(right)
    g = gram.astype(np.float64)
    g += TEXTURE_RIDGE * np.trace(g) / n * np.eye(n)
    upper, lower = np.ones(n + 1), np.append(np.zeros(n), 1.0)
    b, _, status, _ = daqp.solve(g, -right.astype(np.float64), np.ones((1, n)), upper, lower)
    if status < 1:
        raise ArithmeticError(f"the quadratic programme of beta failed with status {status}")
    b = np.maximum(b, 0)
    return np.asarray(b / b.sum())
