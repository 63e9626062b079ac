"""``mmmgpu evaluate``: synthesis from phones against real clips."""

from typing import Annotated

import typer

from mmmgpu.commands.options import (
    Alignments,
    Backend,
    Clips,
    Json,
    Landmarks,
    ModelFile,
    Report,
    Sync,
)
from mmmgpu.commands.places import require_output, videos_in, write_results
from mmmgpu.commands.summaries import flat, show_table

EXAMPLE = "Example: mmmgpu evaluate ann.mmm held-out/ --alignments alignments --json errors.json"


def evaluate(
    model: ModelFile,
    clips: Clips,
    *,
    alignments: Alignments,
    landmarks: Landmarks = None,
    sync: Sync,
    pictures: Annotated[
        bool,
        typer.Option("--pictures", help="Also render every frame and compare it."),
    ] = False,
    backend: Backend,
    report: Report = None,
    json: Json = None,
) -> None:
    """Compare synthesis from phones with real CLIPs.

    Use clips that the model was not trained on. Errors are in model coordinates (alpha: movement,
    beta: texture), with the phoneme models before (pooled) and after training, over all frames and
    over speech; intervals are 95 % over clips. With --landmarks also the lips, in pixels.
    """
    found = videos_in(clips)
    require_output(json, [model, *found])
    require_output(report, [model, *found])
    from mmmgpu.backends import get_backend
    from mmmgpu.evaluation import evaluate as judge
    from mmmgpu.model_files import load
    from mmmgpu.reports import write_report

    get_backend(backend)
    person = load(model)
    results = judge(
        person,
        found,
        alignments,
        sync=sync,
        landmarks=landmarks,
        pictures=pictures,
        backend=backend,
    )
    show_table(f"{model} on {len(found)} clips", flat(results))
    write_results(results, json)
    if report is not None:
        write_report(person, report, evaluation=results, backend=backend)
