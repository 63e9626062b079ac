"""Charts of how times grow, as SVG."""

import math
from pathlib import Path

from mmmgpu.errors import InputError

ACROSS = 5  # charts of a row


def draw_growth(growth, threads, path):
    """In logarithms: one chart for each axis of growth, and one of threads.

    Args:
        growth, threads: As of `bench.growth.measure_growth` and `bench.threads.measure_threads`.
        path: An .svg.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    if Path(path).suffix != ".svg":
        raise InputError(f"{path}: must be named .svg")
    with mpl.rc_context({"svg.hashsalt": "mmmgpu", "svg.fonttype": "none", "font.size": 8}):
        rows = math.ceil((len(growth) + 1) / ACROSS)
        figure = Figure(figsize=(3 * ACROSS + 4, 2.8 * rows), layout="constrained")
        charts = figure.subplots(rows, ACROSS).ravel()
        last = charts[len(growth)]
        for axes in charts[len(growth) + 1 :]:
            axes.remove()
        for axes, (axis, backends) in zip(charts, growth.items(), strict=False):
            for name, found in backends.items():
                label = f"{name}: {found['exponent']:.2f}"
                axes.loglog(found["counts"], found["median_ms"], "o-", ms=3, label=label)
            axes.set(xlabel=axis, ylabel="median time [ms]")
            tick(axes.xaxis, found["counts"])
            axes.legend(title="exponent", frameon=False)
        draw_threads(last, threads)
        figure.savefig(path, metadata={"Date": None})


def draw_threads(axes, threads):
    """How many times faster than one thread, beside what is ideal."""
    counts = threads["counts"]
    axes.loglog(counts, counts, "k:", lw=1)
    for work, gain in threads["gain"].items():
        axes.loglog(counts, gain, "o-", ms=3, label=f"{work}: {gain[-1]:.2f}")
    axes.set(xlabel="threads", ylabel="times faster than one")
    tick(axes.xaxis, counts)
    tick(axes.yaxis, counts)
    beside = {"loc": "center left", "bbox_to_anchor": (1, 0.5), "ncols": 2, "fontsize": 7}
    axes.legend(title="gain", frameon=False, **beside)


def tick(axis, counts):
    """Label an axis with these and nothing else."""
    axis.set_ticks(counts, labels=[short(n) for n in counts])
    axis.set_ticks([], minor=True)


def short(number):
    """A count in few letters."""
    for size, letter in ((10**6, "M"), (10**3, "k")):
        if number >= size:
            return f"{number / size:.3g}{letter}"
    return str(number)
