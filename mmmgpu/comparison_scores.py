"""How far generated sequences are from real ones: the numbers of ECR07's Figure 4, and three more.

With e_t = y_t - x_t, the difference between real and generated features of frame t (shape (d,)):

    l1              mean over t of sum_j |e_tj|
    rms             root of the mean over t of sum_j e_tj^2
    l_infinity      mean over t of max_j |e_tj|
    log_likelihood  log p(y | labels) / frames [nats a frame]; None where it is not comparable
    correlation     Pearson's, of each dimension, weighted by the variance of the real one
    variance_ratio  variance of x over that of y, all dimensions together: below 1 moves too little
    smoothness      RMS of the second differences of x over that of y: above 1 is more jerky

Source: Englebienne, Cootes & Rattray (NIPS 2007), section 4.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from mmmgpu.labelled import Floats
from mmmgpu.statistics import correlation, interval, paired_interval

Scores = dict[str, float | None]

METRICS = (
    "l1",
    "rms",
    "l_infinity",
    "log_likelihood",
    "correlation",
    "variance_ratio",
    "smoothness",
)

NOT_COMPARABLE = "not comparable"  # in place of a log-likelihood
WHY = "no distribution of the features; a likelihood would mean nothing beside the others'"


def not_comparable(models: Sequence[str]) -> dict[str, str]:
    """For each of the `models` without a log-likelihood, why it has none."""
    return dict.fromkeys(models, f"log_likelihood is {NOT_COMPARABLE}: {WHY}")


def legend(models: Iterable[str]) -> str:
    """What is to be said of the `models` without a log-likelihood, beside a table or figure."""
    names = ", ".join(models)
    return f"log-likelihood {NOT_COMPARABLE}: {names} ({WHY})" if names else ""


def score(made: Sequence[Floats], real: Sequence[Floats], log_likelihood: float | None) -> Scores:
    """The numbers above for sequences (T_s, d); of one without variance, None.

    log_likelihood: of all sequences together [nats], None where it is not comparable.
    """
    x, y = np.concatenate(made), np.concatenate(real)
    e = y - x
    spread = y.var(axis=0)
    bends = [np.concatenate([np.diff(one, 2, axis=0) for one in all_of]) for all_of in (made, real)]
    found = correlation(x, y)
    weight = np.where(np.isfinite(found), spread, 0)
    return {
        "l1": float(np.abs(e).sum(axis=1).mean()),
        "rms": float(np.sqrt((e**2).sum(axis=1).mean())),
        "l_infinity": float(np.abs(e).max(axis=1).mean()),
        "log_likelihood": None if log_likelihood is None else log_likelihood / len(y),
        "correlation": _ratio(float(np.nan_to_num(found) @ weight), float(weight.sum())),
        "variance_ratio": _ratio(float(x.var(axis=0).sum()), float(spread.sum())),
        "smoothness": _ratio(*(float(np.sqrt((b**2).sum())) for b in bends)),
    }


def _ratio(above: float, below: float) -> float | None:
    return above / below if below > 0 else None


def summarise(folds: Sequence[Mapping[str, Scores]]) -> dict[str, dict[str, Any]]:
    """By model and metric: the mean over folds with its 95 % interval; None where there is none."""
    return {
        model: {metric: _interval([fold[model][metric] for fold in folds]) for metric in METRICS}
        for model in folds[0]
    }


def _interval(values: Sequence[float | None]) -> dict[str, Any] | None:
    known = [v for v in values if v is not None]
    if not known:
        return None
    found = interval(known)
    half = None if np.isnan(found.half_width) else found.half_width
    return {"mean": found.mean, "half_width_95": half, "folds": found.n}


def paired_tests(folds: Sequence[Mapping[str, Scores]]) -> list[dict[str, Any]]:
    """Every two models in every metric that both have, fold by fold.

    Returns:
        For each pair the mean difference (first less second) with its 95 % interval, and the p
        values of the paired t test and of Wilcoxon's signed ranks; 1 where nothing differs. Folds
        share training data: the p values are somewhat too small (Nadeau & Bengio 2003).
    """
    from scipy.stats import ttest_rel, wilcoxon

    found = []
    for metric in METRICS:
        for first, second in combinations(folds[0], 2):
            pairs = [(fold[first][metric], fold[second][metric]) for fold in folds]
            known = [(a, b) for a, b in pairs if a is not None and b is not None]
            if len(known) < 2:
                continue
            a, b = np.array(known).T
            gap, differ = paired_interval(a, b), bool((a != b).any())
            found.append(
                {
                    "metric": metric,
                    "first": first,
                    "second": second,
                    "difference": {"mean": gap.mean, "half_width_95": gap.half_width},
                    "p_t": float(ttest_rel(a, b).pvalue)
                    if np.ptp(a - b) > 0
                    else float(not differ),
                    "p_wilcoxon": float(wilcoxon(a, b).pvalue) if differ else 1.0,
                }
            )
    return found
