"""What a comparison is told as: rows of a table, a CSV file, and ECR07's Figure 4."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mmmgpu.comparison_scores import METRICS, NOT_COMPARABLE
from mmmgpu.files import atomic_path, write_json, write_text

TITLES = {
    "l1": "(a) Mean L1 distance",
    "rms": "(b) RMS error",
    "l_infinity": "(c) Mean L-infinity distance",
    "log_likelihood": "(d) Log-likelihood [nats a frame]",
    "correlation": "(e) Correlation",
    "variance_ratio": "(f) Variance, generated/real",
    "smoothness": "(g) Second differences, generated/real",
}
SIZE = (11.0, 5.6)  # of the figure [inch]


def table_rows(results: Mapping[str, Any]) -> Iterator[list[str]]:
    """One row a model: its name, and mean +- half width of the 95 % interval of each metric."""
    for model, found in results["models"].items():
        notes = [_note(results, model, metric) for metric in METRICS]
        said = [note or _said(found[m]) for note, m in zip(notes, METRICS, strict=True)]
        yield [model, *said]


def _note(results: Mapping[str, Any], model: str, metric: str) -> str:
    """What stands in place of a value that a model cannot have."""
    is_missing = metric == "log_likelihood" and model in results["not_comparable"]
    return NOT_COMPARABLE if is_missing else ""


def _said(found: Mapping[str, Any] | None) -> str:
    if found is None:
        return "-"
    half = found["half_width_95"]
    return f"{found['mean']:.4g}" + ("" if half is None else f" +- {half:.2g}")


def pair_rows(results: Mapping[str, Any]) -> Iterator[list[str]]:
    """One row a pair of models and metric: the difference and its two p values."""
    for one in results["tests"]:
        yield [
            one["metric"],
            f"{one['first']} - {one['second']}",
            _said(one["difference"]),
            f"{one['p_t']:.2g}",
            f"{one['p_wilcoxon']:.2g}",
        ]


def write_comparison(results: Mapping[str, Any], folder: Path) -> list[Path]:
    """Write ``compare.json``, ``compare.csv``, ``figure4.svg`` and ``figure4.png``.

    The CSV has one row for each model, metric and fold, and one for the mean; a note says where a
    value is missing because it would not be comparable.
    """
    names = ("compare.json", "compare.csv", "figure4.svg", "figure4.png")
    paths = [folder / name for name in names]
    write_json(paths[0], results)
    write_text(paths[1], _csv(results))
    for path in paths[2:]:
        _draw(results, path)
    return paths


def _csv(results: Mapping[str, Any]) -> str:
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    out.writerow(["model", "metric", "fold", "value", "half_width_95", "note"])
    for model, found in results["models"].items():
        for metric in METRICS:
            note = _note(results, model, metric)
            for number, fold in enumerate(results["folds"], start=1):
                out.writerow([model, metric, number, fold[model][metric], None, note])
            mean = found[metric] or {"mean": None, "half_width_95": None}
            out.writerow([model, metric, "mean", mean["mean"], mean["half_width_95"], note])
    return text.getvalue()


def _draw(results: Mapping[str, Any], path: Path) -> None:
    """Means over folds as points, 95 % intervals as whiskers, a panel a metric."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"svg.hashsalt": "mmmgpu", "svg.fonttype": "none", "font.size": 9}):
        figure = Figure(figsize=SIZE, layout="constrained")
        panels = figure.subplots(2, 4).ravel()
        for axes, metric in zip(panels, METRICS, strict=False):
            bars = {m: f[metric] for m, f in results["models"].items() if f[metric] is not None}
            means = [found["mean"] for found in bars.values()]
            halves = [found["half_width_95"] or 0.0 for found in bars.values()]
            axes.errorbar(range(len(bars)), means, halves, fmt="o", capsize=4, color="#1d7fd6")
            axes.set_xticks(range(len(bars)), list(bars))
            axes.set_title(TITLES[metric], fontsize=9)
            axes.margins(x=0.15)
            left_out = [m for m in results["models"] if _note(results, m, metric)]
            if left_out:
                axes.set_xlabel(f"{NOT_COMPARABLE}: {', '.join(left_out)}", fontsize=8)
        for axes in panels[len(METRICS) :]:
            axes.set_axis_off()
        with atomic_path(path) as temporary:
            figure.savefig(temporary, metadata={"Date": None} if path.suffix == ".svg" else None)
