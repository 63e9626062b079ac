"""``mmmgpu demo``: everything in one go, on the built-in performers."""

from pathlib import Path
from typing import Annotated

import typer

from mmmgpu.commands.options import Backend, Json, LibraryDefault
from mmmgpu.commands.places import require_output, write_results

EXAMPLE = "Example: mmmgpu demo --out demo"


def demo(
    *,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for all that is made.")] = Path(
        "demo"
    ),
    seed: Annotated[
        int,
        typer.Option(
            min=0,
            help="Which performer.",
            default_factory=LibraryDefault("mmmgpu.demo", "make_demo", "seed"),
        ),
    ],
    backend: Backend,
    json: Json = None,
) -> None:
    """Learn a drawn person and let it speak: no video needed.

    The folder then holds the clips, the model, the new sentence as a video with
    sound, real, reconstructed and spoken side by side, and report.html.
    """
    require_output(out / "report.html")
    require_output(json)
    from mmmgpu.backends import get_backend
    from mmmgpu.demo import make_demo

    get_backend(backend)
    write_results(make_demo(out, seed=seed, backend=backend), json)
