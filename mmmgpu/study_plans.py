"""Which participant is shown which pairs of conditions, of which sentences, on which sides.

As in Englebienne, Cootes & Rattray (NIPS 2007, section 4) every condition is pitted against every
other one, equally often on either side, in random order, and the sentences are random. Here they
are also balanced: whatever has been planned least often is planned next, over all participants, so
that numbers of pairs that are no multiple of the ordered pairs are balanced too, to one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

Counts = NDArray[np.int64]


@dataclass(frozen=True)
class PlannedPair:
    """A sentence, and the conditions of the clips to the left and right; None: frozen."""

    sentence: str
    left: str | None
    right: str | None


def draw_plan(
    conditions: Sequence[str],
    sentences: Sequence[str],
    *,
    real: str,
    participants: int,
    pairs: int | None = None,
    checks: int,
    rng: np.random.Generator,
) -> list[list[PlannedPair]]:
    """The pairs of each participant, in the order in which they are shown.

    pairs: of different conditions, for each participant; by default every ordered pair once.
    checks: more pairs for each participant, of a `real` clip and a frozen one.
    Nobody is shown a sentence twice before all were shown once.
    """
    ordered: list[tuple[str | None, str | None]] = list(permutations(conditions, 2))
    frozen: list[tuple[str | None, str | None]] = [(None, real), (real, None)]
    wanted = len(ordered) if pairs is None else pairs
    used = [np.zeros(len(items), np.int64) for items in (ordered, frozen, sentences)]

    def take(what: int, number: int) -> Counts:
        chosen = least_used(used[what], number, rng)
        used[what] = used[what] + np.bincount(chosen, minlength=len(used[what]))
        return chosen

    plan = []
    for _ in range(participants):
        sides = [ordered[i] for i in take(0, wanted)] + [frozen[i] for i in take(1, checks)]
        said = rng.permutation(take(2, len(sides)))
        shown = [PlannedPair(sentences[i], *side) for i, side in zip(said, sides, strict=True)]
        plan.append([shown[i] for i in rng.permutation(len(shown))])
    return plan


def least_used(used: Counts, number: int, rng: np.random.Generator) -> Counts:
    """Indices (number,) into `used` of those least often used, ties at random.

    Each index comes once, or, where `number` is more than there are, as often as any other to one.
    """
    whole, rest = divmod(number, len(used))
    few = np.lexsort((rng.random(len(used)), used))[:rest]
    return np.concatenate([np.tile(np.arange(len(used)), whole), few]).astype(np.int64)
