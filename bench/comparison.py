"""What became slower between two runs, beyond noise.

The machine's own drift is the median change of the other libraries and of the reference, whose code
is the same; ours are judged against it. A change is beyond noise where the quartiles of the two
runs do not overlap once the drift is taken out, and it is more than `LEAST`.
"""

import numpy as np

from mmmgpu.bench.timing import REFERENCE
from mmmgpu.errors import InputError

LEAST = 1.05  # times slower
OURS = ("warp", "opencl", "ours", "adjoint")


def compare_runs(old, new):
    """Changes of all that both runs hold: JSON values.

    Raises:
        InputError: The runs have nothing in common.
    """
    pairs = common(old, new)
    if not pairs:
        raise InputError("the two runs have no work in common; run the same parts and backends")
    others = [change(*pair) for (_, who), pair in pairs.items() if not is_ours(who)]
    drift = float(np.median(others)) if others else 1.0
    rows = [row(key, who, *pair, drift) for (key, who), pair in pairs.items() if is_ours(who)]
    same = all(old["machine"][k] == new["machine"][k] for k in ("cpu", "threads"))
    return {
        "old": old["machine"]["commit"],
        "new": new["machine"]["commit"],
        "same_machine": same,
        "drift": round(drift, 3),
        "drift_from": len(others),
        "rows": rows,
    }


def common(old, new):
    """{(work, contender): (old row, new row)}."""
    return {
        (key, who): (old["works"][key]["contenders"][who], found)
        for key, work in new["works"].items()
        if key in old["works"] and old["works"][key]["name"] == work["name"]
        for who, found in work["contenders"].items()
        if who in old["works"][key]["contenders"]
    }


def is_ours(who):
    """Whether a contender is a part of mmmgpu that may have changed."""
    return who != REFERENCE and who.partition(":")[0] in OURS


def change(old, new):
    """Times slower."""
    return new["median_ms"] / old["median_ms"]


def row(work, who, old, new, drift):
    """How one contender changed: "slower", "faster", or "-" for within noise."""
    times = change(old, new) / drift
    low, high = (ms / drift for ms in new["quartiles_ms"])
    verdict = "-"
    if times > LEAST and low > old["quartiles_ms"][1]:
        verdict = "slower"
    if times < 1 / LEAST and high < old["quartiles_ms"][0]:
        verdict = "faster"
    return {
        "work": work,
        "by": who,
        "old_ms": old["median_ms"],
        "new_ms": new["median_ms"],
        "times": round(times, 3),
        "verdict": verdict,
    }
