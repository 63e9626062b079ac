from collections import defaultdict
from itertools import pairwise

import numpy as np
import pytest
from hmms import draw, make_hmms
from numpy.testing import assert_allclose
from oracles_hmms import expected as enumerated
from oracles_hmms import ways

from mmmgpu.hmm_training import (
    FEWEST_FRAMES,
    FLOOR,
    ROUNDS,
    SPLIT_FRAMES,
    STATES,
    STAY_RANGE,
    Utterance,
    expect,
    flat_start,
    reestimate,
    split,
    train,
    variance_floor,
)
from mmmgpu.phone_hmms import PhoneHmms, log_densities, viterbi
from mmmgpu.phone_networks import PAUSE, unroll
from mmmgpu.phones import SIL

LEXICON = [("A", "B"), ("C",), ("B", "C"), ("D", "A"), ("C", "D", "B")]
TINY = [([[("A",), ("B", "B")]], 5), ([[("B",)], [("A",)]], 6)]


def utterances_of(hmms, seed, count, words=3, frames=15):
    """Random features under random transcripts."""
    rng = np.random.default_rng(seed)
    said = [[[LEXICON[w]] for w in rng.integers(len(LEXICON), size=words)] for _ in range(count)]
    return [
        Utterance(rng.normal(0, 1, (3 * frames, 3)), unroll(w, hmms.states, breath=False))
        for w in said
    ]


def test_counts_equal_enumeration():
    hmms = make_hmms(0)
    rng = np.random.default_rng(1)
    given = [(words, rng.normal(0, 1.5, (n, 2))) for words, n in TINY]
    utterances = [Utterance(x, unroll(w, hmms.states, breath=True)) for w, x in given]
    found = expect(hmms, utterances)
    every = [(x, list(ways(hmms, w, x, breath=True))) for w, x in given]
    moments, stays = enumerated(hmms, every)
    assert_allclose(found.moments, moments, rtol=1e-9, atol=1e-12)
    assert_allclose(found.stays, stays, rtol=1e-9, atol=1e-12)


