"""Dense correspondence of two faces from marked points (CE05, Eq. 6).

    S(p) = A [1, x, y]' + sum_k w_k phi(|p - a_k|),     phi(r) = exp(-gamma r^2),

with the side conditions sum_k w_k = 0 and sum_k w_k a_k' = 0, so that an affine map of the points
has no weights, and S(a_k) = b_k exactly. With `smoothing` lambda > 0 in the equations,

    S(a_k) + lambda w_k = b_k:

the bending of S is weighed against its errors at the points (Wahba 1990). `c` says how narrow the
Gaussians are in units of the points' own spacing: gamma = c / spacing^2. Solved densely in float64:
there are a few dozen points. `mmmgpu.operations.evaluate_rbf` is the same map on a device.

Sources: CE05 = Chang & Ezzat, "Transferable Videorealistic Speech Animation" (SCA 2005), section
4.1; side conditions: Wendland, "Scattered Data Approximation" (2005), chapter 8.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mmmgpu.errors import InputError

DEFAULT_C = 2.0  # see docs/model.md for how it was chosen
MOST_SMOOTHING = 100.0  # S is as good as affine there
LARGEST_CONDITION = 1e6  # beyond it the map swings between the points, and float32 loses it
SAME_PLACE = 0.01  # [px] points closer than this are one point
FLAT = 0.01  # width over length of points on one line
CLOSE = 1e-9  # [px] error at which an inverse is done
STEPS = 100  # of Newton's method at most; 4 to 6 are usual
LEAST_SHARE = 1e-3  # of a Newton step: where no longer one helps, there is no way on
STARTS = 6  # marked points tried where the first start leads nowhere
DAMPING = 1e-9  # of a Newton step, where the slope is about 1
PART = 1 << 14  # points evaluated at a time: their distances stay in the cache

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Correspondence:
    """The map S from a picture A to a picture B. Points are (x, y) [px].

    Attributes:
        centres: a_k, the marked points of A, shape (N, 2).
        weights: w_k [px], shape (N, 2).
        affine: A, shape (2, 3), columns for 1, x and y.
        c: Sharpness of the Gaussians [1]; see `rbf_correspondence`.
        spacing: Mean distance of a marked point of A to its nearest other one [px].
    """

    centres: Array
    weights: Array
    affine: Array
    c: float
    spacing: float

    @property
    def sharpness(self) -> float:
        """gamma of phi(r) = exp(-gamma r^2) [1/px^2]."""
        return self.c / self.spacing**2

    def __call__(self, points: ArrayLike) -> Array:
        """S(p) of points of A, shapes (..., 2) -> (..., 2)."""
        return _in_parts(lambda p: self._value_and_slope(p)[0], points, (2,))

    def jacobian(self, points: ArrayLike) -> Array:
        """dS_i / dp_j at points of A, shapes (..., 2) -> (..., 2, 2)."""
        return _in_parts(lambda p: self._value_and_slope(p)[1], points, (2, 2))

    def inverse(self, points: ArrayLike) -> Array:
        """p of A with S(p) = q, for points q of B, shapes (..., 2) -> (..., 2).

        Newton's method, its steps halved until they help, from the affine map that fits the marked
        points best. Where S folds, q may come from several p: one is returned. Where none is found
        (a few pixels beside a fold), the result is the point met with the least |S(p) - q|, so that
        comparing S of the result with q tells the two apart.
        """
        return _in_parts(self._solve, points, (2,))

    def folds(self, width: int, height: int) -> NDArray[np.bool_]:
        """Where S turns A's picture inside out, det dS/dp <= 0, at every pixel: shape (H, W)."""
        y, x = np.mgrid[:height, :width]
        return np.asarray(np.linalg.det(self.jacobian(np.stack([x, y], axis=-1))) <= 0)

    def _value_and_slope(self, p: Array) -> tuple[Array, Array]:
        """S (P, 2) and its Jacobian (P, 2, 2) at points (P, 2): one product of matrices for both.

        The sum over k of w_k (p - a_k)' phi_k is (sum of w_k phi_k) p' - sum of w_k a_k' phi_k;
        the origin is moved among the points, so that little cancels.
        """
        origin = self.centres.mean(axis=0)
        a, u = self.centres - origin, p - origin
        phi = (u[:, :1] - a[:, 0]) ** 2
        phi += (u[:, 1:] - a[:, 1]) ** 2
        phi *= -self.sharpness
        np.exp(phi, out=phi)  # (P, N)
        moments = self.weights[:, :, None] * a[:, None, :]  # (N, 2, 2)
        sums = phi @ np.concatenate([self.weights, moments.reshape(-1, 4)], axis=1)
        curl = sums[:, :2, None] * u[:, None, :] - sums[:, 2:].reshape(-1, 2, 2)
        return sums[:, :2] + _apply(self.affine, p), self.affine[:, 1:] - 2 * self.sharpness * curl

    def _solve(self, q: Array) -> Array:
        """`inverse` of a part of the points, shape (P, 2)."""
        partners = self(self.centres)
        p, error = self._descend(q, _apply(_best_affine(partners, self.centres), q))
        unsolved = np.flatnonzero(error > CLOSE)
        order = np.argsort(_length(q[unsolved, None] - partners), axis=1)
        for k in range(min(STARTS, len(partners))):
            left = error[unsolved] > CLOSE
            i, start = unsolved[left], self.centres[order[left, k]]
            trial, e = self._descend(q[i], start)
            better = e < error[i]
            p[i[better]], error[i[better]] = trial[better], e[better]
        return p

    def _descend(self, q: Array, start: Array) -> tuple[Array, Array]:
        """Newton's method from one start for each q (P, 2): p and |S(p) - q|, (P, 2) and (P,)."""
        p = start.copy()
        value, slope = self._value_and_slope(p)
        error, share = _length(q - value), np.ones(len(p))
        for _ in range(STEPS):
            i = np.flatnonzero((error > CLOSE) & (share >= LEAST_SHARE))
            if not len(i):
                break
            trial = p[i] + share[i, None] * _newton_step(slope[i], q[i] - value[i])
            v, s = self._value_and_slope(trial)
            e = _length(q[i] - v)
            better = e < error[i]
            share[i] = np.where(better, np.minimum(2 * share[i], 1), share[i] / 2)
            k = i[better]
            p[k], value[k], slope[k], error[k] = trial[better], v[better], s[better], e[better]
        return p, error


