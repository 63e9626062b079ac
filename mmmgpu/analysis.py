"""Analysis: the model coordinates of a real mouth image (docs/model.md).

alpha starts as the regularised least squares fit of a flow to the frame,

    min_a  sum_p w_f(p) |C(p) - sum_i a_i C_i(p)|^2 + r |a|^2,

and is then re-estimated from what synthesis and frame still differ by: Gauss-Newton steps on the
difference of the pictures, pulled back to the reference, where its Jacobian is -grad I . C_i. That
is flow between synthesis and frame, kept to the flows that the model has. beta is the quadratic
programme

    min_b  sum_p w_t(p) |I(p) - sum_i b_i I_i^warped(p)|^2,   b >= 0,  sum b = 1,

on the prototypes warped along C_syn(alpha), as synthesis warps them.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import daqp
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from mmmgpu.backends import Backend
from mmmgpu.backends.planes import picture, planes
from mmmgpu.basis import LIP, MOUTH, Basis, around, cut
from mmmgpu.errors import InputError
from mmmgpu.flows import Matcher, at_scale, concatenate, matcher, read_at
from mmmgpu.synthesis import HOLE, NO_TEXTURE

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]

FLOW_RIDGE = 1e-3  # r, as a share of the mean diagonal of the Gram matrix of the flows
STEP_RIDGE = 3e-4  # the same for a Gauss-Newton step
TEXTURE_RIDGE = 1e-6  # the same for beta: makes the programme strictly convex
STEPS = 2  # Gauss-Newton steps
OUTLIER = 0.2  # a pixel that differs by more than this counts less in a step
SCALE = 0.5  # of the pictures that flow is looked for in: they do for a beginning
TINY = 1e-12  # least weight of a product of slopes
NEAREST = 16  # prototypes that the first estimate of beta is made of
STILL = 1e-6  # [px^2] mean square of a flow that is none
UNSEEN = 0.01  # sqrt(w_t) of a pixel outside the mask, so that a step sees it too
THUMBNAIL = 24  # [px] width of the pictures in which the nearest prototypes are looked for


@dataclass(frozen=True)
class Scale:
    """What pictures are multiplied by, (h, pitch), and the same on the device."""

    plane: F32
    held: Any


@dataclass(frozen=True)
class Analyzer:
    """What analysis needs of a basis, computed once.

    basis: cut to the rectangle `inside` in which the masks are not zero.
    kernels, held: the backend, and the prototypes on it.
    pixels: indices of n reference pixels, every second of those with w_f above 0.02; weight (n,):
        w_f there; places (n, 2): where they are, (x, y) [px].
    along: the prototype flows there, x above y, (2 n, M - 1).
    gram: Cholesky factor of the regularised Gram matrix of the flows.
    everywhere: sqrt(w_t), but not below 0.01: what a step needs to see.
    masked: sqrt(w_t) where that is above 0.1, else 0.
    thumbnails: small masked prototypes, (M, k).
    """

    basis: Basis
    inside: tuple[slice, slice]
    match: Matcher
    kernels: Backend
    held: Any
    pixels: NDArray[np.int64]
    weight: F32
    places: F32
    along: F32
    gram: tuple[Floats, bool]
    everywhere: Scale
    masked: Scale
    thumbnails: F32


def prepare_analysis(basis: Basis, kernels: Backend, *, flow: str = "dis") -> Analyzer:
    """Compute what does not change from frame to frame; `flow` is one of `flows.MATCHERS`.

    Raises:
        InputError: The prototypes do not move against each other.
    """
    inside = around((basis.w_t > MOUTH) | (basis.w_f > LIP))
    basis = cut(basis, inside)
    pixels = np.flatnonzero((basis.w_f > LIP) & chessboard(basis.w_f.shape))
    weight = basis.w_f.ravel()[pixels]
    y, x = np.unravel_index(pixels, basis.w_f.shape)
    moving = basis.flows[basis.moving].reshape(len(basis.moving), -1, 2)[:, pixels]
    along = moving.transpose(2, 1, 0).reshape(2 * len(pixels), len(moving))
    weighted = along * np.sqrt(np.tile(weight, 2))[:, None]
    gram = weighted.T @ weighted
    energy = float(np.trace(gram)) / len(gram)
    if energy <= STILL * float(weight.sum()):
        raise InputError(
            "the mouth never moves in the prototypes; give clips of speech, or --region X,Y,W,H"
        )
    regular = gram.astype(np.float64) + FLOW_RIDGE * energy * np.eye(len(gram))
    root = np.sqrt(basis.w_t)
    return Analyzer(
        basis=basis,
        inside=inside,
        match=at_scale(matcher(flow), SCALE),
        kernels=kernels,
        held=kernels.hold_prototypes(basis.images, basis.flows, HOLE),
        pixels=pixels,
        weight=weight,
        places=np.stack([x, y], axis=1).astype(np.float32),
        along=along,
        gram=cho_factor(regular),
        everywhere=_scale(np.maximum(root, UNSEEN), kernels),
        masked=_scale(np.where(basis.w_t > MOUTH, root, 0), kernels),
        thumbnails=np.stack([thumbnail(image, basis.w_t) for image in basis.images]),
    )


def _scale(root: F32, kernels: Backend) -> Scale:
    plane = planes(root[..., None])[0]
    return Scale(plane, kernels.to_device(plane))


def chessboard(shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Every second pixel of a picture (h, w): neighbours say nearly the same of a flow."""
    y, x = np.indices(shape)
    return np.asarray((x + y) % 2 == 0)


