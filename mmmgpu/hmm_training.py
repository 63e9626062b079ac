"""Phone models from sound and transcripts alone: flat start, embedded Baum-Welch, splitting.

No phone is shown to the training: each utterance is a network of all that its transcript allows
(phone_networks), and all models are re-estimated from what the networks say of every frame.
Baum-Welch never lowers the likelihood; splitting Gaussians may, a little, until it has run again.
Sources: Rabiner 1989 (Eq. 40, 52-54); the recipe, The HTK Book (Young et al.), for ECR07 used HTK.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mmmgpu.parallel import one_thread_each
from mmmgpu.phone_hmms import PhoneHmms, forward_backward, log_components
from mmmgpu.phone_networks import BREATH, Network
from mmmgpu.phones import SIL

Array = NDArray[np.float64]

STATES: Final = 3  # of a phone, and of silence
BREATH_STATES: Final = 10  # no breath is shorter than so many frames; what is, is a closed mouth
ROUNDS: Final = (8, 4, 4)  # of Baum-Welch, with 1, 2 and 4 Gaussians a state
FIRST_STAY: Final = 0.6  # a phone of 75 ms
STAY_RANGE: Final = (0.05, 0.99)
FLOOR: Final = 0.01  # the least variance, as a share of that of all frames
FEWEST_FRAMES: Final = 3.0  # a Gaussian that explains fewer keeps its place and width
SPLIT_FRAMES: Final = 30.0  # a Gaussian that explains fewer is not split
SPLIT_APART: Final = 0.2  # deviations, to either side


@dataclass(frozen=True)
class Utterance:
    """The features of one clip, (T, D), and the network of its transcript."""

    features: Array
    network: Network


class Expected(NamedTuple):
    """What Baum-Welch counts, summed over all frames of all utterances.

    moments: of each Gaussian its share of the frames, of their features and of their squares,
        (Q, M, 1 + 2 D).
    stays: how often each state is stayed in, (Q,).
    log_likelihood: of everything, under the models that the counts are made with.
    """

    moments: Array
    stays: Array
    log_likelihood: float


class Round(NamedTuple):
    """One round of training: the models after it, and the log likelihood before it."""

    hmms: PhoneHmms
    log_likelihood: float


def flat_start(labels: Sequence[str], features: Sequence[Array]) -> PhoneHmms:
    """Return models of `labels` with one Gaussian a state, all alike but those of silence.

    Were silence alike too, the first and last words of short clips would take the silence about
    them and keep it. So the quiet frames begin as silence, the loud ones as anything else: two
    means of the first feature, the loudness. Where nothing is quiet all begin alike.

    Args:
        labels: The phones, `SIL` among them.
        features: (T, D) of every clip.
    """
    x = np.concatenate(features)
    lengths = [BREATH_STATES if label == BREATH else STATES for label in labels]
    bounds = pairwise(accumulate(lengths, initial=0))
    states = {label: range(*ends) for label, ends in zip(labels, bounds, strict=True)}
    quiet = _is_quiet(x[:, 0])
    means = np.tile(x[~quiet].mean(axis=0), (sum(lengths), 1, 1))
    variances = np.tile(x[~quiet].var(axis=0), (sum(lengths), 1, 1))
    if quiet.any():
        means[states[SIL]] = x[quiet].mean(axis=0)
        variances[states[SIL]] = x[quiet].var(axis=0)
    return PhoneHmms(
        states=states,
        weights=np.ones(means.shape[:2]),
        means=means,
        variances=np.maximum(variances, variance_floor(features)),
        stay=np.full(len(means), FIRST_STAY),
    )


def _is_quiet(loudness: Array) -> NDArray[np.bool_]:
    """Return which frames lie nearer to the lower of two means, (T,); none if all are alike."""
    low, high = np.quantile(loudness, [0.1, 0.9])
    for _ in range(100):
        quiet = loudness < (low + high) / 2
        if not quiet.any():
            break
        before = low, high
        low, high = loudness[quiet].mean(), loudness[~quiet].mean()
        if (low, high) == before:
            break
    return np.asarray(quiet)


def variance_floor(features: Sequence[Array]) -> Array:
    """Return the least variance that a Gaussian may have in each dimension, (D,)."""
    floor: Array = FLOOR * np.concatenate(features).var(axis=0)
    return floor


def train(
    hmms: PhoneHmms,
    utterances: Sequence[Utterance],
    *,
    first: int = 0,
    advance: Callable[[int], None] = lambda n: None,
) -> Iterator[Round]:
    """Yield every round of `ROUNDS` from `first` on; `hmms` are those of the round before.

    After the last round of each number of Gaussians but the last they are split.

    Args:
        hmms: Of a flat start, or of an earlier round.
        utterances: Each with at least as many frames as its network needs.
        first: The number of rounds that are done.
        advance: Called with 1 after every utterance of every round.
    """
    floor = variance_floor([u.features for u in utterances])
    last_of = set(accumulate(ROUNDS)) - {sum(ROUNDS)}
    for done in range(first + 1, sum(ROUNDS) + 1):
        expected = expect(hmms, utterances, advance=advance)
        hmms = reestimate(hmms, expected, floor)
        if done in last_of:
            hmms = split(hmms, expected.moments[..., 0])
        yield Round(hmms, expected.log_likelihood)


def expect(
    hmms: PhoneHmms,
    utterances: Sequence[Utterance],
    *,
    advance: Callable[[int], None] = lambda n: None,
) -> Expected:
    """Return what `hmms` expect of `utterances` (the E step)."""
    q, m, d = hmms.means.shape
    moments, stays, log_likelihood = np.zeros((q, m, 1 + 2 * d)), np.zeros(q), 0.0
    with one_thread_each():
        for utterance in utterances:
            states, found = _expect_one(hmms, utterance)
            moments[states] += found.moments
            stays[states] += found.stays
            log_likelihood += found.log_likelihood
            advance(1)
    return Expected(moments, stays, log_likelihood)


def _expect_one(hmms: PhoneHmms, utterance: Utterance) -> tuple[NDArray[np.int64], Expected]:
    """Return the states of `hmms` in one utterance, N of them, and what is counted for those."""
    x, network = utterance.features, utterance.network
    states, at = np.unique(network.state, return_inverse=True)
    components = log_components(hmms, states, x)  # (T, N, M)
    log_b = np.logaddexp.reduce(components, axis=2)
    found = forward_backward(network, hmms.stay[network.state], log_b[:, at])
    owner = np.eye(len(states))[at]  # (S, N)
    occupied = found.gamma @ owner  # (T, N)
    gamma = np.exp(components - log_b[..., None]) * occupied[..., None]
    powers = np.concatenate([np.ones((len(x), 1)), x, x * x], axis=1)
    moments = gamma.reshape(len(x), -1).T @ powers
    stays = found.stays @ owner
    return states, Expected(moments.reshape(*gamma.shape[1:], -1), stays, found.log_likelihood)


def reestimate(hmms: PhoneHmms, expected: Expected, floor: Array) -> PhoneHmms:
    """Return the most likely models for what was `expected` (the M step; Rabiner Eq. 40, 52-54).

    Variances are at least `floor` (D,), stay probabilities within `STAY_RANGE`; a Gaussian with
    fewer than `FEWEST_FRAMES` keeps its mean and variance. Neither lets the likelihood fall.
    """
    d = len(floor)
    frames = expected.moments[..., 0]
    in_state = frames.sum(axis=1)
    seen = in_state > 0
    enough = (frames >= FEWEST_FRAMES)[..., None]
    per_frame = expected.moments[..., 1:] / np.where(enough, frames[..., None], 1.0)
    mean = per_frame[..., :d]
    variance = np.maximum(per_frame[..., d:] - mean * mean, floor)
    known = np.where(seen, in_state, 1.0)
    return replace(
        hmms,
        weights=np.where(seen[:, None], frames / known[:, None], hmms.weights),
        means=np.where(enough, mean, hmms.means),
        variances=np.where(enough, variance, hmms.variances),
        stay=np.where(seen, np.clip(expected.stays / known, *STAY_RANGE), hmms.stay),
    )


def split(hmms: PhoneHmms, frames: Array) -> PhoneHmms:
    """Return `hmms` with two Gaussians for each, `SPLIT_APART` to either side, of half the weight.

    Where a Gaussian explains fewer than `SPLIT_FRAMES` of the `frames` (Q, M), the second has
    weight 0, and it stays as it is.
    """
    splits = frames >= SPLIT_FRAMES
    weights = np.where(splits, hmms.weights / 2, hmms.weights)
    apart = np.where(splits[..., None], SPLIT_APART * np.sqrt(hmms.variances), 0.0)
    return replace(
        hmms,
        weights=np.concatenate([weights, np.where(splits, weights, 0.0)], axis=1),
        means=np.concatenate([hmms.means - apart, hmms.means + apart], axis=1),
        variances=np.concatenate([hmms.variances, hmms.variances], axis=1),
    )
