from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles_hmms import orders

from mmmgpu.phone_networks import BREATH, IMPOSSIBLE, PAUSE, unroll

STATES = {"SIL": range(3, 5), "A": range(0, 3), "B": range(5, 6), BREATH: range(6, 8)}
WORDS = {
    "one": [[("A", "B")]],
    "two": [[("A",)], [("B", "A")]],
    "choices": [[("A",), ("B", "A")], [("B",), ("A",), ("A", "A")]],
}


def ways_through(network):
    """Yield (units, log probability) of every way, state by state, that stays nowhere."""
    n = len(network.state)

    def go(s, said, log_p):
        if network.log_end[s] > IMPOSSIBLE:
            yield said, log_p + network.log_end[s]
        for after, p in zip(*(table[:, s] for table in network.departures), strict=True):
            if after < n:
                more = (network.unit[after],) if network.unit[after] != network.unit[s] else ()
                yield from go(after, said + more, log_p + p)

    for s in np.flatnonzero(network.log_start > IMPOSSIBLE):
        yield from go(s, (network.unit[s],), network.log_start[s])


@pytest.mark.parametrize("breath", [False, True])
@pytest.mark.parametrize("words", WORDS.values(), ids=WORDS)
def test_the_ways_are_all_orders_of_phones_and_pauses(words, breath):
    network = unroll(words, STATES, breath=breath)
    found = Counter()
    for units, log_p in ways_through(network):
        said = [network.units[u] for u in units]
        found[tuple(u.label for u in said), tuple(u.word for u in said)] += np.exp(log_p)
    wanted = {(a, b): p for a, b, p in orders(list(enumerate(words)), breath=breath)}
    assert found.keys() == wanted.keys()
    assert_allclose([found[key] for key in wanted], list(wanted.values()), rtol=1e-12)
    assert sum(found.values()) == pytest.approx(1)


@pytest.mark.parametrize("words", WORDS.values(), ids=WORDS)
def test_a_unit_is_its_phones_states_in_order(words):
    network = unroll(words, STATES, breath=True)
    for u, unit in enumerate(network.units):
        assert network.state[network.unit == u].tolist() == list(STATES[unit.label])
        inside = np.flatnonzero(network.unit == u)
        for a, b in pairwise(inside):
            assert network.arrivals.states[:, b].tolist()[0] == a
            assert (network.arrivals.states[1:, b] == len(network.state)).all()
    assert {u.word for u in network.units} == {PAUSE, *range(len(words))}


@pytest.mark.parametrize("words", WORDS.values(), ids=WORDS)
def test_arrivals_and_departures_are_the_same_moves_and_go_forward(words):
    network = unroll(words, STATES, breath=True)
    n = len(network.state)

    def moves(table):
        return {
            (s, int(other), float(p))
            for s in range(n)
            for other, p in zip(table.states[:, s], table.log_p[:, s], strict=True)
            if other < n
        }

    assert {(a, b, p) for b, a, p in moves(network.arrivals)} == moves(network.departures)
    assert all(a < b for a, b, _ in moves(network.departures))