def rbf_correspondence(
    points_a: ArrayLike,
    points_b: ArrayLike,
    *,
    c: float | None = None,
    smoothing: float = 0.0,
) -> Correspondence:
    """The correspondence that carries each marked point of A to its partner in B (CE05, Eq. 6).

    Args:
        points_a: Marked points (x, y) [px] of picture A, shape (N, 2), N >= 3.
        points_b: Their partners in picture B, shape (N, 2).
        c: Sharpness of the Gaussians, phi(r) = exp(-c (r / spacing)^2), with spacing the mean
            distance of a point of A to its nearest other one. None is `DEFAULT_C`.
        smoothing: lambda, in units of phi(0) = 1: 0 is exact, 100 nearly affine.

    Raises:
        InputError: Not two equally long lists of at least three finite points, points on one line
            or at the same place, c or smoothing out of range, or c so small (below about 1/4)
            that the system is ill-conditioned.
    """
    a, b = _points("points_a", points_a), _points("points_b", points_b)
    if len(a) != len(b):
        raise InputError(
            f"points_a has {len(a)} points and points_b {len(b)}: every point needs its partner"
        )
    distances = [_check_places(name, p) for name, p in (("points_a", a), ("points_b", b))]
    spacing = float(distances[0].min(axis=1).mean())
    sharp = DEFAULT_C if c is None else float(c)
    if not (np.isfinite(sharp) and sharp > 0):
        raise InputError(f"c must be a finite number above 0, got {c}; leave it out for the usual")
    if not 0 <= smoothing <= MOST_SMOOTHING:
        raise InputError(f"smoothing must be between 0 and {MOST_SMOOTHING:g}, got {smoothing}")
    weights, affine = _fit(a, b, sharp, spacing, smoothing)
    return Correspondence(a, weights, affine, sharp, spacing)


def _points(name: str, points: ArrayLike) -> Array:
    """`points` as float64 (N, 2), finite and enough of them."""
    try:
        p = np.array(points, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name} must be an array of numbers, shape (N, 2)") from None
    if p.ndim != 2 or p.shape[1] != 2:
        raise InputError(f"{name} must have shape (N, 2), rows of x and y, got {p.shape}")
    if len(p) < 3:
        raise InputError(f"{name} has {len(p)} points; at least 3 are needed, not on one line")
    if not np.isfinite(p).all():
        bad = int(np.argmin(np.isfinite(p).all(axis=1)))
        raise InputError(f"{name}[{bad}] is not finite: {p[bad].tolist()}; remove or correct it")
    return p


