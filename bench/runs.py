"""A whole run of the benchmarks: which parts there are, and the record that is kept of one."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from mmmgpu.backends import default_threads, get_backend
from mmmgpu.bench.endurance import measure_endurance
from mmmgpu.bench.growth import measure_growth
from mmmgpu.bench.kernels import kernel_works
from mmmgpu.bench.machine import describe_machine, measure_machine
from mmmgpu.bench.models import model_works
from mmmgpu.bench.peers import LIBRARIES, split_by_presence, use_threads
from mmmgpu.bench.pictures import picture_works
from mmmgpu.bench.pipeline import measure_pipeline
from mmmgpu.bench.startup import measure_startup
from mmmgpu.bench.targets import judge_targets
from mmmgpu.bench.threads import measure_threads
from mmmgpu.bench.timing import COPY, QUICK, Effort, measure
from mmmgpu.errors import InputError
from mmmgpu.progress import progress
from mmmgpu.voices import is_installed

# of the record; 5: one peak for all precisions, some peers packed arrays beforehand, starts by the
# best; 4: growth and threads of fewer works; 3: single turns were not kept, references did not
# take turns, growth by the best; 2: no pause for OpenBLAS's threads; 1: short runs once
VERSION = 6
PARTS = ("kernels", "wholes", "growth", "startup", "pipeline")


@dataclass(frozen=True)
class Plan:
    """What to measure.

    backends: names for `get_backend`.
    parts: of `PARTS`; none: all.
    only: keys of works to keep; none: all.
    peers: whether other libraries are measured too.
    quick: few turns.
    endurance: frames to synthesise while memory is watched; 0: none.
    """

    backends: Sequence[str] = ("warp", "opencl")
    parts: Sequence[str] = ()
    only: Sequence[str] = ()
    peers: bool = False
    quick: bool = False
    endurance: int = 0


def run_benchmarks(plan):
    """Everything that `plan` asks for, as JSON values.

    All libraries use the threads that ours do.

    Raises:
        InputError: A part, work or backend does not exist; an answer differs from the reference.
    """
    parts = chosen(plan.parts, PARTS, "part")
    for name in plan.backends:
        get_backend(name)
    present, absent = split_by_presence(LIBRARIES if plan.peers else ())
    use_threads(default_threads(), present)
    works = works_of(parts, plan, present)
    effort = QUICK if plan.quick else Effort()
    before = measure_machine()
    results = {
        "version": VERSION,
        "plan": asdict(plan),
        "absent": absent,
        "works": {
            key: {"name": (work := make()).name} | measure(work, effort)
            for key, make in progress(works.items(), "bench", total=len(works))
        },
    }
    if "growth" in parts:
        results["growth"] = measure_growth(plan.backends, effort.turns)
        results["threads"] = measure_threads(plan.backends, turns=min(effort.turns, 9))
    if "startup" in parts:
        results["startup"] = measure_startup(plan.backends)
    if "pipeline" in parts and is_installed():
        results["pipeline"] = measure_pipeline(plan.backends[0])
    elif "pipeline" in parts:
        absent.append("a voice for the pipeline (mmmgpu[tts])")
    if plan.endurance:
        results["endurance"] = measure_endurance(plan.backends, plan.endurance)
    after = measure_machine()
    results["machine"] = describe_machine() | {k: max(before[k], after[k]) for k in before}
    add_shares(results)
    results["targets"] = judge_targets(results)
    return results


def chosen(asked, known, what):
    """Those of `known` that are asked for; all, if none is.

    Raises:
        InputError: One is not known.
    """
    strange = [name for name in asked if name not in known]
    if strange:
        raise InputError(f"no {what} {strange[0]!r}; there are {', '.join(known)}")
    return [name for name in known if not asked or name in asked]


def works_of(parts, plan, peers):
    """Makers of the works of those parts, by key."""
    works = {}
    if "kernels" in parts:
        works |= kernel_works(plan.backends, peers)
    if "wholes" in parts:
        works |= picture_works(plan.backends, peers) | model_works(plan.backends, peers)
    return {key: works[key] for key in chosen(plan.only, works, "work")}


def add_shares(results):
    """Say of every row which shares of the copy bandwidth and the arithmetic peak it uses.

    Both are the processor's: rows of other devices have none. A copy does no arithmetic.
    """
    machine, backends = results["machine"], results["plan"]["backends"]
    elsewhere = [name for name in backends if not get_backend(name).on_host]
    for work in results["works"].values():
        ends = {
            "bandwidth": (work["bytes"], machine["copy_gb_per_s"]),
            "arithmetic": (work["operations"], machine[f"{work['precision']}_gflops"]),
        }
        for share, (size, most) in ends.items():
            without = [*elsewhere, COPY] if share == "arithmetic" else elsewhere
            for who in work["contenders"].keys() - without if size else ():
                row = work["contenders"][who]
                row[share] = float(f"{size / row['median_ms'] / most / 1e6:.3g}")
