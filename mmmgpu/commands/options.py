"""Options that several commands share, and defaults that stay where the library has them."""

import importlib
import inspect
from pathlib import Path
from typing import Annotated, Any

import typer

Box = tuple[int, int, int, int]


class LibraryDefault:
    """The default of an argument of a library function or record, looked up when it is needed.

    So it is written once, where it is used, and the command starts without importing that place.
    """

    def __init__(self, module: str, function: str, argument: str):
        self._place = (module, function, argument)

    def __call__(self) -> Any:
        module, function, argument = self._place
        owner = getattr(importlib.import_module(module), function)
        return inspect.signature(owner).parameters[argument].default

    def __str__(self) -> str:
        return str(self())  # shown by --help


def parse_box(text: str, option: str = "--region") -> Box:
    """X,Y,W,H as four whole numbers; a usage error, if it is something else."""
    try:
        x, y, width, height = (int(part) for part in text.split(","))
    except ValueError:
        message = f"{text!r} must be four whole numbers, as in 100,150,80,60"
        raise typer.BadParameter(message, param_hint=option) from None
    return x, y, width, height


def split_names(text: str) -> tuple[str, ...]:
    """The names in "A,B,..."."""
    return tuple(name.strip() for name in text.split(","))


ModelFile = Annotated[
    Path, typer.Argument(metavar="MODEL", help="A model file, written by: mmmgpu train.")
]
Clips = Annotated[
    list[Path],
    typer.Argument(
        metavar="CLIP",
        help="Video files of one person; a folder stands for all videos in it. "
        "Names that begin with a dash go after -- or are written ./-NAME.",
    ),
]
Clip = Annotated[Path, typer.Argument(metavar="CLIP", help="A video file of the model's person.")]
Alignments = Annotated[
    Path,
    typer.Option(
        "--alignments",
        metavar="DIR",
        help="Folder with NAME.TextGrid, NAME.align or NAME.lab for every clip NAME.*, as "
        "written by: mmmgpu align. For one clip also the file itself.",
    ),
]
ModelOut = Annotated[
    Path, typer.Option("--out", metavar="MODEL", help="Model to write, by custom NAME.mmm.")
]
RegionBox = Annotated[
    str | None,
    typer.Option(
        "--region",
        metavar="X,Y,W,H",
        help="Mouth and chin in the first frame of the middle clip, in pixels, where they are "
        "not found by themselves.",
    ),
]
VideoOut = Annotated[
    Path, typer.Option("--out", metavar="VIDEO", help="Video to write: .mp4, .mov or .mkv.")
]
Lossless = Annotated[
    bool, typer.Option("--lossless", help="Exact RGB in place of H.264; best in .mkv.")
]
Report = Annotated[
    Path | None,
    typer.Option("--report", metavar="FILE", help="Also write a report with pictures, as HTML."),
]
Json = Annotated[
    Path | None, typer.Option("--json", metavar="FILE", help="Also write the results as JSON.")
]
Backend = Annotated[
    str,
    typer.Option(
        "--backend",
        metavar="NAME",
        help="What runs the image operations: warp, opencl or numpy (slow), with a device as in "
        "warp:cuda:0; see: mmmgpu info.",
        default_factory=LibraryDefault("mmmgpu.training", "train", "backend"),
    ),
]
Landmarks = Annotated[
    Path | None,
    typer.Option(
        "--landmarks",
        metavar="DIR",
        help="Folder with NAME.npz of tracked points, to measure the lips with.",
    ),
]
Sync = Annotated[
    float,
    typer.Option(
        "--sync",
        metavar="SECONDS",
        help="Move the sound and its alignment against the picture by so much (negative: earlier).",
        default_factory=LibraryDefault("mmmgpu.training", "Options", "sync"),
    ),
]
