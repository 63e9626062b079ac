"""Hidden Markov models of phones: mixtures of Gaussians and stay probabilities, state by state.

Each phone has a few states from left to right, entered at the first and left from the last; a state
is stayed in with a probability of its own. Given the network of an utterance (phone_networks), the
sums over all ways through it and the best one are found by dynamic programming over (frame, state),
in logarithms. Source: Rabiner, "A tutorial on hidden Markov models and selected applications in
speech recognition", Proc. IEEE 77(2), 1989, in its letters: a, b, alpha, beta, gamma, delta.
Training them is the business of hmm_training.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mmmgpu.phone_networks import IMPOSSIBLE, Network

Array = NDArray[np.float64]

LOG_2PI: Final = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class PhoneHmms:
    """Q states of all phones, with M Gaussians of diagonal covariance each, in D dimensions.

    b_q(x) = sum_m weights[q, m] N(x; means[q, m], diag variances[q, m]).

    states: of each phone, in order.
    weights: (Q, M), rows with sum 1; 0 for a Gaussian that a state does not have.
    means, variances: (Q, M, D). stay: probability of staying for another frame, (Q,).
    """

    states: Mapping[str, range]
    weights: Array
    means: Array
    variances: Array
    stay: Array


class Posteriors(NamedTuple):
    """Given all frames of an utterance: gamma, (T, S), the probability of each state of its network
    in each frame; the expected number of frames that each is stayed in, (S,); the log likelihood.
    """

    gamma: Array
    stays: Array
    log_likelihood: float


class Path(NamedTuple):
    """The most likely states: of each frame its state in the network, (T,), and log probability."""

    states: NDArray[np.int64]
    log_probability: float


def log_components(hmms: PhoneHmms, states: NDArray[np.int64], x: Array) -> Array:
    """Return log(weight * density) of every Gaussian of `states` at `x` (T, D): (T, N, M).

    As a matrix product of [x, x^2], good to about 1e-12 of their scale where that is moderate;
    features are, for their mean is 0.
    """
    with np.errstate(divide="ignore"):
        log_w = np.maximum(np.log(hmms.weights[states]), IMPOSSIBLE)
    m, v = hmms.means[states], hmms.variances[states]
    constant = log_w - 0.5 * (np.log(v) + LOG_2PI + m * m / v).sum(axis=-1)  # (N, M)
    linear = np.concatenate([m / v, -0.5 / v], axis=-1)  # (N, M, 2 D)
    products = np.concatenate([x, x * x], axis=1) @ linear.reshape(-1, linear.shape[-1]).T
    log_parts: Array = constant + products.reshape(len(x), *constant.shape)
    return log_parts


def log_densities(hmms: PhoneHmms, network: Network, x: Array) -> Array:
    """Return log b at `x` (T, D) in each state of `network`, (T, S)."""
    states, at = np.unique(network.state, return_inverse=True)
    log_b: Array = np.logaddexp.reduce(log_components(hmms, states, x), axis=2)
    return log_b[:, at]


def forward_backward(network: Network, stay: Array, log_b: Array) -> Posteriors:
    """Return what is known of the states of `network` when all frames are (Rabiner Eq. 19-27).

    Args:
        network: Of the utterance; it needs no more than T frames.
        stay: Stay probabilities of its states, (S,), inside (0, 1).
        log_b: Log densities of the frames in its states, (T, S).
    """
    log_stay, log_leave = np.log(stay), np.log1p(-stay)
    alpha = _forward(network, log_stay, log_leave, log_b)
    log_likelihood = float(np.logaddexp.reduce(alpha[-1] + log_leave + network.log_end))
    beta = _backward(network, log_stay, log_leave, log_b)
    gamma = np.exp(alpha + beta - log_likelihood)
    stays = np.exp(alpha[:-1] + log_stay + log_b[1:] + beta[1:] - log_likelihood).sum(axis=0)
    return Posteriors(gamma, stays, log_likelihood)


def _forward(network: Network, log_stay: Array, log_leave: Array, log_b: Array) -> Array:
    """Return log alpha, (T, S): of the frames up to t and being in s at t."""
    states, log_p = network.arrivals
    alpha = np.empty_like(log_b)
    alpha[0] = network.log_start + log_b[0]
    left = np.full(len(log_stay) + 1, IMPOSSIBLE)  # having left s; last: no state
    ways = np.empty((len(states) + 1, len(log_stay)))
    for t in range(1, len(log_b)):
        np.add(alpha[t - 1], log_leave, out=left[:-1])
        np.add(alpha[t - 1], log_stay, out=ways[0])
        np.add(left[states], log_p, out=ways[1:])
        np.add(np.logaddexp.reduce(ways, axis=0), log_b[t], out=alpha[t])
    return alpha


def _backward(network: Network, log_stay: Array, log_leave: Array, log_b: Array) -> Array:
    """Return log beta, (T, S): of the frames after t, and ending then, if in s at t."""
    states, log_p = network.departures
    beta = np.empty_like(log_b)
    beta[-1] = log_leave + network.log_end
    ahead = np.full(len(log_stay) + 1, IMPOSSIBLE)  # entering s; last: no state
    ways = np.empty((len(states) + 1, len(log_stay)))
    leaving = log_leave + log_p
    for t in range(len(log_b) - 2, -1, -1):
        np.add(beta[t + 1], log_b[t + 1], out=ahead[:-1])
        np.add(ahead[:-1], log_stay, out=ways[0])
        np.add(ahead[states], leaving, out=ways[1:])
        np.logaddexp.reduce(ways, axis=0, out=beta[t])
    return beta


def viterbi(network: Network, stay: Array, log_b: Array) -> Path:
    """Return the most likely way through `network` (Rabiner Eq. 32-35); arguments as above.

    Of equally likely ones, that which stays, then that which comes from the earliest state.
    """
    log_stay, log_leave = np.log(stay), np.log1p(-stay)
    states, log_p = network.arrivals
    n = len(stay)
    origins = np.concatenate([np.arange(n)[None], states])  # (K + 1, S)
    came_from = np.empty(log_b.shape, dtype=np.int32)
    delta = network.log_start + log_b[0]
    left = np.full(n + 1, IMPOSSIBLE)
    ways = np.empty(origins.shape)
    for t in range(1, len(log_b)):
        np.add(delta, log_leave, out=left[:-1])
        np.add(delta, log_stay, out=ways[0])
        np.add(left[states], log_p, out=ways[1:])
        best = ways.argmax(axis=0)
        came_from[t] = origins[best, origins[0]]
        delta = ways[best, origins[0]] + log_b[t]
    ended = delta + log_leave + network.log_end
    path = np.empty(len(log_b), dtype=np.int64)
    path[-1] = ended.argmax()
    for t in range(len(log_b) - 1, 0, -1):
        path[t - 1] = came_from[t, path[t]]
    return Path(path, float(ended.max()))
