"""Matching scans, trajectories, and the gradients of adaptation and training."""

from functools import partial

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded, solveh_banded

from mmmgpu.bench.cases import EVERY, smooth_flow
from mmmgpu.bench.drawn import drawn_basis
from mmmgpu.bench.timing import REFERENCE, Contender, Work
from mmmgpu.correspondence import rbf_correspondence
from mmmgpu.flow_matching import DIRECTIONS, LEARNED, FlowScan, View
from mmmgpu.gdlr import error_and_slope, extended, identity_regressions, regressed
from mmmgpu.phonemes import PhonemeModels, segment_durations
from mmmgpu.trajectories import (
    error_and_gradient,
    factor_system,
    lay_out,
    synthesize_trajectory,
)

DIMENSIONS, PHONES, CLASSES, ORDER, LAMBDA = 50, 40, 6, 4, 1.0
FPS = 25
SIMPLE = 1e-8  # of the scale of what is solved for
FACTOR, SOLVE = (ORDER + 1) ** 2, 4 * ORDER + 1  # operations of a frame, of a banded system


def model_works(backends, peers):
    """Makers of the `Work` of each, by name."""
    return {
        "matching": partial(matching_work, backends),
        "trajectory": partial(trajectory_work, peers),
        "gdlr": gdlr_work,
        "training": training_work,
    }


def matching_work(backends, prototypes=46, frames=450, side=128):
    """Eq. 7: the flows of all frames read along S and compared with those of all prototypes.

    Their principal directions, which calibration needs, are found as well.
    """
    rng = np.random.default_rng(0)
    basis = drawn_basis(prototypes + 1, side)  # the first does not move
    marks = rng.uniform(0.1, 0.9, (12, 2)) * side
    map_ = rbf_correspondence(marks, 1.02 * marks + rng.normal(0, 0.5, marks.shape))
    flows = smooth_flow(rng, frames, side, side)

    def scan(name, some):
        views = [View(map_, basis.flows[1:], some)]
        return FlowScan(basis, views, backend=name)().min(axis=0)

    pixels, learned = int((basis.w_f > 0.02).sum()), min(frames, LEARNED)
    directions = 4 * learned**2 + 4 * DIRECTIONS * (learned + prototypes + frames)
    return Work(
        f"matching scan, {prototypes} prototypes, {frames} frames of {side}x{side}",
        lambda: scan("numpy", flows[::EVERY]),
        {n: Contender(lambda n=n: lambda: scan(n, flows), tolerance=1e-5) for n in backends},
        bytes=frames * pixels * 2 * 4 * 3,
        operations=pixels * (frames * (12 * prototypes + 22) + directions),
        items=frames,
        unit="frame",
        part=1 / EVERY,
        checked=np.s_[:, ::EVERY],
    )


def speech(frames, seed=0):
    """Models of `PHONES` phones, and the phone of each of `frames` frames."""
    rng = np.random.default_rng(seed)
    names = tuple(f"phone {i:02}" for i in range(PHONES))
    shape = PHONES, DIMENSIONS
    models = PhonemeModels(
        names, rng.normal(size=shape), rng.uniform(0.3, 3, shape), np.full(PHONES, 100)
    )
    rows = np.repeat(rng.integers(PHONES, size=frames), rng.integers(2, 8, size=frames))[:frames]
    return models, rows


def trajectory_work(peers, seconds=3, fps=FPS):
    """Eq. 3 for a sentence in all dimensions; the reference solves one dense system a dimension."""
    models, rows = speech(seconds * fps)
    labels = [models.labels[row] for row in rows]
    line = lay_out([rows], [segment_durations(labels, None)], order=ORDER)
    n = len(rows)

    def dense():
        W = np.diff(np.eye(n), ORDER, axis=0)
        columns = []
        for mean, variance in zip(models.mean.T, models.variance.T, strict=True):
            q = line.weight / variance[rows]
            columns.append(np.linalg.solve(np.diag(q) + LAMBDA * W.T @ W, q * mean[rows]))
        return np.stack(columns, 1)

    def banded():
        line = lay_out([rows], [segment_durations(labels, None)], order=ORDER)
        columns = []
        for mean, variance in zip(models.mean.T, models.variance.T, strict=True):
            q = line.weight / variance[rows]
            columns.append(solveh_banded(banded_system(line, q), q * mean[rows], lower=True))
        return np.stack(columns, 1)

    def ours():
        return synthesize_trajectory(models, labels, smoothness=LAMBDA, order=ORDER)

    peer = {"scipy solveh_banded": Contender(lambda: banded)} if "scipy" in peers else {}
    contenders = {"ours": Contender(lambda: ours, tolerance=SIMPLE), **peer}
    name = f"trajectory of {seconds} s, {DIMENSIONS} dimensions"
    return Work(
        name,
        dense,
        contenders,
        bytes=DIMENSIONS * n * 3 * 8,
        operations=DIMENSIONS * n * (FACTOR + SOLVE),
        precision="float64",
        items=n,
        unit="frame",
    )


