"""``mmmgpu transfer``: a model of one person -> a model with the face of another."""

from pathlib import Path
from typing import Annotated

import typer

from mmmgpu.commands.options import (
    Alignments,
    Backend,
    Clips,
    Json,
    LibraryDefault,
    ModelOut,
    Report,
    Sync,
)
from mmmgpu.commands.places import require_output, videos_in, write_results

EXAMPLE = (
    "Example: mmmgpu transfer ann.mmm bob/*.mp4 --alignments bob --points both.json --out bob.mmm"
)
_OPTIONS = ("mmmgpu.transferring", "TransferOptions")


def transfer(
    source: Annotated[
        Path,
        typer.Argument(metavar="SOURCE", help="Model of the first person, written by train."),
    ],
    clips: Clips,
    *,
    alignments: Alignments,
    points: Annotated[
        Path,
        typer.Option(
            "--points",
            metavar="POINTS",
            help="Corresponding points of the two faces, written by: mmmgpu mark.",
        ),
    ],
    out: ModelOut,
    balance: Annotated[
        float,
        typer.Option(
            min=0,
            max=1,
            help="What prototypes are matched by: 1 flow alone, 0 texture alone.",
            default_factory=LibraryDefault(*_OPTIONS, "balance"),
        ),
    ],
    sync: Sync,
    flow: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Optical flow method.",
            default_factory=LibraryDefault(*_OPTIONS, "flow"),
        ),
    ],
    backend: Backend,
    report: Report = None,
    json: Json = None,
) -> None:
    """Give the model SOURCE the face of the second person in CLIPs.

    About 15 seconds of the second person are enough. For every mouth picture of SOURCE a frame of
    CLIPs that shows the same is found; the result speaks with the second face in the style of the
    first person, until it is adapted. An interrupted job continues when it is called again.
    """
    from mmmgpu.backends import get_backend
    from mmmgpu.commands.summaries import model_facts, show_model
    from mmmgpu.flows import MATCHERS
    from mmmgpu.model_files import load
    from mmmgpu.transfer_reports import points_in_clips, write_transfer_report
    from mmmgpu.transferring import TransferOptions
    from mmmgpu.transferring import transfer as give_face

    if flow not in MATCHERS:
        raise typer.BadParameter(f"choose one of {', '.join(MATCHERS)}", param_hint="--flow")
    get_backend(backend)
    found = videos_in(clips)
    given = [source, points, *found]
    require_output(out, given)
    require_output(json, given)
    require_output(report, [*given, out])
    first = load(source)
    options = TransferOptions(balance=balance, sync=sync, flow=flow)
    model = give_face(first, found, alignments, points, out, options=options, backend=backend)
    show_model(model, out)
    write_results(model_facts(model, out), json)
    if report is not None:
        marked = points_in_clips(points, found)
        write_transfer_report(report, source=first, before=model, points=marked, backend=backend)
