"""The results of a study: who chose what, tests, and a ranking.

The table is Table 1 of Englebienne, Cootes & Rattray (NIPS 2007). Everything is counted from the
plan and the answers, and comes as JSON values. Answers to attention checks are no votes. Undecided
answers are counted apart and enter no test.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations, compress, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmmgpu.errors import InputError
from mmmgpu.studies import CHOICES, LEFT, RIGHT, UNDECIDED, Pair, Study, StudyClip
from mmmgpu.study_errors import Errors, agreement, mean_errors
from mmmgpu.study_statistics import (
    Shares,
    bradley_terry,
    exact_shares,
    has_scale,
    holm,
    sign_test,
)
from mmmgpu.study_store import Answer

SIGNIFICANT = 0.05
Value = dict[str, Any]  # of JSON


@dataclass(frozen=True)
class Vote:
    """An answer together with the pair that it was given to."""

    answer: Answer
    pair: Pair

    @property
    def decided(self) -> tuple[StudyClip, StudyClip] | None:
        """The clip that was chosen and the other one; None: undecided."""
        clips = (self.pair.left, self.pair.right)
        return {LEFT: clips, RIGHT: clips[::-1]}.get(self.answer.choice)

    @property
    def chosen(self) -> str | None:
        """The condition that was chosen; None: undecided, or a frozen clip."""
        return self.decided[0].condition if self.decided else None


def study_results(
    study: Study,
    answers: Sequence[Answer],
    *,
    exclude_failed: bool = False,
    errors: Errors | None = None,
) -> Value:
    """What the answers to a study say, as JSON values; docs/study.md describes them.

    exclude_failed: leave out all answers of participants who failed an attention check.
    errors: error measures of the clips, to be put beside the votes.

    Raises:
        InputError: An answer is to a pair that the study does not have.
    """
    everything = _votes(study, answers)
    people = participant_facts(study, everything)
    failed = {person["participant"] for person in people if person["failed"]}
    out = failed if exclude_failed else set()
    counted = [not v.pair.is_check and v.answer.participant not in out for v in everything]
    votes = list(compress(everything, counted))
    rows = table(study.conditions, votes)
    results = {
        "study": study.id,
        "conditions": list(study.conditions),
        "participants": _participation(study, people, excluded=sorted(out)),
        "table": rows,
        "sides": _sides(votes),
        "scale": scale(study.conditions, votes, rows),
        "answers": [
            _answer_facts(vote, is_counted=counts)
            for vote, counts in zip(everything, counted, strict=True)
        ],
    }
    return results if errors is None else results | {"errors": beside(study, votes, errors)}


def _votes(study: Study, answers: Sequence[Answer]) -> list[Vote]:
    votes = []
    for answer in answers:
        people, pair = study.participants, answer.pair
        known = 1 <= answer.participant <= len(people)
        if (
            not known
            or not 1 <= pair <= len(people[answer.participant - 1].pairs)
            or answer.choice not in CHOICES
        ):
            raise InputError(
                f"the database holds an answer that does not belong to the study ({answer}); "
                "it was changed by something else: restore it"
            )
        votes.append(Vote(answer, people[answer.participant - 1].pairs[pair - 1]))
    return votes


def _answer_facts(vote: Vote, *, is_counted: bool) -> Value:
    return {
        "participant": vote.answer.participant,
        "pair": vote.answer.pair,
        "sentence": vote.pair.left.sentence,
        "is_check": vote.pair.is_check,
        "left": vote.pair.left.condition,
        "right": vote.pair.right.condition,
        "choice": vote.answer.choice,
        "chosen": vote.chosen,
        "is_counted": is_counted,
        "time": vote.answer.time,
    }


def participant_facts(study: Study, votes: Sequence[Vote]) -> list[Value]:
    """A row for each participant who has begun: answers, attention checks answered and failed."""
    rows = []
    votes_of: dict[int, list[Vote]] = {}
    for vote in votes:
        votes_of.setdefault(vote.answer.participant, []).append(vote)
    for number, own in sorted(votes_of.items()):
        checks = [vote for vote in own if vote.pair.is_check]
        rows.append(
            {
                "participant": number,
                "answers": len(own),
                "of": len(study.participants[number - 1].pairs),
                "undecided": sum(vote.answer.choice == UNDECIDED for vote in own),
                "checks": len(checks),
                "failed": sum(vote.chosen is None for vote in checks),
            }
        )
    return rows


def _participation(study: Study, people: Sequence[Value], *, excluded: Sequence[int]) -> Value:
    return {
        "invited": len(study.participants),
        "begun": len(people),
        "finished": sum(person["answers"] == person["of"] for person in people),
        "failed_checks": [person["participant"] for person in people if person["failed"]],
        "excluded": list(excluded),
        "each": list(people),
    }


def table(conditions: Sequence[str], votes: Sequence[Vote]) -> list[Value]:
    """Table 1: a row for each two conditions.

    prefer_a, undecided, prefer_b: answers. share_a, low, high, p: exact, of those decided. p_holm:
    p, adjusted for all rows. people_a, people_b, p_people: participants who chose A more often
    than B, and the reverse, and their sign test.
    """
    rows: list[Value] = []
    for a, b in combinations(conditions, 2):
        own = [v for v in votes if {v.pair.left.condition, v.pair.right.condition} == {a, b}]
        chosen_a, chosen_b = ([v for v in own if v.chosen == condition] for condition in (a, b))
        test = exact_shares(len(chosen_a), len(chosen_b))
        people = sign_test(_leanings(chosen_a, chosen_b))
        rows.append(
            {
                "a": a,
                "prefer_a": test.first,
                "undecided": len(own) - test.first - test.second,
                "prefer_b": test.second,
                "b": b,
                "share_a": test.share,
                "low": test.low,
                "high": test.high,
                "p": test.p,
                "people_a": people.first,
                "people_b": people.second,
                "p_people": people.p,
            }
        )
    adjusted = holm([row["p"] for row in rows])
    return [row | {"p_holm": float(p)} for row, p in zip(rows, adjusted, strict=True)]


def _leanings(chosen_a: Sequence[Vote], chosen_b: Sequence[Vote]) -> list[int]:
    """Of each participant, how much more often A was chosen than B."""
    for_a, for_b = (Counter(v.answer.participant for v in votes) for votes in (chosen_a, chosen_b))
    return [for_a[number] - for_b[number] for number in {*for_a, *for_b}]


def _sides(votes: Sequence[Vote]) -> Value:
    """Whether one side was chosen more often, whatever was on it."""
    counts = {choice: sum(v.answer.choice == choice for v in votes) for choice in CHOICES}
    return counts | {"p": exact_shares(counts[LEFT], counts[RIGHT]).p}


def scale(conditions: Sequence[str], votes: Sequence[Vote], rows: Sequence[Value]) -> Value:
    """The conditions on one scale (Bradley-Terry), the best first, and their order in one line.

    rows: of `table`. In the line, > stands between two whose row is significant (p_holm).
    """
    wins = count_wins(conditions, votes)
    if not has_scale(wins):
        return {"conditions": None, "order": None, "reason": _no_scale(conditions, wins)}
    fit = bradley_terry(wins)
    low, high = fit.intervals()
    values: list[Value] = [
        {"condition": c, "theta": float(t), "low": float(lo), "high": float(hi)}
        for c, t, lo, hi in zip(conditions, fit.theta, low, high, strict=True)
    ]
    values.sort(key=lambda value: -value["theta"])
    order = _order([value["condition"] for value in values], rows)
    return {"conditions": values, "order": order, "reason": None}


def count_wins(conditions: Sequence[str], votes: Iterable[Vote]) -> NDArray[np.int64]:
    """How often i was chosen over j, (C, C)."""
    wins = np.zeros((len(conditions), len(conditions)), np.int64)
    for vote in votes:
        if vote.decided is not None:
            chosen, other = (conditions.index(str(clip.condition)) for clip in vote.decided)
            wins[chosen, other] += 1
    return wins


def _no_scale(conditions: Sequence[str], wins: NDArray[np.int64]) -> str:
    """Why the conditions have no finite distance."""
    for condition, won, lost in zip(conditions, wins.sum(axis=1), wins.sum(axis=0), strict=True):
        for what, count in (("chosen", won), ("rejected", lost)):
            if count == 0:
                return f"{condition} was never {what}: more answers are needed"
    return "some conditions were never chosen over the others: more answers are needed"


def _order(best_first: Sequence[str], rows: Sequence[Value]) -> str:
    p = {frozenset((row["a"], row["b"])): row["p_holm"] for row in rows}
    line = best_first[0]
    for one, other in pairwise(best_first):
        sign = ">" if p[frozenset((one, other))] < SIGNIFICANT else "~"
        line += f" {sign} {other}"
    return line


def beside(study: Study, votes: Sequence[Vote], errors: Errors) -> Value:
    """Of each measure its mean by condition, and how often its lower value was chosen."""
    sentences = sorted({clip.sentence for clip in study.clips})
    means = mean_errors(errors, study.conditions, sentences)
    lower = agreement(errors, [v.decided for v in votes if v.decided is not None])
    return {
        metric: {"means": means[metric], "chosen": _lower(shares)}
        for metric, shares in lower.items()
    }


def _lower(shares: Shares) -> Mapping[str, Any]:
    names = {"first": "lower", "second": "higher"}
    return {names.get(name, name): value for name, value in asdict(shares).items()}
