"""Models of movement against peers, and their speed: ``python -m bench.dynamics --help``.

Peers are given the same parameters and data; their answers are compared first, then each pair takes
turns. hmmlearn's Gaussian densities stand beside the HMM mean (it evaluates all states of every
frame), nnmnkwii's maximum-likelihood parameter generation beside Brand's trajectories, statsmodels'
Kalman smoother beside that of SLDS: it knows matrices only, ours is timed with diagonals and with
matrices. Frames a second are of one core.
"""

import argparse
import itertools
import json
import sys
import time
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
from hmmlearn.stats import log_multivariate_normal_density
from statsmodels.tsa.statespace.kalman_smoother import KalmanSmoother
from threadpoolctl import threadpool_limits

from mmmgpu.dynamics import MODELS, trajectory
from mmmgpu.kalman import smooth
from mmmgpu.labelled import Labelled, batches, find_rows

PHONES, DIMENSIONS, SENTENCES, FRAMES = 40, 32, 20, 75


def drawn(rng):
    """Sentences of phones that last 2 to 7 frames, with features that follow them."""
    names = [f"phone {i}" for i in range(PHONES)]
    level = rng.normal(size=(PHONES, DIMENSIONS))
    labels, y = [], []
    for _ in range(SENTENCES):
        runs = ([names[rng.integers(PHONES)]] * rng.integers(2, 8) for _ in itertools.count())
        own = list(itertools.islice(itertools.chain.from_iterable(runs), FRAMES))
        x = np.zeros(DIMENSIONS)
        path = []
        for label in own:
            x = 0.7 * x + 0.3 * level[names.index(label)]
            path.append(x + 0.2 * rng.normal(size=DIMENSIONS))
        labels.append(own)
        y.append(np.array(path))
    return y, labels


def gaussians_of_hmmlearn(model, y, labels):
    """The log-likelihood of each sentence by hmmlearn's densities of all states."""
    rows = [find_rows(model.labels, own) for own in labels]

    def run():
        values = []
        for one, own in zip(y, rows, strict=True):
            density = log_multivariate_normal_density(one, model.mean, model.variance, "diag")
            values.append(density[np.arange(len(one)), own].sum())
        return np.array(values)

    return run


def trajectories_of_nnmnkwii(model, labels):
    """Brand's trajectories by MLPG with features and their differences.

    It takes no account of differences in the first and the last frame: a frame more at the end, in
    which nothing is tied to the others, makes the last one count, as ours does.
    """
    from nnmnkwii.paramgen import mlpg

    windows = [(0, 0, np.ones(1)), (1, 0, np.array([-1.0, 1.0]))]

    def one(own):
        rows = find_rows(model.labels, [*own, own[-1]])
        mean = np.concatenate([model.mean[rows], model.step_mean[rows]], axis=1)
        variance = np.concatenate([model.variance[rows], model.step_variance[rows]], axis=1)
        return mlpg(mean, variance, windows)[:-1]

    return lambda: np.stack([one(own) for own in labels])


def smoother_of_statsmodels(model, y, labels):
    """Log-likelihood and smoothed states of each sentence, one system of all dimensions."""
    eye = np.eye(DIMENSIONS)
    model = with_matrices(model)

    def in_time(matrices):
        return np.ascontiguousarray(np.moveaxis(matrices, 0, -1))

    def one(sequence, own):
        rows = find_rows(model.labels, own)
        later = np.append(rows[1:], rows[-1])  # its step t leads from frame t to t + 1
        k = KalmanSmoother(DIMENSIONS, DIMENSIONS, design=eye, selection=eye)
        k.bind(np.ascontiguousarray(sequence))
        k["transition"], k["state_intercept"] = in_time(model.A[later]), model.nu[later].T
        k["state_cov"], k["obs_cov"] = in_time(model.Q[later]), in_time(model.R[rows])
        k.initialize_known(model.mu[rows[0]], model.Sigma[rows[0]])
        found = k.smooth()
        return float(found.llf_obs.sum()), found.smoothed_state.T

    def run():
        found = [one(*pair) for pair in zip(y, labels, strict=True)]
        return np.array([v for v, _ in found]), np.stack([m for _, m in found])

    return run


