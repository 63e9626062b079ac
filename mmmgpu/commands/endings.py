"""How a command ends: status 0, 1 with one line that says why, or 130 soon after Ctrl-C.

Usage errors (status 2) are typer's.
"""

import functools
import os
import signal
import socket
import sys
import threading
import traceback
from collections.abc import Callable
from types import FrameType
from typing import ParamSpec

import typer

from mmmgpu.errors import InputError

P = ParamSpec("P")

INTERRUPTED = 130  # status, as shells have it: 128 + SIGINT
INTERRUPTED_LINE = (
    b"mmmgpu: interrupted; no half-written file is left, what is finished is kept, "
    b"and the same command continues after it\n"
)
GRACE = 1.0  # s, that an interrupted command has for putting its things in order


def say(message: str) -> None:
    """Print one line on the standard error."""
    print(f"mmmgpu: {' '.join(message.split())}", file=sys.stderr, flush=True)


def guarded(command: Callable[P, None]) -> Callable[P, None]:
    """Return `command` ending with a status and one line, never with a traceback.

    With MMMGPU_DEBUG=1 the traceback of a defect comes before its line.
    """

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            command(*args, **kwargs)
            return
        except (typer.Exit, typer.BadParameter, BrokenPipeError):
            raise
        except KeyboardInterrupt:
            status = INTERRUPTED
        except Exception as error:
            status = 1
            say(f"error: {_reason(error)}")
        # outside of `except`: the frames of the command are gone by now, its generators closed
        raise typer.Exit(status)

    return run


def _reason(error: Exception) -> str:
    if isinstance(error, InputError):
        return str(error)
    if os.environ.get("MMMGPU_DEBUG") == "1":
        traceback.print_exception(error)
    if isinstance(error, OSError) and error.strerror:
        where = f"{os.fsdecode(error.filename)}: " if error.filename else ""
        return f"{where}{error.strerror}; check the disk and the paths"
    return (
        f"{type(error).__name__}: {error} (this is a defect, please report it; "
        "MMMGPU_DEBUG=1 shows where it happened)"
    )


def prompt_interrupts() -> None:
    """From now on Ctrl-C ends the process within `GRACE`, a second one at once.

    The first raises KeyboardInterrupt, which unwinds the command; a thread ends the process should
    that take too long, even where the main thread is inside a library. Files are written whole or
    not at all, so that nothing is harmed. Where interrupts are ignored, they stay so.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        return
    said = threading.Event()

    def announce() -> None:
        if not said.is_set():
            said.set()
            os.write(2, b"\n" * os.isatty(2) + INTERRUPTED_LINE)

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        announce()
        raise KeyboardInterrupt

    def watch() -> None:
        while receiver.recv(1)[0] != signal.SIGINT:
            continue
        receiver.settimeout(GRACE)
        try:
            receiver.recv(1)
        except TimeoutError:
            announce()
        os._exit(INTERRUPTED)

    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    # Python writes the number of each signal here at once, whatever the main thread is doing
    signal.set_wakeup_fd(sender.detach(), warn_on_full_buffer=False)
    signal.signal(signal.SIGINT, interrupt)
    threading.Thread(target=watch, name="interrupts", daemon=True).start()
