import json
from collections import Counter
from itertools import combinations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from studied import planned

from mmmgpu.errors import InputError
from mmmgpu.study_results import study_results
from mmmgpu.study_statistics import bradley_terry, exact_shares, holm, sign_test
from mmmgpu.study_store import Answer

QUALITY = {"brand": 0.0, "dpds": 1.5, "reality": 1.7, "slds": -1.0, None: -9.0}


def answer_everything(study, *, seed=0, undecided=0.15):
    """Answers of people who see the conditions by QUALITY, and know a frozen picture."""
    rng = np.random.default_rng(seed)
    answers = []
    for number, participant in enumerate(study.participants, start=1):
        for n, pair in enumerate(participant.pairs, start=1):
            ahead = QUALITY[pair.left.condition] - QUALITY[pair.right.condition]
            choice = "left" if rng.random() < 1 / (1 + np.exp(-ahead)) else "right"
            choice = "undecided" if rng.random() < undecided and not pair.is_check else choice
            answers.append(Answer(number, n, choice, f"2026-01-01T00:00:{n:02}+00:00"))
    return answers


@pytest.fixture(scope="module")
def study():
    return planned(
        conditions=("brand", "dpds", "slds", "reality"),
        sentences=tuple(f"s{i}" for i in range(20)),
        participants=33,
    )


@pytest.fixture(scope="module")
def answers(study):
    return answer_everything(study)


@pytest.fixture(scope="module")
def results(study, answers):
    return study_results(study, answers)


def counted(study, answers, a, b):
    """How often A was chosen, neither, B: by going through all answers."""
    counts = Counter()
    for answer in answers:
        pair = study.participants[answer.participant - 1].pairs[answer.pair - 1]
        if {pair.left.condition, pair.right.condition} == {a, b}:
            clip = pair.chosen(answer.choice)
            counts[clip and clip.condition] += 1
    return counts[a], counts[None], counts[b]


def test_table_counts_each_pair_of_conditions(study, answers, results):
    rows = results["table"]
    assert [(row["a"], row["b"]) for row in rows] == list(combinations(study.conditions, 2))
    for row in rows:
        found = (row["prefer_a"], row["undecided"], row["prefer_b"])
        assert found == counted(study, answers, row["a"], row["b"])
        assert sum(found) == 66  # as in the paper: 33 volunteers, twice each
    assert sum(row["undecided"] for row in rows) > 20


def test_every_answer_is_in_the_table_once(results):
    cells = ("prefer_a", "undecided", "prefer_b")
    assert sum(row[cell] for row in results["table"] for cell in cells) == 33 * 12


def test_tests_are_of_the_decided_answers(results):
    rows = results["table"]
    for row in rows:
        test = exact_shares(row["prefer_a"], row["prefer_b"])
        found = [row[name] for name in ("share_a", "low", "high", "p")]
        assert found == [test.share, test.low, test.high, test.p]
    assert [row["p_holm"] for row in rows] == holm([row["p"] for row in rows]).tolist()


def test_the_sign_test_is_over_people(study, answers, results):
    for row in results["table"]:
        a, b = row["a"], row["b"]
        leanings = []
        for number in range(1, 34):
            for_a, _, for_b = counted(study, [x for x in answers if x.participant == number], a, b)
            leanings.append(for_a - for_b)
        test = sign_test(leanings)
        found = [row[name] for name in ("people_a", "people_b", "p_people")]
        assert found == [test.first, test.second, test.p]
        assert test.first + test.second < 33


def test_scale_is_that_of_the_counts(study, results):
    conditions = list(study.conditions)
    wins = np.zeros((4, 4))
    for row in results["table"]:
        a, b = conditions.index(row["a"]), conditions.index(row["b"])
        wins[a, b], wins[b, a] = row["prefer_a"], row["prefer_b"]
    fit = bradley_terry(wins)
    low, high = fit.intervals()
    values = results["scale"]["conditions"]
    assert [v["theta"] for v in values] == sorted(fit.theta, reverse=True)
    for value in values:
        i = conditions.index(value["condition"])
        assert [value["theta"], value["low"], value["high"]] == [fit.theta[i], low[i], high[i]]


def test_the_order_says_what_is_significant(results):
    best_first = [value["condition"] for value in results["scale"]["conditions"]]
    assert set(best_first[:2]) == {"dpds", "reality"}
    assert results["scale"]["order"] == f"{best_first[0]} ~ {best_first[1]} > brand > slds"


def test_theta_recovers_what_people_go_by(study):
    many = planned(conditions=study.conditions, participants=400, sentences=("a", "b"), checks=0)
    values = study_results(many, answer_everything(many))["scale"]["conditions"]
    truth = {c: QUALITY[c] - np.mean([QUALITY[x] for x in study.conditions]) for c in QUALITY}
    for value in values:
        assert_allclose(value["theta"], truth[value["condition"]], rtol=0, atol=0.12)
        assert value["high"] - value["low"] < 0.3