def with_matrices(model):
    """`model` with its diagonals as matrices."""
    eye = np.eye(DIMENSIONS)
    full = {name: getattr(model, name)[:, :, None] * eye for name in ("Sigma", "A", "Q", "R")}
    return replace(model, **full)


def our_smoother(model, y, labels):
    """Log-likelihood and smoothed states of each sentence, by ours."""
    rows = tuple(find_rows(model.labels, own) for own in labels)
    data = Labelled(tuple(y), model.labels, rows)
    (batch,) = batches(data, frames=SENTENCES * FRAMES)

    def run():
        found = smooth(model.system, batch)
        back = np.argsort(batch.order)
        return found.log_likelihood[back], found.mean.reshape(*batch.y.shape)[back]

    return run


def medians(runs, repeat):
    """Median seconds of each; they take turns."""
    seconds = {name: [] for name in runs}
    for _ in range(repeat):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - start)
    return {name: float(np.median(s)) for name, s in seconds.items()}


def against(name, ours, theirs, repeat):
    """Compare the answers of two functions, then their times."""
    pairs = zip(as_tuple(ours()), as_tuple(theirs()), strict=True)
    error = max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs)
    if error > 1e-8:
        raise SystemExit(f"{name}: not equal to the peer, so not timed: {error:.1e}")
    found = medians({"ours": ours, "peer": theirs}, repeat)
    found |= {"ratio": found["ours"] / found["peer"], "error": error}
    line = f"{1e3 * found['ours']:9.2f} ms, peer {1e3 * found['peer']:9.2f} ms"
    print(f"{name:36}{line}   {found['ratio']:.3f} x   differs by {error:.0e}", flush=True)
    return found


def as_tuple(result):
    """One answer or several as a tuple."""
    return result if isinstance(result, tuple) else (result,)


def speeds(models, labels, frames):
    """Frames a second that each model generates."""
    said = list(itertools.islice(itertools.cycle(itertools.chain.from_iterable(labels)), frames))
    found = {}
    for name, model in models.items():
        start = time.perf_counter()
        for _ in model.generate(said):
            pass
        found[name] = frames / (time.perf_counter() - start)
        print(f"{name:36}{found[name]:9.0f} frames/s", flush=True)
    return found


def main(arguments):
    """Print and write all comparisons."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeat", type=int, default=9)
    parser.add_argument("--frames", type=int, default=100_000, help="generated by each model")
    parser.add_argument("--json", help="write the results here")
    options = parser.parse_args(arguments)
    with threadpool_limits(1):
        y, labels = drawn(np.random.default_rng(0))
        streaming = ("hmm", "slds", "dpds")
        models = {name: MODELS[name].fit(y, labels) for name in streaming}
        hmm, slds, brand = models["hmm"], models["slds"], MODELS["brand"].fit(y, labels)

        def likelihoods():
            pairs = zip(y, labels, strict=True)
            return np.array([hmm.log_likelihood(one, own) for one, own in pairs])

        def trajectories():
            return np.stack([trajectory(brand, own) for own in labels])

        peer = gaussians_of_hmmlearn(hmm, y, labels)
        theirs = smoother_of_statsmodels(slds, y, labels)
        diagonal = our_smoother(slds, y, labels)
        full = our_smoother(with_matrices(slds), y, labels)
        results = {
            "hmmlearn": against("likelihood, hmmlearn", likelihoods, peer, options.repeat),
            "statsmodels, diagonal": against("smoother", diagonal, theirs, options.repeat),
            "statsmodels, full": against("smoother, full", full, theirs, options.repeat),
            "frames_per_second": speeds(models, labels, options.frames),
        }
        if find_spec("nnmnkwii"):
            peer = trajectories_of_nnmnkwii(brand, labels)
            found = against("trajectory, nnmnkwii", trajectories, peer, options.repeat)
            results["nnmnkwii"] = found
        else:
            print("trajectory: no peer; pip install 'mmmgpu[peers]' compiles nnmnkwii")
    if options.json:
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump(results, file, indent=1)


if __name__ == "__main__":
    main(sys.argv[1:])
