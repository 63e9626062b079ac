from collections import Counter
from itertools import permutations

import numpy as np
import pytest
from studied import CONDITIONS

from mmmgpu.study_plans import draw_plan, least_used

SAID = tuple(f"s{i}" for i in range(20))


def draw(*, seed=0, conditions=CONDITIONS, sentences=SAID, participants=7, **numbers):
    numbers = {"checks": 2, **numbers}
    rng = np.random.default_rng(seed)
    return draw_plan(
        conditions, sentences, real="reality", participants=participants, rng=rng, **numbers
    )


def sides(pairs):
    return [(p.left, p.right) for p in pairs]


def votes(pairs):
    return [s for s in sides(pairs) if None not in s]


def test_everybody_sees_each_ordered_pair_once():
    for pairs in draw():
        assert sorted(votes(pairs)) == sorted(permutations(CONDITIONS, 2))
        assert len(votes(pairs)) == 12


def test_everybody_gets_the_checks_on_both_sides():
    for pairs in draw():
        checks = [s for s in sides(pairs) if None in s]
        assert sorted(checks, key=str) == [("reality", None), (None, "reality")]
    assert all(None not in s for pairs in draw(checks=0) for s in sides(pairs))


@pytest.mark.parametrize("number", [1, 5, 7, 12, 17, 30])
def test_any_number_of_pairs_is_balanced_to_one(number):
    plan = draw(pairs=number, participants=11)
    assert all(len(votes(pairs)) == number for pairs in plan)
    counts = Counter(s for pairs in plan for s in votes(pairs))
    all_counts = [counts[s] for s in permutations(CONDITIONS, 2)]
    assert max(all_counts) - min(all_counts) <= 1
    for pairs in plan:
        own = Counter(votes(pairs))
        assert max(own.values()) <= -(-number // 12)


def test_one_check_each_changes_sides():
    plan = draw(checks=1, participants=10)
    counts = Counter(s for pairs in plan for s in sides(pairs) if None in s)
    assert set(counts.values()) == {5}


def test_nobody_sees_a_sentence_twice_and_all_are_used_alike():
    plan = draw(participants=10)
    assert all(len({p.sentence for p in pairs}) == 14 for pairs in plan)
    counts = Counter(p.sentence for pairs in plan for p in pairs)
    assert [counts[s] for s in SAID] == [7] * 20


def test_few_sentences_are_repeated_alike():
    for pairs in draw(sentences=SAID[:3]):
        assert sorted(Counter(p.sentence for p in pairs).values()) == [4, 5, 5]


def test_order_and_sentences_are_random():
    plan = draw(participants=200)
    first = Counter(sides(pairs)[0] for pairs in plan)
    assert len(first) == 14
    assert max(first.values()) < 40
    together = {(p.sentence, p.left, p.right) for pairs in plan for p in pairs}
    assert len(together) > 0.9 * 20 * 14


@pytest.mark.parametrize("number", [3, 7])
def test_every_pair_meets_every_sentence(number):
    plan = draw(sentences=SAID[:number], participants=100)
    met = Counter((p.sentence, p.left, p.right) for pairs in plan for p in pairs)
    assert len(met) == number * 14
    assert max(met.values()) < 4 * min(met.values())


def test_the_seed_decides():
    assert draw(seed=3) == draw(seed=3)
    assert draw(seed=3) != draw(seed=4)


def test_two_conditions():
    for pairs in draw(conditions=("reality", "x"), checks=0):
        assert sorted(votes(pairs)) == [("reality", "x"), ("x", "reality")]


def test_the_least_used_come_first():
    used = np.array([3, 1, 2, 1])
    chosen = least_used(used, 2, np.random.default_rng(0))
    assert sorted(chosen) == [1, 3]
    assert used.tolist() == [3, 1, 2, 1]
    assert sorted(least_used(used, 5, np.random.default_rng(0))) in (
        [0, 1, 1, 2, 3],
        [0, 1, 2, 3, 3],
    )
