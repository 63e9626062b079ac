"""``mmmgpu track``: an appearance model and clips without landmarks -> their landmarks."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mmmgpu.commands.options import Backend, Clips, Json, parse_box
from mmmgpu.commands.places import require_output, videos_in, write_results
from mmmgpu.errors import InputError

if TYPE_CHECKING:
    from mmmgpu.aam_tracking import Tracked

EXAMPLE = "Example: mmmgpu track ann.aam new/*.mp4 --start 120,150,110,90 --out points"


def track(
    model: Annotated[
        Path, typer.Argument(metavar="AAM", help="A model file, written by: mmmgpu aam.")
    ],
    clips: Clips,
    *,
    start: Annotated[
        str,
        typer.Option(
            metavar="X,Y,W,H|DIR",
            help="Where the face is, some pixels off at most: a box about the model's points in "
            "the first frame of every clip; or a folder with NAME.json or NAME.npz of every clip "
            "NAME.*, whose first frame with landmarks counts.",
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the landmarks, NAME.npz.")
    ],
    backend: Backend,
    json: Json = None,
) -> None:
    """Find landmarks in CLIPs by fitting an appearance model.

    NAME.npz holds points (frames, N, 2) and features (frames, d); compare --features and aam read
    them. What the model cannot explain it cannot find: look at the residual of each clip.
    """
    found = videos_in(clips)
    folder = Path(start) if Path(start).is_dir() else None
    if folder is not None and folder.resolve() == out.resolve():
        raise InputError(f"{out}: would replace the starts; choose another folder")
    require_output(out / f"{found[0].stem}.npz", [*found, model])
    require_output(json, [*found, model])
    from mmmgpu.aam_files import load_aam
    from mmmgpu.aam_tracking import start_in_box, start_of_clip, track_clip, write_tracked
    from mmmgpu.backends import get_backend
    from mmmgpu.commands.summaries import show_table
    from mmmgpu.corpora import check_names
    from mmmgpu.progress import progress

    get_backend(backend)
    check_names(found)
    aam = load_aam(model)
    if folder is None:
        starts = [start_in_box(aam, parse_box(start, "--start"))] * len(found)
    else:
        starts = [start_of_clip(aam, clip, folder) for clip in found]
    results: list[dict[str, Any]] = []
    for clip, first in progress(zip(found, starts, strict=True), "clips", total=len(found)):
        tracked = track_clip(aam, clip, first, backend=backend)
        write_tracked(tracked, aam, out / f"{clip.stem}.npz")
        results.append({"clip": str(clip), **facts_of(tracked)})
    show_table(str(out), [list(r.values()) for r in results], list(results[0]))
    write_results({"folder": str(out), "clips": results}, json)


def facts_of(tracked: "Tracked") -> dict[str, Any]:
    """How well the model fitted a clip; residuals are of colours in [0, 1]."""
    return {
        "frames": len(tracked.residual),
        "unsettled": int((~tracked.settled).sum()),
        "residual": float(tracked.residual.mean()),
        "worst_residual": float(tracked.residual.max()),
    }