def byte_thumbnail(image: F32, mask: F32) -> NDArray[np.uint8]:
    """`thumbnail` of a picture in [0, 1] in whole grey levels: what is kept of every frame."""
    return np.round(thumbnail(image, mask) * 255).astype(np.uint8)


def thumbnail(image: F32, mask: F32) -> F32:
    """A small masked copy of `image` (h, w, 3) as a vector, for comparing frames at a glance."""
    h, w = image.shape[:2]
    size = (THUMBNAIL, max(1, round(THUMBNAIL * h / w)))
    small = cv2.resize(image * mask[..., None], size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32).ravel()


def analyze(analyzer: Analyzer, image: F32) -> tuple[Floats, Floats]:
    """(alpha (M - 1,), beta (M,)) of a region `image`, (h, w, 3) in [0, 1]."""
    image = np.ascontiguousarray(image[analyzer.inside])
    wanted = planes(image)
    small = thumbnail(image, analyzer.basis.w_t)
    order = np.argsort(((analyzer.thumbnails - small) ** 2).sum(axis=1))
    alpha = fit_flow(analyzer, _flow_to(analyzer, image, int(order[0])))
    used = np.sort(order[:NEAREST])
    for _ in range(STEPS):
        flow = analyzer.basis.flow(alpha)
        beta, made = _fit_texture(analyzer, wanted, flow, used)
        alpha = _refine(analyzer, image, alpha, flow, made)
        used = np.flatnonzero(beta > NO_TEXTURE)
    return alpha, _fit_all(analyzer, wanted, analyzer.basis.flow(alpha))


def _flow_to(analyzer: Analyzer, image: F32, nearest: int) -> F32:
    """Flow from the reference to `image` by way of the prototype that resembles it most."""
    basis = analyzer.basis
    return concatenate(basis.flows[nearest], analyzer.match(basis.images[nearest], image))


def fit_flow(analyzer: Analyzer, flow: F32) -> Floats:
    """alpha (M - 1,) of a flow from the reference, (h, w, 2) [px]."""
    at = flow.reshape(-1, 2)[analyzer.pixels] * analyzer.weight[:, None]
    alpha: Floats = cho_solve(analyzer.gram, (at.T.ravel() @ analyzer.along).astype(np.float64))
    return alpha


