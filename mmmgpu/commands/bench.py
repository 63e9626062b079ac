"""``mmmgpu bench``: how fast this machine does the work, and what has become slower."""

import json as json_
from pathlib import Path
from typing import Annotated, Any

import typer

from mmmgpu.commands.endings import guarded
from mmmgpu.commands.options import Json, LibraryDefault
from mmmgpu.commands.places import require_output, write_results
from mmmgpu.commands.summaries import show_table
from mmmgpu.errors import InputError

HELP = "Measure the kernels and all that is made of them."
EXAMPLE = "Examples: mmmgpu bench --peers --json new.json; mmmgpu bench compare old.json new.json"
_PLAN = ("mmmgpu.bench.runs", "Plan")


def bench(
    context: typer.Context,
    *,
    peers: Annotated[
        bool, typer.Option("--peers", help="Measure other libraries in the same run, too.")
    ] = False,
    quick: Annotated[bool, typer.Option("--quick", help="A few turns only.")] = False,
    backend: Annotated[
        list[str],
        typer.Option(
            "--backend",
            metavar="NAME",
            help="What to measure, as in opencl:0:0; may be repeated.",
            default_factory=LibraryDefault(*_PLAN, "backends"),
        ),
    ],
    part: Annotated[
        list[str] | None,
        typer.Option(
            "--part",
            metavar="NAME",
            help="kernels, wholes, growth, startup or pipeline; may be repeated. Default: all.",
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            "--only", metavar="NAME", help="One work of kernels and wholes; may be repeated."
        ),
    ] = None,
    endurance: Annotated[
        int,
        typer.Option(
            "--endurance", metavar="FRAMES", min=0, help="Synthesise so many; watch the memory."
        ),
    ] = 0,
    plot: Annotated[
        Path | None,
        typer.Option("--plot", metavar="FILE", help="Charts of growth and threads, as SVG."),
    ] = None,
    json: Json = None,
) -> None:
    """Measure the kernels and all that is made of them.

    Every answer is compared with the NumPy reference first. All contenders of one work take turns.
    The table has medians, and the share of this machine's copy bandwidth and arithmetic peak.
    """
    if context.invoked_subcommand is not None:
        return
    require_output(json)
    require_output(plot)
    from mmmgpu.bench.charts import draw_growth
    from mmmgpu.bench.runs import Plan, run_benchmarks

    plan = Plan(tuple(backend), tuple(part or ()), tuple(only or ()), peers, quick, endurance)
    results = run_benchmarks(plan)
    show_results(results)
    if plot is not None:
        if "growth" not in results:
            raise InputError("--plot needs --part growth")
        draw_growth(results["growth"], results["threads"], plot)
    write_results(results, json)


def show_results(results: dict[str, Any]) -> None:
    """Print all tables of a run."""
    from mmmgpu.bench.tables import WORKS, other_tables, work_tables

    machine = results["machine"]
    title = (
        f"{machine['cpu']}, {machine['threads']} threads, {machine['copy_gb_per_s']} GB/s copied, "
        f"{machine['float32_gflops']} GFlop/s ({machine['float64_gflops']} in float64), "
        f"load {machine['load']}"
    )
    print(title, f"\n{WORKS}" * bool(results["works"]))
    for name, rows in work_tables(results):
        print(f"\n{name}", *rows, sep="\n")
    for name, header, rows in other_tables(results):
        show_table(name, rows, header)
    if results["absent"]:
        print(f"Not installed, so not measured: {', '.join(results['absent'])}")


def compare(
    old: Annotated[Path, typer.Argument(metavar="OLD", help="What bench --json has written.")],
    new: Annotated[Path, typer.Argument(metavar="NEW", help="The same, later.")],
    *,
    json: Json = None,
) -> None:
    """Show what became slower, or faster, beyond noise.

    How much the machine itself has changed is judged by other libraries and the reference, whose
    code is the same: give --peers to both runs. Growth, threads, starts and the pipeline have one
    value each, and are compared plainly.
    """
    require_output(json, [old, new])
    from mmmgpu.bench.comparison import PLAIN, compare_runs
    from mmmgpu.bench.tables import compared_others, compared_rows

    found = compare_runs(_read(old), _read(new))
    header = ("work", "by", "old [ms]", "new [ms]", "times, drift taken out", "verdict")
    said = f"drift of the machine {found['drift']:g}, from {found['drift_from']} others"
    if not found["same_machine"]:
        said += "; NOT the same processor and threads"
    show_table(f"{found['old']} to {found['new']}; {said}", compared_rows(found), header)
    header = ("what", "by", "old", "new", "times slower", "verdict")
    said = f"One value each, no noise known: a change is more than {PLAIN:g} times"
    if found["others"]:
        show_table(said, compared_others(found), header)
    write_results(found, json)


def _read(path: Path) -> Any:
    """The record of a run.

    Raises:
        InputError: It is none, or of another version.
    """
    from mmmgpu.bench.runs import VERSION
    from mmmgpu.files import read_text

    try:
        results = json_.loads(read_text(path))
        version = results["version"]
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{path}: is no file of mmmgpu bench --json") from None
    if version != VERSION:
        raise InputError(f"{path}: has version {version}, not {VERSION}; measure again")
    return results


app = typer.Typer(help=HELP, no_args_is_help=False, epilog=EXAMPLE)
app.callback(invoke_without_command=True)(guarded(bench))
app.command(epilog=EXAMPLE)(guarded(compare))
