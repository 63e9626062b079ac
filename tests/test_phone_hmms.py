import numpy as np
import pytest
from hmms import make_hmms
from numpy.testing import assert_allclose
from oracles_hmms import density, posteriors, ways

from mmmgpu.phone_hmms import (
    IMPOSSIBLE,
    forward_backward,
    log_components,
    log_densities,
    viterbi,
)
from mmmgpu.phone_networks import unroll

CASES = {
    "one phone": ([[("B",)]], False, 4),
    "one frame a state": ([[("A",)]], False, 2),
    "two words": ([[("A",)], [("B",)]], False, 6),
    "two pronunciations": ([[("A",), ("B", "B")], [("B",)]], False, 6),
    "breath": ([[("B",)], [("A",)]], True, 7),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
@pytest.mark.parametrize("seed", [0, 1])
def test_sums_and_the_best_way_equal_enumeration(case, seed):
    words, breath, n_frames = case
    hmms = make_hmms(seed)
    x = np.random.default_rng(seed + 10).normal(0, 1.5, (n_frames, 2))
    network = unroll(words, hmms.states, breath=breath)
    stay = hmms.stay[network.state]
    found = list(ways(hmms, words, x, breath=breath))
    log_likelihood, p = posteriors(found)
    best = max(found, key=lambda way: way.log_p)

    gamma, stays, total = forward_backward(network, stay, log_densities(hmms, network, x))
    assert total == pytest.approx(log_likelihood, rel=1e-12)
    word_of = np.array([unit.word for unit in network.units])[network.unit]
    for word in range(-1, len(words)):
        for q in range(len(hmms.stay)):
            mine = gamma[:, (network.state == q) & (word_of == word)].sum(axis=1)
            inside = [np.array(way.states) == q for way in found] & (
                np.array([way.words for way in found]) == word
            )
            assert_allclose(mine, p @ inside, rtol=1e-9, atol=1e-12)
    wanted = [
        sum(pi * way.stays.count(q) for way, pi in zip(found, p, strict=True))
        for q in range(len(hmms.stay))
    ]
    mine = np.bincount(network.state, stays, len(hmms.stay))
    assert_allclose(mine, wanted, rtol=1e-9, atol=1e-12)

    path = viterbi(network, stay, log_densities(hmms, network, x))
    assert network.state[path.states].tolist() == list(best.states)
    assert word_of[path.states].tolist() == list(best.words)
    assert path.log_probability == pytest.approx(best.log_p, rel=1e-12)


def test_densities_are_those_of_gaussians():
    hmms = make_hmms(3, gaussians=3, dims=4)
    x = np.random.default_rng(4).normal(0, 2, (5, 4))
    got = np.exp(log_components(hmms, np.array([4, 0]), x)).sum(axis=2)
    assert_allclose(got, [[density(hmms, q, frame) for q in (4, 0)] for frame in x], rtol=1e-10)


def test_a_gaussian_of_weight_0_is_not_there():
    hmms = make_hmms(5)
    hmms.weights[2] = [1, 0]
    alone = log_components(hmms, np.array([2]), hmms.means[2])
    assert (alone[..., 1] < IMPOSSIBLE / 2).all()
    assert_allclose(np.exp(alone).sum(axis=2), np.exp(alone[..., 0]), rtol=0, atol=0)


def test_frames_that_nothing_explains_do_no_harm():
    """Densities far below the least float: probabilities stay probabilities."""
    words = [[("A",)], [("B", "A")]]
    hmms = make_hmms(7)
    network = unroll(words, hmms.states, breath=True)
    x = np.random.default_rng(8).normal(0, 1, (40, 2))
    x[10:20] += 1e4
    found = forward_backward(network, hmms.stay[network.state], log_densities(hmms, network, x))
    assert np.isfinite(found.log_likelihood)
    assert found.log_likelihood < -1e8
    assert_allclose(found.gamma.sum(axis=1), 1, rtol=1e-6)
    path = viterbi(network, hmms.stay[network.state], log_densities(hmms, network, x))
    assert path.log_probability <= found.log_likelihood


def test_inputs_are_left_alone_and_bits_repeat():
    hmms = make_hmms(9)
    network = unroll(CASES["breath"][0], hmms.states, breath=True)
    b = log_densities(hmms, network, np.random.default_rng(0).normal(0, 1, (30, 2)))
    stay, before = hmms.stay[network.state], b.copy()
    first, again = (forward_backward(network, stay, b) for _ in range(2))
    assert (b == before).all()
    assert (first.gamma == again.gamma).all()
