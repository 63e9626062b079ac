"""A transcript unrolled: the states of phone models in every order in which it may be said.

A network holds units (one phone of one pronunciation of one word, or a pause) and says which may
follow which; unrolled, each unit becomes the left-to-right states of its phone model. Between words
and at both ends there may be nothing, silence, a breath, or a breath with silence before it, behind
it or both (ECR07 section 2 has labels for breath and silence). What the states sound like is the
business of phone_hmms.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mmmgpu.phones import SIL

BREATH: Final = "BR"  # as in CE05's inventory
PAUSE: Final = -1  # the word of a unit that belongs to none
IMPOSSIBLE: Final = -1e30  # log of a probability of 0 that can still be added and subtracted
_EDGE: Final = -1  # in place of a unit: the beginning of the utterance

Pronunciations = Sequence[Sequence[str]]


class Unit(NamedTuple):
    """One phone in a network: its label, the index of its word, and the units it may follow."""

    label: str
    word: int
    after: tuple[int, ...]


class Moves(NamedTuple):
    """From or to each of S states: the other states, (K, S), and log probabilities, (K, S).

    Where there are fewer than K the state is S.
    """

    states: NDArray[np.int64]
    log_p: NDArray[np.float64]


@dataclass(frozen=True)
class Network:
    """The S states of one utterance; a state comes after all that it may follow.

    units: in the same order. unit: the unit of each state, (S,).
    state: which state of the phone models each is, (S,).
    arrivals, departures: where each state may be entered from and left to, itself left out; the
        probabilities are those of the one move among all that leave a state.
    log_start: log probability of beginning with each state, (S,).
    log_end: that of ending when leaving it, (S,).
    """

    units: tuple[Unit, ...]
    unit: NDArray[np.int64]
    state: NDArray[np.int64]
    arrivals: Moves
    departures: Moves
    log_start: NDArray[np.float64]
    log_end: NDArray[np.float64]


def unroll(
    words: Sequence[Pronunciations], states: Mapping[str, range], *, breath: bool
) -> Network:
    """Return the network of `words`, each given by its pronunciations.

    Of all that may follow a unit, the end of the utterance among it, each is equally likely.

    Args:
        words: At least one, of each at least one pronunciation of at least one phone.
        states: The states of each phone's model, in order; those of SIL, and of BREATH where it is
            asked for, among them.
        breath: Whether there may be a breath in a pause.
    """
    units, last = _units(words, breath)
    length = [len(states[unit.label]) for unit in units]
    first = list(accumulate(length, initial=0))
    n = first[-1]
    follow = Counter(before for unit in units for before in unit.after) + Counter(last)
    inside = [(s, s + 1, 0.0) for a, b in pairwise(first) for s in range(a, b - 1)]
    between = [
        (first[v + 1] - 1, first[u], -np.log(follow[v]))
        for u, unit in enumerate(units)
        for v in unit.after
        if v != _EDGE
    ]
    begin = [first[u] for u, unit in enumerate(units) if _EDGE in unit.after]
    end = [first[u + 1] - 1 for u in last]
    log_start, log_end = np.full(n, IMPOSSIBLE), np.full(n, IMPOSSIBLE)
    log_start[begin] = -np.log(follow[_EDGE])
    log_end[end] = [-np.log(follow[u]) for u in last]
    moves = inside + between
    return Network(
        units=tuple(units),
        unit=np.repeat(np.arange(len(units)), length),
        state=np.concatenate([states[unit.label] for unit in units]),
        arrivals=_moves(((b, a, p) for a, b, p in moves), n),
        departures=_moves(moves, n),
        log_start=log_start,
        log_end=log_end,
    )


def _units(words: Sequence[Pronunciations], breath: bool) -> tuple[list[Unit], tuple[int, ...]]:
    """Return the units of `words` with pauses, and those that may be the last."""
    units: list[Unit] = []

    def append(label: str, word: int, after: tuple[int, ...]) -> tuple[int, ...]:
        units.append(Unit(label, word, after))
        return (len(units) - 1,)

    def pause(after: tuple[int, ...]) -> tuple[int, ...]:
        silence = append(SIL, PAUSE, after)
        if not breath:
            return after + silence
        breathed = append(BREATH, PAUSE, after + silence)
        return after + silence + breathed + append(SIL, PAUSE, breathed)

    ends = pause((_EDGE,))
    for i, pronunciations in enumerate(words):
        said: tuple[int, ...] = ()
        for labels in pronunciations:
            after = ends
            for label in labels:
                after = append(label, i, after)
            said += after
        ends = pause(said)
    return units, ends


def _moves(moves: Iterable[tuple[int, int, float]], n: int) -> Moves:
    """Return (a, b, log probability) as a table by a, of `n` states."""
    table: list[list[tuple[int, float]]] = [[] for _ in range(n)]
    for a, b, log_p in moves:
        table[a].append((b, log_p))
    width = max(1, *map(len, table))
    padded = np.array([row + [(n, 0.0)] * (width - len(row)) for row in table])
    return Moves(padded[..., 0].T.astype(np.int64), padded[..., 1].T.copy())