def test_sides_are_counted(study, results, answers):
    votes = [
        a for a in answers if not study.participants[a.participant - 1].pairs[a.pair - 1].is_check
    ]
    counts = Counter(a.choice for a in votes)
    expected = dict(counts) | {"p": exact_shares(counts["left"], counts["right"]).p}
    assert results["sides"] == expected


def test_people_are_counted(study, results):
    people = results["participants"]
    assert (people["invited"], people["begun"], people["finished"]) == (33, 33, 33)
    assert people["failed_checks"] == people["excluded"] == []
    assert people["each"][0] == {
        "participant": 1,
        "answers": 14,
        "of": 14,
        "undecided": people["each"][0]["undecided"],
        "checks": 2,
        "failed": 0,
    }


def careless(study, answers, number, choice):
    """The same answers, but participant `number` always says `choice`."""
    return [
        Answer(a.participant, a.pair, choice, a.time) if a.participant == number else a
        for a in answers
    ]


@pytest.mark.parametrize(("choice", "failed"), [("left", 1), ("undecided", 2)])
def test_who_fails_a_check_is_listed_and_can_be_left_out(study, answers, choice, failed):
    changed = careless(study, answers, 3, choice)
    kept = study_results(study, changed)
    assert kept["participants"]["failed_checks"] == [3]
    assert kept["participants"]["excluded"] == []
    assert kept["participants"]["each"][2]["failed"] == failed
    left_out = study_results(study, changed, exclude_failed=True)
    assert left_out["participants"]["excluded"] == [3]
    without = study_results(study, [a for a in changed if a.participant != 3])
    for part in ("table", "sides", "scale"):
        assert left_out[part] == without[part]
    assert kept["table"] != without["table"]
    counted = {a["participant"] for a in left_out["answers"] if a["is_counted"]}
    assert counted == set(range(1, 34)) - {3}


def test_every_answer_is_listed(study, answers, results):
    rows = results["answers"]
    assert len(rows) == 33 * 14
    assert sum(row["is_counted"] for row in rows) == 33 * 12
    pair = study.participants[1].pairs[4]
    (row,) = [r for r in rows if (r["participant"], r["pair"]) == (2, 5)]
    chosen = pair.chosen(row["choice"])
    assert row == {
        "participant": 2,
        "pair": 5,
        "sentence": pair.left.sentence,
        "is_check": pair.is_check,
        "left": pair.left.condition,
        "right": pair.right.condition,
        "choice": row["choice"],
        "chosen": chosen and chosen.condition,
        "is_counted": not pair.is_check,
        "time": "2026-01-01T00:00:05+00:00",
    }


def test_no_answers_are_no_results(study):
    empty = study_results(study, [])
    assert all(row["p"] == 1 and row["share_a"] is None for row in empty["table"])
    assert empty["scale"] == {
        "conditions": None,
        "order": None,
        "reason": "brand was never chosen: more answers are needed",
    }
    assert empty["participants"]["begun"] == 0
    json.dumps(empty, allow_nan=False)


def test_a_condition_that_was_never_rejected_has_no_place(study, answers):
    pairs = {
        (a.participant, a.pair): study.participants[a.participant - 1].pairs[a.pair - 1]
        for a in answers
    }
    always = []
    for a in answers:
        pair = pairs[a.participant, a.pair]
        side = {pair.left.condition: "left", pair.right.condition: "right"}.get("reality", a.choice)
        always.append(Answer(a.participant, a.pair, side, a.time))
    scale = study_results(study, always)["scale"]
    assert scale["reason"] == "reality was never rejected: more answers are needed"


def test_errors_stand_beside_the_votes(study, answers):
    error = {"brand": 1.0, "dpds": 2.0, "slds": 3.0}
    errors = {"L1": {(c, f"s{i}"): v + i for c, v in error.items() for i in range(20)}}
    found = study_results(study, answers, errors=errors)["errors"]["L1"]
    expected = {c: v + np.mean(range(20)) for c, v in error.items()} | {"reality": None}
    assert found["means"] == expected
    lower = [("brand", "dpds"), ("brand", "slds"), ("dpds", "slds")]
    counts = np.sum([counted(study, answers, a, b) for a, b in lower], axis=0)
    assert (found["chosen"]["lower"], found["chosen"]["higher"]) == (counts[0], counts[2])
    test = exact_shares(counts[0], counts[2])
    assert (found["chosen"]["share"], found["chosen"]["p"]) == (test.share, test.p)


@pytest.mark.parametrize(
    "answer",
    [
        Answer(34, 1, "left", ""),
        Answer(0, 1, "left", ""),
        Answer(1, 15, "left", ""),
        Answer(1, 0, "left", ""),
        Answer(1, 1, "both", ""),
    ],
)
def test_an_answer_that_does_not_belong_is_refused(study, answer):
    with pytest.raises(InputError, match="does not belong to the study"):
        study_results(study, [answer])
