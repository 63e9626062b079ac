"""``mmmgpu aam``: clips with landmarks -> an active appearance model."""

from pathlib import Path
from typing import Annotated

import typer

from mmmgpu.commands.options import Backend, Clips, Json, LibraryDefault, Report
from mmmgpu.commands.places import require_output, videos_in, write_results

EXAMPLE = "Example: mmmgpu aam clips/*.mp4 --landmarks clips --out ann.aam"
_FIT = ("mmmgpu.aam_training", "fit_aam")


def aam(
    clips: Clips,
    *,
    landmarks: Annotated[
        Path,
        typer.Option(
            "--landmarks",
            metavar="DIR",
            help="Folder with NAME.npz of tracked points, or NAME.json of points set by hand, for "
            "every clip NAME.*.",
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", metavar="AAM", help="Model to write, by custom NAME.aam.")
    ],
    parameters: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="How many features a frame has: 32, unless --variance is given."
        ),
    ] = None,
    variance: Annotated[
        float | None,
        typer.Option(
            "--variance",
            metavar="SHARE",
            help="In place of --parameters: as many features as have this share of the variance, "
            "as in 0.95.",
        ),
    ] = None,
    frames: Annotated[
        int,
        typer.Option(
            metavar="N",
            help="How many frames, spread over the clips, are learned from at most.",
            default_factory=LibraryDefault(*_FIT, "frames"),
        ),
    ],
    all_points: Annotated[
        bool,
        typer.Option(
            "--all-points", help="Use all landmarks, whatever they are, not the 38 built in."
        ),
    ] = False,
    test: Annotated[
        list[Path] | None,
        typer.Option(
            "--test", metavar="CLIP", help="A clip to judge the model by; may be given again."
        ),
    ] = None,
    backend: Backend,
    report: Report = None,
    json: Json = None,
) -> None:
    """Learn how a face varies from CLIPs with landmarks.

    The model turns a frame into a few features and features into a picture (Cootes et al. 2001).
    Clips given with --test are not learned from, also where they are among CLIPs: how well the
    model shows and finds their faces is measured.
    """
    from mmmgpu.aam_evaluation import evaluate_aam
    from mmmgpu.aam_files import save_aam
    from mmmgpu.aam_reports import write_aam_report
    from mmmgpu.aam_training import fit_aam
    from mmmgpu.backends import get_backend
    from mmmgpu.commands.summaries import aam_facts, flat, show_aam, show_table
    from mmmgpu.labelled_clips import ROWS, read_labelled_clips

    get_backend(backend)
    judges = videos_in(test or [])
    resolved = {clip.resolve() for clip in judges}
    found = [clip for clip in videos_in(clips) if clip.resolve() not in resolved]
    given = [*found, *judges]
    require_output(out, given)
    require_output(json, [*given, out])
    require_output(report, [*given, out])
    rows = None if all_points else ROWS
    if judges:  # before the long work: can they be used?
        read_labelled_clips(judges, landmarks, rows)
    model = fit_aam(
        found,
        landmarks,
        parameters=parameters,
        variance=variance,
        rows=rows,
        frames=frames,
        backend=backend,
    )
    save_aam(model, out)
    show_aam(model, out)
    results = aam_facts(model, out)
    if judges:
        judged = evaluate_aam(model, judges, landmarks, backend=backend)
        show_table(f"{out} on {len(judges)} clips", flat(judged))
        results["test"] = judged
    write_results(results, json)
    if report is not None:
        shown = (judges or found)[0]
        write_aam_report(
            model,
            report,
            clip=shown,
            landmarks=landmarks,
            test=results.get("test"),
            backend=backend,
        )
