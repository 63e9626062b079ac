"""``mmmgpu live``: labels on the standard input, pictures as they come."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mmmgpu.commands.endings import say
from mmmgpu.commands.options import Backend, LibraryDefault, Lossless, ModelFile
from mmmgpu.commands.places import require_video_output
from mmmgpu.errors import InputError

if TYPE_CHECKING:
    from mmmgpu.models import Model

EXAMPLE = "Example: phones | mmmgpu live ann.mmm | player --raw"


def live(
    model: ModelFile,
    *,
    out: Annotated[
        Path | None,
        typer.Option(metavar="VIDEO", help="Video to write, in place of raw frames: .mp4, ..."),
    ] = None,
    movement: Annotated[
        str,
        typer.Option(
            "--trajectory",
            metavar="NAME",
            help="How phones become movement: hmm, slds or dpds.",
            default_factory=LibraryDefault("mmmgpu.live", "live", "movement"),
        ),
    ],
    articulation: Annotated[
        float,
        typer.Option(
            metavar="FACTOR",
            help="How far the mouth moves, 0.5 to 1.5.",
            default_factory=LibraryDefault("mmmgpu.live", "live", "articulation"),
        ),
    ],
    lossless: Lossless = False,
    backend: Backend,
) -> None:
    """Move the model's mouth while the phones come in.

    One phone a line is read from the standard input, and each makes one frame at the frame rate of
    the model. Frames go to the standard output as they are made: rows of RGB bytes, nothing else.
    Their size and rate are said on the standard error.
    """
    if out is not None:
        require_video_output(out, [model])
    elif sys.stdout.isatty():
        raise InputError("frames are bytes: send them to a player or a file, or give --out VIDEO")
    from mmmgpu.backends import get_backend
    from mmmgpu.live import live as frames_of
    from mmmgpu.model_files import load
    from mmmgpu.models import labels_known
    from mmmgpu.parallel import one_thread_each
    from mmmgpu.video_writing import write_video

    get_backend(backend)
    person = load(model)
    labels = _labels(set(labels_known(person, movement)))
    frames = frames_of(
        person, labels, movement=movement, articulation=articulation, backend=backend
    )
    with one_thread_each():
        if out is not None:
            write_video(out, frames, fps=person.fps, lossless=lossless)
            return
        _announce(person)
        for frame in frames:
            sys.stdout.buffer.write(frame.tobytes())
            sys.stdout.buffer.flush()


def _announce(model: "Model") -> None:
    width, height = model.frame_size
    say(f"frames of {width} x {height} pixels, rgb24, {model.fps} a second")


def _labels(known: set[str]) -> Iterator[str]:
    """The lines of the standard input; one warning for each label that has a stand-in."""
    from mmmgpu.phones import stand_in

    number = 0
    for number, line in enumerate(sys.stdin.buffer, start=1):
        label = line.decode(errors="replace").strip()
        if not label:
            raise InputError(f"line {number} of the labels is empty; give one phone a line")
        if label not in known:
            say(f"warning: the model has not seen {label}; {stand_in(label, known)} stands in")
            known = known | {label}
        yield label
    if number == 0:
        raise InputError("there are no labels on the standard input; give one phone a line")
