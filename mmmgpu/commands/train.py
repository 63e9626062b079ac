"""``mmmgpu train``: clips and their alignments -> a model."""

from typing import Annotated

import typer

from mmmgpu.commands.options import (
    Alignments,
    Backend,
    Clips,
    Json,
    LibraryDefault,
    ModelOut,
    RegionBox,
    Report,
    Sync,
    parse_box,
)
from mmmgpu.commands.places import require_output, videos_in, write_results

EXAMPLE = "Example: mmmgpu train clips/*.mp4 --alignments alignments --out ann.mmm"
_OPTIONS = ("mmmgpu.training", "Options")


def train(
    clips: Clips,
    *,
    alignments: Alignments,
    out: ModelOut,
    prototypes: Annotated[
        int,
        typer.Option(
            min=2,
            help="How many mouth pictures the model keeps.",
            default_factory=LibraryDefault(*_OPTIONS, "prototypes"),
        ),
    ],
    region: RegionBox = None,
    sync: Sync,
    flow: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Optical flow method.",
            default_factory=LibraryDefault(*_OPTIONS, "flow"),
        ),
    ],
    seed: Annotated[
        int,
        typer.Option(
            help="Start of the random numbers; the same seed gives the same model.",
            default_factory=LibraryDefault(*_OPTIONS, "seed"),
        ),
    ],
    backend: Backend,
    report: Report = None,
    json: Json = None,
) -> None:
    """Learn a person from CLIPs and write a model.

    The clips show one person talking, from the front, with sound; a few minutes are best. Mouth and
    head are found in the video itself. An interrupted job continues from the last finished clip
    when it is called again; until then its steps lie in the folder MODEL.work.
    """
    from mmmgpu.backends import get_backend
    from mmmgpu.commands.summaries import model_facts, show_model
    from mmmgpu.flows import MATCHERS
    from mmmgpu.reports import write_report
    from mmmgpu.training import Options
    from mmmgpu.training import train as learn

    if flow not in MATCHERS:
        raise typer.BadParameter(f"choose one of {', '.join(MATCHERS)}", param_hint="--flow")
    get_backend(backend)

    options = Options(
        prototypes=prototypes,
        region=None if region is None else parse_box(region),
        sync=sync,
        flow=flow,
        seed=seed,
    )
    found = videos_in(clips)
    require_output(out, found)
    require_output(json, found)
    require_output(report, [*found, out])
    model = learn(found, alignments, out, options=options, backend=backend)
    show_model(model, out)
    write_results(model_facts(model, out), json)
    if report is not None:
        write_report(model, report, backend=backend)
