"""Matching by synthesis (CE05, Eq. 7-10) pixel by pixel, with the reference operations."""

import numpy as np
import oracles_model
from scipy.ndimage import gaussian_filter
from scipy.optimize import fsolve

from mmmgpu.basis import LIP, MOUTH
from mmmgpu.flow_matching import KEPT, RIDGE, ROUNDS
from mmmgpu.matching import SMOOTHED


def flow_distance(source, view, k, n):
    """Eq. 7 for prototype k and frame n, over the sum of the weights [px]."""
    s, total, weights = view.correspondence, 0.0, 0.0
    for y, x in np.argwhere(source.w_f > LIP):
        start = s(np.array([x, y], float))
        wanted = s(np.array([x, y]) + view.flows_a[k][y, x].astype(float)) - start
        real = oracles_model.bilinear(view.flows_b[n].astype(float), *start)
        total += source.w_f[y, x] * np.hypot(*(wanted - real))
        weights += source.w_f[y, x]
    return total / weights


def calibrated_distances(source, view, chosen, number):
    """Eq. 7 with C', all prototypes (M, N) [px], by singular vectors of B's flows under w_f."""
    s = view.correspondence
    at = np.argwhere(source.w_f > LIP)
    root = np.array([source.w_f[y, x] for y, x in at]) ** 0.5
    root /= np.linalg.norm(root)
    starts = np.array([s(np.array([x, y], float)) for y, x in at])
    wanted = np.array(
        [[s(np.array([x, y]) + flow[y, x].astype(float)) for y, x in at] for flow in view.flows_a]
    )
    wanted -= starts
    real = np.array(
        [[oracles_model.bilinear(f.astype(float), *p) for p in starts] for f in view.flows_b]
    )
    v = np.linalg.svd((real * root[:, None]).reshape(len(real), -1), full_matrices=False)[2]
    v = v[:number]
    z, y = ((flows * root[:, None]).reshape(len(flows), -1) @ v.T for flows in (wanted, real))
    linear, offset = robust_map(z, y[chosen])
    made = []
    for k in range(len(z)):
        spanned, rest = (z[k] @ v).reshape(-1, 2), wanted[k] * root[:, None]
        carried = ((linear @ z[k] + offset) @ v).reshape(-1, 2)
        made.append((carried + KEPT * (rest - spanned)) / root[:, None])
    return np.array(
        [[(root**2 * np.linalg.norm(m - r, axis=-1)).sum() for r in real] for m in made]
    )


def robust_map(z, y):
    """T and o by stacked least squares: the rows under their weights, and rows for the ridge."""
    size = z.shape[1]
    weights = np.ones(len(z))
    ridge = np.sqrt(RIDGE * (z**2).mean()) * np.eye(size, size + 1)
    for _ in range(ROUNDS):
        rows = [np.sqrt(w) * np.append(a, 1) for w, a in zip(weights, z, strict=True)]
        right = [np.sqrt(w) * b for w, b in zip(weights, y, strict=True)]
        system = np.concatenate([rows, ridge])
        solved = np.linalg.lstsq(system, np.concatenate([right, ridge[:, :size]]), rcond=None)[0]
        errors = [np.linalg.norm(b - np.append(a, 1) @ solved) for a, b in zip(z, y, strict=True)]
        weights = [min(1, np.median(errors) / e) ** 2 for e in errors]
    return solved[:size].T, solved[size]


def synthetic_flow(view, k, shape):
    """C_syn,k on B's pixels, (h', w', 2): S(p + C_k(p)) - q at the p with S(p) = q."""
    s, made = view.correspondence, np.empty((*shape, 2))
    around = np.pad(view.flows_a[k].astype(float), ((1, 1), (1, 1), (0, 0)))  # no flow outside
    for y in range(shape[0]):
        for x in range(shape[1]):
            p = fsolve(lambda p, q=(x, y): s(p) - q, s.centres.mean(axis=0), xtol=1e-12)
            made[y, x] = s(p + oracles_model.bilinear(around, *(p + 1))) - (x, y)
    return made


def texture_system(source, view, k):
    """G and h of Eq. 8, of the other prototypes warped to prototype k under w_t."""
    others = [i for i in range(len(source.images)) if i != k]
    warped = [_moved(source.images[i], view.flows_a[i], view.flows_a[k]) for i in others]
    gram, right = np.zeros((len(others),) * 2), np.zeros(len(others))
    for y, x in np.argwhere(source.w_t > MOUTH):
        at = np.array([picture[y, x] for picture in warped])
        gram += source.w_t[y, x] * at @ at.T
        right += source.w_t[y, x] * at @ source.images[k][y, x].astype(float)
    return gram, right


def texture_coordinates(source, view, k):
    """Column k of Eq. 8, (M,)."""
    return np.insert(oracles_model.solve_simplex(*texture_system(source, view, k)), k, 0.0)


def texture_distance(target, view, beta, candidates, flow, n):
    """Eq. 9-10 of one prototype, beta (M,), C_syn `flow`, and frame n, over the sum of weights.

    Of both pictures smoothed, with the picture mirrored about its edge pixels outside.
    """
    made = np.zeros(target.images[0].shape)
    for b, frame in zip(beta, candidates, strict=True):
        if b > 0:
            made += b * _moved(target.images[frame], view.flows_b[frame], flow)
    difference = gaussian_filter(
        made - target.images[n],
        (SMOOTHED * target.region.mouth[2],) * 2,
        axes=(0, 1),
        mode="mirror",
    )
    total = weights = 0.0
    for y, x in np.argwhere(target.w_t > MOUTH):
        miss = difference[y, x]
        total += target.w_t[y, x] * np.sqrt((miss**2).sum())
        weights += target.w_t[y, x]
    return total / weights


def _moved(image, own, flow):
    """W_F(I, W_F(C - C_i, C_i)), holes filled."""
    oriented = oracles_model._filled_warp(flow - own, own)
    return oracles_model._filled_warp(image, oriented)


def iterate(flow, scan, balance, most):
    """Candidates and their costs until they repeat: (history, costs), `scan` as in matching."""
    flow = flow / np.median(flow)
    history, costs, scale = [[int(np.argmin(row)) for row in flow]], [], None
    while len(costs) < most:
        texture = scan(np.array(history[-1]))
        scale = np.median(texture) if scale is None else scale
        cost = [
            [balance * f + (1 - balance) * t / scale for f, t in zip(fs, ts, strict=True)]
            for fs, ts in zip(flow, texture, strict=True)
        ]
        new = [int(np.argmin(row)) for row in cost]
        costs.append(sum(min(row) for row in cost))
        repeated = new in history
        history.append(new)
        if repeated:
            break
    return history, costs
