"""What the kernels are meant to reach, as ratios within one run, and whether they do.

Each is judged by the best backend. Of two contenders that took turns the ratio is the median of the
ratios within a turn: a machine that is busy for a while is busy for both.
"""

from dataclasses import dataclass

import numpy as np

from mmmgpu.bench.growth import LINEAR
from mmmgpu.bench.timing import COPY, REFERENCE

BACKENDS = ("warp", "opencl")


@dataclass(frozen=True)
class Target:
    """At least (or at most) `bound` of what `value` finds in the results; None: not measured.

    Without a bound it is shown, not judged.
    """

    name: str
    bound: float | None
    value: object
    most: bool = False


def rows_of(results, key, *families):
    """What is known of some contenders of a work; none where they were not measured."""
    rows = results["works"].get(key, {}).get("contenders", {})
    return [row for who, row in rows.items() if family(who) in families]


def family(contender):
    """The backend without its device."""
    return contender.partition(":")[0]


def ratio(over, under):
    """How many times as long `over` takes as `under`; of medians where one had a turn only."""
    pair = over["turns_ms"], under["turns_ms"]
    if len(pair[0]) != len(pair[1]):
        pair = over["median_ms"], under["median_ms"]
    return float(np.median(np.divide(*pair)))


def faster_than(key, peer):
    """How many times faster than a peer the best of ours is."""

    def value(results):
        theirs = rows_of(results, key, peer)
        ours = rows_of(results, key, *BACKENDS, "adjoint") if theirs else ()
        return max((min(ratio(their, our) for their in theirs) for our in ours), default=None)

    return value


def per_second(key):
    """Items a second of the best of ours."""

    def value(results):
        ours = [row["median_ms"] for row in rows_of(results, key, *BACKENDS)]
        return 1e3 * results["works"][key]["items"] / min(ours) if ours else None

    return value


def of_one_pass(key):
    """The time of the best of ours in those of a copy of as many bytes, in the same turns."""

    def value(results):
        copies = rows_of(results, key, COPY)
        ours = rows_of(results, key, *BACKENDS) if copies else ()
        return min((ratio(our, copies[0]) for our in ours), default=None)

    return value


def of_one_long_pass(key):
    """The time of the best of ours in those of its bytes at the bandwidth of a large copy."""

    def value(results):
        ours = rows_of(results, key, *BACKENDS)
        shares = [row["bandwidth"] for row in ours if "bandwidth" in row]
        return 1 / max(shares) if shares else None

    return value


def apart(results):
    """The largest ratio between the two backends over all works."""
    pairs = [[rows_of(results, key, name) for name in BACKENDS] for key in results["works"]]
    found = [ratio(a, b) for first, second in pairs for a in first for b in second]
    return max((max(r, 1 / r) for r in found), default=None)


def steepest(results):
    """The largest exponent of growth with what the time is to grow linearly."""
    grown = results.get("growth", {}).items()
    axes = [found for axis, found in grown if axis.startswith(LINEAR)]
    return max((found["exponent"] for axis in axes for found in axis.values()), default=None)


def gain(key):
    """What all threads gain over one, the backend that is fastest with all of them.

    Where none was timed, the one that gains most.
    """

    def value(results):
        gains = results.get("threads", {}).get("gain", {})
        found = [
            ([row["median_ms"] for row in rows_of(results, key, b)], -gains[f"{key}, {b}"][-1])
            for b in BACKENDS
            if f"{key}, {b}" in gains
        ]
        return -min(found)[1] if found else None

    return value


def gain_beside_copy(key):
    """What all threads gain over one, as a share of what a plain copy of as many bytes gains."""

    def value(results):
        gains = results.get("threads", {}).get("gain", {})
        ours, copy = gain(key)(results), gains.get(f"{key}, {COPY}")
        return ours / copy[-1] if ours and copy else None

    return value


def slowest_start(results):
    """Seconds to the first frame with a full cache, of the slower backend."""
    return max((s["full_cache_s"] for s in results.get("startup", {}).values()), default=None)


TARGETS = (
    Target("forward_warp over numba", 1.5, faster_than("splat", "numba")),
    Target("distance_scan over numba", 1.5, faster_than("scan", "numba")),
    Target("sample over OpenCV remap", 0.8, faster_than("sample", "opencv")),
    Target("blend, passes over its bytes", 1.3, of_one_pass("blend"), most=True),
    Target("blend 50x256x256x4, passes", 1.3, of_one_pass("blend_large"), most=True),
    Target("blend, passes of a large copy", None, of_one_long_pass("blend")),
    Target("blend 50x256x256x4, of a large copy", None, of_one_long_pass("blend_large")),
    Target("dense RBF over NumPy", 3, faster_than("rbf", "numpy peer")),
    Target("synthesis [frames/s]", 60, per_second("synthesis")),
    Target("synthesis over the reference", 20, faster_than("synthesis", REFERENCE)),
    Target("synthesis over OpenCV + NumPy", 3, faster_than("synthesis", "opencv + numpy")),
    Target("mouths [frames/s]", 100, per_second("mouths")),
    Target("analysis [frames/s]", 20, per_second("analysis")),
    Target("GDLR over Eq. 16", 50, faster_than("gdlr", REFERENCE)),
    Target("training over a solve a parameter", 50, faster_than("training", REFERENCE)),
    Target("backends apart by at most", 2, apart, most=True),
    Target("steepest growth, exponent", 1.1, steepest, most=True),
    Target("threads, forward_warp", 1.7, gain("splat")),
    Target("threads, fill_holes", 1.7, gain("fill")),
    Target("threads, normal_equations", 1.7, gain("equations")),
    Target("threads, sample", 1.7, gain("sample")),
    Target("threads, distance_scan", 1.7, gain("scan")),
    Target("threads, dense RBF", 1.7, gain("rbf")),
    Target("threads, piecewise_warp", 1.7, gain("piecewise")),
    Target("threads, synthesis", 1.7, gain("synthesis")),
    Target("threads, analysis", 1.7, gain("analysis")),
    Target("threads, blend, of a copy's gain", 0.9, gain_beside_copy("blend")),
    Target("first frame, full cache [s]", 1, slowest_start, most=True),
)


def judge_targets(results):
    """For every target that was measured: bound, value and whether it is met."""
    values = ((target, target.value(results)) for target in TARGETS)
    return {target.name: judged(target, value) for target, value in values if value is not None}


def judged(target, value):
    """What is known of a target with that value; of one without a bound the value alone."""
    found = {"bound": None, "value": round(value, 2), "met": None}
    if target.bound is None:
        return found
    met = value <= target.bound if target.most else value >= target.bound
    return found | {"bound": f"{'<=' if target.most else '>='} {target.bound:g}", "met": bool(met)}