def test_models_are_the_means_of_what_is_expected():
    hmms = make_hmms(2, {"A": 2, "B": 1, SIL: 1})
    rng = np.random.default_rng(3)
    x = [rng.normal(0, 1, (100, 2)) for _ in range(3)]
    words = [[("A", "B"), ("B", "A")]]
    found = expect(hmms, [Utterance(f, unroll(words, hmms.states, breath=False)) for f in x])
    new = reestimate(hmms, found, np.full(2, 1e-6))
    frames, first, second = found.moments[..., 0], found.moments[..., 1:3], found.moments[..., 3:]
    assert (frames > FEWEST_FRAMES).all()
    assert_allclose(new.weights, frames / frames.sum(axis=1, keepdims=True), rtol=1e-12)
    mean = first / frames[..., None]
    assert_allclose(new.means, mean, rtol=1e-12)
    assert_allclose(new.variances, second / frames[..., None] - mean**2, rtol=1e-9)
    assert_allclose(new.stay, found.stays / frames.sum(axis=1), rtol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_baum_welch_never_lowers_the_likelihood(seed):
    """With Gaussians that starve, variances at their floor and stays at their bounds among them."""
    lengths = {"A": 2, "B": 3, "C": 1, "D": 3, SIL: 2}
    hmms = make_hmms(seed, lengths, gaussians=3, dims=3)
    utterances = utterances_of(hmms, seed, 5)
    floor = 8 * variance_floor([u.features for u in utterances])
    hmms = PhoneHmms(**{**vars(hmms), "variances": np.maximum(hmms.variances, floor)})
    history = []
    for _ in range(15):
        found = expect(hmms, utterances)
        history.append(found.log_likelihood)
        hmms = reestimate(hmms, found, floor)
    assert (np.diff(history) > -1e-9 * np.abs(history[0])).all()
    assert history[-1] - history[0] > 100
    assert (hmms.variances == floor).any()
    assert (found.moments[..., 0] < FEWEST_FRAMES).any()
    assert set(STAY_RANGE) & set(hmms.stay)


def test_what_was_never_seen_stays_as_it_was():
    hmms = make_hmms(4, {"A": 1, "B": 1, SIL: 1})
    x = np.random.default_rng(5).normal(0, 1, (20, 2))
    new = reestimate(
        hmms,
        expect(hmms, [Utterance(x, unroll([[("A",)]], hmms.states, breath=False))]),
        np.ones(2),
    )
    (unseen,) = hmms.states["B"]
    for name in ("weights", "means", "variances", "stay"):
        assert (getattr(new, name)[unseen] == getattr(hmms, name)[unseen]).all()
    assert not (new.means == hmms.means).all()


def test_splitting_halves_what_has_enough_frames():
    hmms = make_hmms(6, gaussians=2)
    frames = np.full((5, 2), SPLIT_FRAMES)
    frames[1, 0] = SPLIT_FRAMES - 1
    new = split(hmms, frames)
    assert new.weights.shape == (5, 4)
    assert_allclose(new.weights.sum(axis=1), 1, rtol=1e-12)
    assert_allclose(new.weights[0], np.tile(hmms.weights[0] / 2, 2), rtol=1e-12)
    assert_allclose(new.means[0, :2] + new.means[0, 2:], 2 * hmms.means[0], rtol=1e-12)
    apart = (new.means[0, 2:] - new.means[0, :2]) / np.sqrt(hmms.variances[0])
    assert_allclose(apart, 0.4, rtol=1e-12)
    assert (new.means[1, 0] == hmms.means[1, 0]).all()
    assert new.weights[1, [0, 2]].tolist() == [hmms.weights[1, 0], 0]


def test_the_flat_start_knows_nothing_but_silence():
    rng = np.random.default_rng(7)
    quiet, loud = rng.normal([-5, 1], 1, (60, 2)), rng.normal([5, 0], 2, (40, 2))
    x = rng.permutation(np.concatenate([quiet, loud]))
    hmms = flat_start(["A", SIL, "Z"], [x[:30], x[30:]])
    assert {label: list(q) for label, q in hmms.states.items()} == {
        "A": [0, 1, 2],
        SIL: [3, 4, 5],
        "Z": [6, 7, 8],
    }
    for q in (*hmms.states["A"], *hmms.states["Z"]):
        assert_allclose(hmms.means[q, 0], loud.mean(axis=0), rtol=1e-12)
        assert_allclose(hmms.variances[q, 0], loud.var(axis=0), rtol=1e-12)
    for q in hmms.states[SIL]:
        assert_allclose(hmms.means[q, 0], quiet.mean(axis=0), rtol=1e-12)
    assert (hmms.weights == 1).all()


def test_a_flat_start_without_quiet_frames_has_all_alike():
    x = np.tile([1.0, 2.0], (10, 1))
    x[:, 1] += np.arange(10)
    hmms = flat_start(["A", SIL], [x])
    assert (hmms.means == x.mean(axis=0)).all()
    assert len(hmms.means) == 2 * STATES


def test_variances_have_a_floor():
    x = np.random.default_rng(8).normal(0, [1, 3], (1000, 2))
    assert_allclose(variance_floor([x[:500], x[500:]]), FLOOR * x.var(axis=0), rtol=1e-12)


def known_language(rng):
    """Models with silence quieter than all else, and sentences drawn from them with their truth."""
    hmms = make_hmms(11, {"A": 3, "B": 3, "C": 3, "D": 3, SIL: 3}, dims=6)
    hmms.means[...] *= 2
    hmms.means[..., 0] += 2
    hmms.means[hmms.states[SIL], :, 0] = -6
    sentences = []
    for _ in range(25):
        words = [LEXICON[w] for w in rng.integers(len(LEXICON), size=4)]
        labels, owners = [SIL, SIL], [PAUSE, PAUSE]
        for w, phones in enumerate(words):
            labels += phones
            owners += [w] * len(phones)
            if rng.random() < 0.2:
                labels, owners = [*labels, SIL], [*owners, PAUSE]
        x, said = draw(hmms, [*labels, SIL, SIL], rng)
        owner = np.array([*owners, PAUSE, PAUSE])[said]
        sentences.append((x, [[phones] for phones in words], owner))
    return hmms, sentences


def aligned_words(hmms, x, words):
    """The word of every frame by the best way."""
    network = unroll(words, hmms.states, breath=False)
    path = viterbi(network, hmms.stay[network.state], log_densities(hmms, network, x))
    return np.array([unit.word for unit in network.units])[network.unit[path.states]]


def boundary_errors(hmms, sentences):
    """Frames between where words begin and end and where they were drawn to."""
    errors = []
    for x, words, truth in sentences:
        mine = aligned_words(hmms, x, words)
        for w in range(len(words)):
            a, b = np.flatnonzero(mine == w), np.flatnonzero(truth == w)
            errors += [abs(a[0] - b[0]), abs(a[-1] - b[-1])]
    return np.array(errors)


def test_what_known_models_say_is_aligned_back_by_models_trained_on_it():
    known, sentences = known_language(np.random.default_rng(12))
    best = boundary_errors(known, sentences)
    assert np.median(best) == 0
    assert (best <= 1).mean() > 0.95
    hmms = flat_start(["A", "B", "C", "D", SIL], [x for x, _, _ in sentences])
    utterances = [Utterance(x, unroll(w, hmms.states, breath=False)) for x, w, _ in sentences]
    rounds = list(train(hmms, utterances))
    found = boundary_errors(rounds[-1].hmms, sentences)
    assert np.median(found) == 0
    assert (found <= 1).mean() > 0.9


def test_rounds_and_where_training_goes_on():
    hmms = make_hmms(13, {"A": 2, "B": 3, "C": 1, "D": 3, SIL: 2}, gaussians=1, dims=3)
    utterances = utterances_of(hmms, 14, 3, words=2, frames=50)
    counted = []
    rounds = list(train(hmms, utterances, advance=counted.append))
    assert counted == [1] * (sum(ROUNDS) * len(utterances))
    assert [r.hmms.weights.shape[1] for r in rounds] == [1] * 7 + [2] * 4 + [4] * 5
    by_size = defaultdict(list)
    for before, after in pairwise(rounds):
        by_size[before.hmms.weights.shape[1]].append(after.log_likelihood)
    for history in by_size.values():
        assert (np.diff(history) > 0).all()
    again = list(train(rounds[11].hmms, utterances, first=12))
    assert [r.log_likelihood for r in again] == [r.log_likelihood for r in rounds[12:]]
    assert (again[-1].hmms.means == rounds[-1].hmms.means).all()
