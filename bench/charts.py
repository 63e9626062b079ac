"""Charts of how times grow, as SVG."""

import math
from pathlib import Path

from mmmgpu.errors import InputError


def draw_growth(growth, path):
    """One chart for each axis of `bench.growth.measure_growth`, side by side, in logarithms."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    if Path(path).suffix != ".svg":
        raise InputError(f"{path}: must be named .svg")
    with mpl.rc_context({"svg.hashsalt": "mmmgpu", "svg.fonttype": "none", "font.size": 8}):
        figure = Figure(figsize=(3 * len(growth), 2.8), layout="constrained")
        for axes, (axis, backends) in zip(
            figure.subplots(1, len(growth)), growth.items(), strict=True
        ):
            for name, found in backends.items():
                label = f"{name}: {found['exponent']:.2f}"
                axes.loglog(found["counts"], found["best_ms"], "o-", ms=3, label=label)
            axes.set(xlabel=axis, ylabel="best time [ms]", xticks=found["counts"])
            axes.set_xticks([], minor=True)
            axes.set_xticklabels([short(n) for n in found["counts"]])
            axes.legend(title="exponent", frameon=False)
        figure.savefig(path, metadata={"Date": None})


def short(number):
    """A count in few letters."""
    return f"{number / 1000:.3g}k" if math.log10(number) >= 3 else str(number)
