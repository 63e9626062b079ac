"""Phone models by enumeration: every way to say an utterance, unit by unit and frame by frame."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.stats import multivariate_normal

S, B, PAUSE = "SIL", "BR", -1


def orders(words, *, breath):
    """Yield (labels, words, probability) of all orders of phones and pauses.

    `words` is a list of (index, pronunciations). Of all that may come next each is as likely: after
    n pronunciations, or the one end, there is a choice of n, beside the pauses.
    """
    nexts = words[0][1] if words else [()]
    index = words[0][0] if words else PAUSE
    n = len(nexts)
    pauses = {(): 1 / (n + 1), (S,): 1 / (n + 1) / n}
    if breath:
        pauses = {
            (): 1 / (n + 2),
            (S,): 1 / (n + 2) / (n + 1),
            (B,): 1 / (n + 2) / (n + 1),
            (S, B): 1 / (n + 2) / (n + 1) / (n + 1),
            (B, S): 1 / (n + 2) / (n + 1) / n,
            (S, B, S): 1 / (n + 2) / (n + 1) / (n + 1) / n,
        }
    tails = list(orders(words[1:], breath=breath)) if words else [((), (), 1.0)]
    for pause, p in pauses.items():
        for phones in nexts:
            for labels, owners, tail_p in tails:
                owned = (PAUSE,) * len(pause) + (index,) * len(phones) + owners
                yield (*pause, *phones, *labels), owned, p * tail_p


@dataclass(frozen=True)
class Way:
    """Of every frame the state of the models and the word; log p of the way and all frames."""

    states: tuple[int, ...]
    words: tuple[int, ...]
    stays: tuple[int, ...]  # the states that are stayed in, once for every time
    log_p: float


def density(hmms, state, x):
    """b of Rabiner: the density of one frame in a state."""
    parts = zip(hmms.weights[state], hmms.means[state], hmms.variances[state], strict=True)
    return sum(w * multivariate_normal.pdf(x, m, np.diag(v)) for w, m, v in parts if w)


def ways(hmms, words, x, *, breath):
    """Yield every `Way` to say `words` (pronunciations of each) in the frames `x` (T, D)."""
    b = [[density(hmms, q, frame) for q in range(len(hmms.stay))] for frame in x]
    for labels, owners, p in orders(list(enumerate(words)), breath=breath):
        row = [(q, w) for label, w in zip(labels, owners, strict=True) for q in hmms.states[label]]
        for cuts in combinations(range(1, len(x)), len(row) - 1):
            lengths = np.diff([0, *cuts, len(x)])
            frames = [own for own, n in zip(row, lengths, strict=True) for _ in range(n)]
            stays = [q for (q, _), n in zip(row, lengths, strict=True) for _ in range(n - 1)]
            log_p = np.log(p) + sum(np.log(hmms.stay[q]) for q in stays)
            log_p += sum(np.log(1 - hmms.stay[q]) for q, _ in row)
            log_p += sum(np.log(b[t][q]) for t, (q, _) in enumerate(frames))
            states, said = zip(*frames, strict=True)
            yield Way(states, said, tuple(stays), log_p)


def posteriors(found):
    """The log likelihood of all `found` ways, and the probability of each."""
    p = np.array([way.log_p for way in found])
    log_likelihood = p.max() + np.log(np.exp(p - p.max()).sum())
    return log_likelihood, np.exp(p - log_likelihood)


def expected(hmms, utterances):
    """Counts of Baum-Welch over utterances of (x, ways): moments (Q, M, 1 + 2 D) and stays (Q,)."""
    q, m, d = hmms.means.shape
    moments, stays = np.zeros((q, m, 1 + 2 * d)), np.zeros(q)
    for x, found in utterances:
        occupied = np.zeros((len(x), q))
        for way, p in zip(found, posteriors(found)[1], strict=True):
            for state in way.stays:
                stays[state] += p
            for t, state in enumerate(way.states):
                occupied[t, state] += p
        for t, state, i in np.ndindex(len(x), q, m):
            mean, cov = hmms.means[state, i], np.diag(hmms.variances[state, i])
            own = hmms.weights[state, i] * multivariate_normal.pdf(x[t], mean, cov)
            share = occupied[t, state] * own / density(hmms, state, x[t])
            moments[state, i] += share * np.array([1, *x[t], *x[t] ** 2])
    return moments, stays