def _distances(p: Array) -> Array:
    """Distances between points (N, 2) [px], shape (N, N), infinite from a point to itself."""
    d = _length(p[:, None] - p)
    np.fill_diagonal(d, np.inf)
    return d


def _check_places(name: str, p: Array) -> Array:
    """The `_distances` of points, after checking that they are apart, and not on one line."""
    distances = _distances(p)
    if distances.min() < SAME_PLACE:
        first, second = np.unravel_index(np.argmin(distances), distances.shape)
        place = ", ".join(f"{v:.2f}" for v in p[first])
        raise InputError(
            f"{name}[{first}] and {name}[{second}] are at the same place, ({place}); remove one"
        )
    length, width = np.linalg.svd(p - p.mean(axis=0), compute_uv=False)
    if width < FLAT * length:
        raise InputError(f"{name} lie on one line; add points beside it")
    return distances


def _fit(a: Array, b: Array, c: float, spacing: float, smoothing: float) -> tuple[Array, Array]:
    """Weights (N, 2) and affine part (2, 3) of the map a -> b (N, 2).

    The points are centred and scaled for the polynomial part: its columns are then of the size of
    the Gaussians, and the condition number that of the problem.
    """
    number = len(a)
    origin, scale = a.mean(axis=0), np.abs(a - a.mean(axis=0)).max()
    phi = np.exp(-c * (_length(a[:, None] - a) / spacing) ** 2) + smoothing * np.eye(number)
    linear = np.column_stack([np.ones(number), (a - origin) / scale])
    system = np.block([[phi, linear], [linear.T, np.zeros((3, 3))]])
    condition = float(np.linalg.cond(system))
    if condition > LARGEST_CONDITION:
        distances = _distances(a)
        first, second = np.unravel_index(np.argmin(distances), distances.shape)
        raise InputError(
            f"c = {c:g} leaves the correspondence ill-conditioned ({condition:.0e}); give c well "
            f"above 1/4 or, where it is, remove points_a[{first}] or [{second}], the closest, "
            f"{distances.min():.2f} px apart"
        )
    solved = np.linalg.solve(system, np.concatenate([b, np.zeros((3, 2))]))
    weights, affine = solved[:number], solved[number:].T
    affine[:, 1:] /= scale
    affine[:, 0] -= affine[:, 1:] @ origin
    return weights, affine


def _best_affine(a: Array, b: Array) -> Array:
    """The affine map (2, 3) that carries points a nearest to b, both (N, 2), in least squares."""
    best = np.linalg.lstsq(np.column_stack([np.ones(len(a)), a]), b, rcond=None)[0]
    return np.asarray(best.T)


def _apply(affine: Array, p: Array) -> Array:
    return p @ affine[:, 1:].T + affine[:, 0]


def _newton_step(slope: Array, rest: Array) -> Array:
    """slope^-1 rest, shapes (P, 2, 2) and (P, 2), damped by next to nothing (Levenberg).

    Where the slope is singular, that is the least step that best does what can be done.
    """
    gx, gy = np.einsum("pji,pj->ip", slope, rest)
    (a, b), (_, d) = np.einsum("pki,pkj->ijp", slope, slope)
    a, d = a + DAMPING, d + DAMPING
    step: Array = np.stack([d * gx - b * gy, a * gy - b * gx], axis=-1) / (a * d - b * b)[:, None]
    return step


def _length(vectors: Array) -> Array:
    return np.asarray(np.hypot(vectors[..., 0], vectors[..., 1]), dtype=np.float64)


def _in_parts(
    evaluate: Callable[[Array], Array], points: ArrayLike, shape: tuple[int, ...]
) -> Array:
    """`evaluate` (P, 2) -> (P, *shape) over points (..., 2), `PART` of them at a time."""
    given = np.asarray(points, dtype=np.float64)
    flat = given.reshape(-1, 2)
    result = np.empty((len(flat), *shape))
    for start in range(0, len(flat), PART):
        result[start : start + PART] = evaluate(flat[start : start + PART])
    return result.reshape(*given.shape[:-1], *shape)