def gdlr_work(seconds=15, fps=FPS):
    """dE/dR of Eq. 17 by the adjoint; the reference solves Eq. 16 for each entry of R in turn.

    It uses the factor of A that is there already, and that an entry moves one dimension only.
    """
    models, rows = speech(seconds * fps)
    line = lay_out([rows], [segment_durations([*rows], None)], order=ORDER)
    system = factor_system(line, models, np.full(DIMENSIONS, LAMBDA))
    classes = np.arange(PHONES) % CLASSES
    z = np.random.default_rng(1).normal(size=(len(rows), DIMENSIONS))
    R = identity_regressions(CLASSES, DIMENSIONS)

    def adjoint():
        return error_and_slope(system, R, models.mean, z, classes)[1]

    def one_by_one():
        residual = 2 * (system.follow(regressed(R, models.mean, classes)) - z)
        xi, slope, n = extended(models.mean)[rows], np.zeros_like(R), len(rows)
        for g, i, j in np.ndindex(R.shape):
            pull = line.weight * system.precision[rows, i] * xi[:, j] * (classes[rows] == g)
            factor = system.factor[:, i * n : (i + 1) * n]
            dy = cho_solve_banded((factor, True), pull, check_finite=False)
            slope[g, i, j] = residual[:, i] @ dy
        return slope

    name = f"GDLR gradient, {CLASSES} classes, {DIMENSIONS} dimensions, {seconds} s"
    return Work(
        name,
        one_by_one,
        {"adjoint": Contender(lambda: adjoint, tolerance=SIMPLE)},
        bytes=DIMENSIONS * len(rows) * (ORDER + 2) * 8,
        operations=DIMENSIONS * (len(rows) * 2 * SOLVE + 2 * PHONES * 2 * (DIMENSIONS + 1)),
        precision="float64",
    )


def training_work(seconds=120, fps=FPS, dimensions=DIMENSIONS, checked=5):
    """The gradient of Eq. 4 by the adjoint; the reference solves Eq. 16 for each mu and sigma.

    It solves the whole system for each, as the formula says, in the dimensions that are checked.
    Beside that it factors it once for all of a dimension's.
    """
    models, rows = speech(seconds * fps)
    line = lay_out([rows], [segment_durations([*rows], None)], order=ORDER)
    z = np.random.default_rng(1).normal(size=(len(rows), dimensions))

    def adjoint():
        pairs = [
            error_and_gradient(line, z[:, j], models.mean[:, j], models.variance[:, j], LAMBDA)[1:]
            for j in range(dimensions)
        ]
        return tuple(np.stack(part) for part in zip(*pairs, strict=True))

    def one_by_one(solver, some):
        by_mean, by_log_variance = np.zeros((2, some, PHONES))
        for j in range(some):
            mean, q = models.mean[rows, j], line.weight / models.variance[rows, j]
            solve = solver(banded_system(line, q))
            y = solve(q * mean)
            for p in range(PHONES):
                pull = q * (rows == p)
                by_mean[j, p] = 2 * (y - z[:, j]) @ solve(pull)
                by_log_variance[j, p] = 2 * (y - z[:, j]) @ solve(-pull * (mean - y))
        return by_mean, by_log_variance

    return Work(
        f"training gradient, {PHONES} phones, {dimensions} dimensions, {seconds} s",
        partial(one_by_one, each_anew, checked),
        {
            "adjoint": Contender(lambda: adjoint, tolerance=SIMPLE),
            f"{REFERENCE}, factor kept": Contender(
                lambda: partial(one_by_one, factor_kept, dimensions), tolerance=SIMPLE
            ),
        },
        bytes=dimensions * len(rows) * 8,
        operations=dimensions * len(rows) * (FACTOR + 2 * SOLVE),
        precision="float64",
        part=checked / dimensions,
        checked=np.s_[:checked],
    )


def banded_system(line, q):
    """A = diag(q) + lambda W'W of Eq. 3, the lower band."""
    band = LAMBDA * line.band.T
    band[0] += q
    return band


def each_anew(band):
    """Solves the system from its band every time."""
    return partial(solveh_banded, band, lower=True, check_finite=False)


def factor_kept(band):
    """Solves the system with a factor that is made once."""
    factor = cholesky_banded(band, lower=True, check_finite=False)
    return partial(cho_solve_banded, (factor, True), check_finite=False)
