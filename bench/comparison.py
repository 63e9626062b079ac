"""What became slower between two runs, beyond noise.

The machine's own drift is the median change of the other libraries and of the reference, whose code
is the same; ours are judged against it. A change is beyond noise where the quartiles of the two
runs do not overlap once the drift is taken out, and it is more than `LEAST`.

Of growth, gains of threads, starts and the pipeline each run has one value: no noise is known, nor
is drift taken out. There only a change of more than `PLAIN` is called one.
"""

import numpy as np

from mmmgpu.bench.timing import REFERENCE
from mmmgpu.errors import InputError

LEAST = 1.05  # times slower
PLAIN = 1.25  # the same, where noise is not known
OURS = ("warp", "opencl", "ours", "adjoint")


def compare_runs(old, new):
    """Changes of all that both runs hold: JSON values.

    Raises:
        InputError: The runs have nothing in common.
    """
    pairs, before, after = common(old, new), values_of(old), values_of(new)
    others = [plain_row(*what, before[what], after[what]) for what in after if what in before]
    if not pairs and not others:
        raise InputError("the two runs have nothing in common; run the same parts and backends")
    same_code = [change(*pair) for (_, who), pair in pairs.items() if not is_ours(who)]
    drift = float(np.median(same_code)) if same_code else 1.0
    rows = [row(key, who, *pair, drift) for (key, who), pair in pairs.items() if is_ours(who)]
    same = all(old["machine"][k] == new["machine"][k] for k in ("cpu", "threads"))
    return {
        "old": old["machine"]["commit"],
        "new": new["machine"]["commit"],
        "same_machine": same,
        "drift": round(drift, 3),
        "drift_from": len(same_code),
        "rows": rows,
        "others": others,
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


def values_of(run):
    """{(what, by): value} of all but works: exponents, gains of all threads, and seconds."""
    grown = {
        (f"growth: {axis}", who): found["exponent"]
        for axis, backends in run.get("growth", {}).items()
        for who, found in backends.items()
    }
    gained = {
        ("gain of threads", who): gains[-1]
        for who, gains in run.get("threads", {}).get("gain", {}).items()
    }
    started = {
        (f"first frame: {what}", who): found[what]
        for who, found in run.get("startup", {}).items()
        for what in ("empty_cache_s", "full_cache_s")
    }
    steps = run.get("pipeline", {}).get("steps", {})
    return grown | gained | started | {("pipeline [s]", s): steps[s]["seconds"] for s in steps}


def plain_row(what, who, old, new):
    """How one value changed; of an exponent what ten times as much of its axis takes."""
    times = new / old
    if what.startswith("growth"):
        times = 10 ** (new - old)
    if what.startswith("gain"):
        times = old / new
    verdict = "slower" if times > PLAIN else "faster" if times < 1 / PLAIN else "-"
    return {
        "what": what,
        "by": who,
        "old": old,
        "new": new,
        "times": round(times, 3),
        "verdict": verdict,
    }
