"""The command ``mmmgpu``: its subcommands are in mmmgpu.commands, one a module."""

import io
import os
import sys
from typing import Annotated

import typer

from mmmgpu import __version__
from mmmgpu.commands import (
    aam,
    adapt,
    align,
    bench,
    compare,
    demo,
    evaluate,
    info,
    live,
    mark,
    reconstruct,
    speak,
    study,
    track,
    train,
    transfer,
)
from mmmgpu.commands.endings import INTERRUPTED, guarded, prompt_interrupts
from mmmgpu.errors import say_warnings

app = typer.Typer(
    name="mmmgpu",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="Begin with: mmmgpu demo. All about one command: mmmgpu COMMAND --help.",
)


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"mmmgpu {__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """Learn a talking face from video and let it say something new.

    A person's clips and what is said in them become a model (align, train); the model renders that
    person saying anything (speak). Results go to the standard output, progress to the standard
    error. The status is 0, 1 if the job failed (one line says why), or 2 if the call was wrong.
    """


for _command, _example in (
    (demo.demo, demo.EXAMPLE),
    (align.align, align.EXAMPLE),
    (aam.aam, aam.EXAMPLE),
    (track.track, track.EXAMPLE),
    (train.train, train.EXAMPLE),
    (reconstruct.reconstruct, reconstruct.EXAMPLE),
    (speak.speak, speak.EXAMPLE),
    (live.live, live.EXAMPLE),
    (evaluate.evaluate, evaluate.EXAMPLE),
    (compare.compare, compare.EXAMPLE),
    (mark.mark, mark.EXAMPLE),
    (transfer.transfer, transfer.EXAMPLE),
    (adapt.adapt, adapt.EXAMPLE),
    (info.info, info.EXAMPLE),
):
    app.command(epilog=_example)(guarded(_command))
app.add_typer(bench.app, name="bench")
app.add_typer(study.app, name="study")


def main() -> None:
    """Run the command line of this process and exit."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # any file name can be shown
    prompt_interrupts()
    say_warnings()
    try:
        app()
    except SystemExit as end:
        if end.code == INTERRUPTED:
            os._exit(INTERRUPTED)  # libraries may take a second to take themselves down
        raise
