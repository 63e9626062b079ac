"""``mmmgpu adapt``: a transferred model -> one in the style of the new person."""

from pathlib import Path
from typing import Annotated

import typer

from mmmgpu.commands.options import (
    Alignments,
    Backend,
    Clips,
    Json,
    LibraryDefault,
    ModelFile,
    ModelOut,
    Report,
    Sync,
)
from mmmgpu.commands.places import require_output, videos_in, write_results

EXAMPLE = "Example: mmmgpu adapt bob.mmm bob/*.mp4 --alignments bob --out bob-adapted.mmm"
_OPTIONS = ("mmmgpu.adaptation", "AdaptOptions")


def adapt(
    model: ModelFile,
    clips: Clips,
    *,
    alignments: Alignments,
    out: ModelOut,
    method: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="How the phoneme means are adapted: none, shift, map, mllr or gdlr. All are "
            "computed and compared by evaluate; this one speaks.",
            default_factory=LibraryDefault(*_OPTIONS, "method"),
        ),
    ],
    classes: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Phones that move together: broad for silence, vowels and consonants, kmeans, or "
            "paper for the nine of the paper.",
            default_factory=LibraryDefault(*_OPTIONS, "classes"),
        ),
    ],
    covariance: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Covariances in the new prototypes' coordinates: diagonal or full.",
            default_factory=LibraryDefault(*_OPTIONS, "covariance"),
        ),
    ],
    step: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Step of gdlr: bounded by the curvature of each class, or the paper's constant.",
            default_factory=LibraryDefault(*_OPTIONS, "step"),
        ),
    ],
    sync: Sync,
    seed: Annotated[
        int,
        typer.Option(
            help="Start of the random numbers; the same seed gives the same model.",
            default_factory=LibraryDefault(*_OPTIONS, "seed"),
        ),
    ],
    backend: Backend,
    source: Annotated[
        Path | None,
        typer.Option(
            "--source", metavar="MODEL", help="The first person's model, for the report's pictures."
        ),
    ] = None,
    report: Report = None,
    json: Json = None,
) -> None:
    """Adapt a transferred MODEL to how the person in CLIPs speaks.

    New mouth pictures are chosen from CLIPs, and the phoneme models are moved to what the mouth
    does there. Phones that CLIPs do not hold move with those of their class. An interrupted job
    continues when it is called again.
    """
    from mmmgpu.adaptation import AdaptOptions
    from mmmgpu.adaptation import adapt as take_style
    from mmmgpu.backends import get_backend
    from mmmgpu.commands.summaries import flat, model_facts, show_model, show_table
    from mmmgpu.model_files import load
    from mmmgpu.transfer_reports import write_transfer_report

    get_backend(backend)
    found = videos_in(clips)
    given = [model, source, *found]
    require_output(out, given)
    require_output(json, given)
    require_output(report, [*given, out])
    options = AdaptOptions(
        method=method, classes=classes, covariance=covariance, step=step, sync=sync, seed=seed
    )
    before = load(model)
    adapted = take_style(before, found, alignments, out, options=options, backend=backend)
    show_model(adapted, out)
    coverage = adapted.notes["adaptation"]["coverage"]
    shown = {name: value for name, value in coverage.items() if name != "frames"}
    show_table("what the clips hold", flat(shown))
    write_results(model_facts(adapted, out), json)
    if report is not None:
        first = None if source is None else load(source)
        write_transfer_report(report, source=first, before=before, after=adapted, backend=backend)