def _refine(analyzer: Analyzer, image: F32, alpha: Floats, flow: F32, made: F32) -> Floats:
    """One Gauss-Newton step of alpha on the difference between its synthesis `made` and `image`.

    With e = I - I_syn and g = grad I, both read at p + C_syn(p), and weights w(p):
        (sum_p w C_i' (g g') C_j + r) da_j = -sum_p w C_i' g e - r a_i.
    """
    mean = (made + image) / 2
    slopes = [cv2.Scharr(mean, -1, *axis) / 32 for axis in ((1, 0), (0, 1))]
    seen = analyzer.places + flow.reshape(-1, 2)[analyzer.pixels]
    error, gx, gy = (read_at(field, seen) for field in (image - made, *slopes))
    w = analyzer.weight / (1 + _dot(error, error) / OUTLIER**2)
    xx, xy, yy = (w * _dot(a, b) for a, b in ((gx, gx), (gx, gy), (gy, gy)))
    rows = _rooted(xx, xy, yy, *np.split(analyzer.along, 2))
    normal = rows.T @ rows
    right = np.concatenate([w * _dot(g, error) for g in (gx, gy)]) @ analyzer.along
    ridge = STEP_RIDGE * float(np.trace(normal)) / len(normal)
    regular = normal.astype(np.float64) + ridge * np.eye(len(normal))
    step: Floats = cho_solve(cho_factor(regular), -right - ridge * alpha)
    return alpha + step


def _dot(a: F32, b: F32) -> F32:
    """Sums over the channels of a b, (n, 3) -> (n,)."""
    return np.asarray(np.einsum("nc,nc->n", a, b))


def _rooted(xx: F32, xy: F32, yy: F32, x: F32, y: F32) -> F32:
    """Rows (2 n, m) with which rows' rows = sum_p C' (xx xy; xy yy) C, for C = (x, y), (n, m) each.

    They are R C for the Cholesky factors R' R of the 2 x 2 matrices.
    """
    top = np.sqrt(np.maximum(xx, TINY))
    side = xy / top
    rows = np.empty((2 * len(x), x.shape[1]), np.float32)
    np.multiply(x, top[:, None], out=rows[: len(x)])
    rows[: len(x)] += side[:, None] * y
    np.multiply(y, np.sqrt(np.maximum(yy - side**2, 0))[:, None], out=rows[len(x) :])
    return rows


def _fit_texture(
    analyzer: Analyzer, wanted: F32, flow: F32, used: NDArray[np.int64]
) -> tuple[Floats, F32]:
    """beta (M,), zero outside `used`, and the synthesis with it, (h, w, 3); `wanted` as planes."""
    k, scale = analyzer.kernels, analyzer.everywhere
    moved = k.move_prototypes(analyzer.held, k.to_device(planes(flow[None])), used, scale.held)
    products = k.to_host(k.normal_equations(moved, k.to_device(wanted * scale.plane)))
    shares = solve_simplex(products[:-1], products[-1])
    mixed = k.to_host(k.blend(moved, k.to_device(shares[None].astype(np.float32))))[0]
    beta, width = np.zeros(len(analyzer.thumbnails)), flow.shape[1]
    beta[used] = shares
    return beta, picture(mixed[..., :width] / scale.plane[:, :width], width)


def _fit_all(analyzer: Analyzer, wanted: F32, flow: F32) -> Floats:
    """beta (M,) of all prototypes, where the mask is; `wanted` as planes."""
    k, scale = analyzer.kernels, analyzer.masked
    every, image = np.arange(len(analyzer.thumbnails)), k.to_device(wanted * scale.plane)
    products = k.to_host(
        k.prototype_equations(analyzer.held, planes(flow), every, image, scale.held)
    )
    return solve_simplex(products[:-1], products[-1])


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
