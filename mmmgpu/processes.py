"""Work shared out to Python processes, for long jobs that the interpreter lock would hold up.

Unlike `multiprocessing`, calling scripts need no ``if __name__ == "__main__"``: a child is a plain
``python -m mmmgpu.processes`` that is told over its standard input what to do and answers with one
byte for every piece of work done. Results go to files: finished steps (see `mmmgpu.checkpoints`),
or with `map_out` such as nobody else sees.
"""

import os
import pickle
import selectors
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

from mmmgpu.errors import InputError

Tick = Callable[[], None]
Work = Callable[[Any, Tick], None]
Item = TypeVar("Item")
Result = TypeVar("Result")

ONE_THREAD = dict.fromkeys(
    ("MMMGPU_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "POCL_MAX_PTHREAD_COUNT"), "1"
)
DONE, FAILED = b".", b"!"


def share_out(
    prepare: Callable[[Any], Work],
    shared: Any,
    items: Sequence[Any],
    *,
    processes: int,
    advance: Callable[[int], None],
) -> None:
    """Do ``prepare(shared)(item, tick)`` for every item, in `processes` processes of one thread.

    Args:
        prepare: A function at the top of a module, called once in each process. What it returns
            does one item, and calls `tick()` after every piece of it.
        shared: What all items need.
        items: Dealt out in turn.
        processes: At most so many; a single item takes one.
        advance: Called here with the number of ticks since it was called last.

    Raises:
        InputError: Raised in a process; the others are stopped.
        RuntimeError: A process died.
    """
    count = min(processes, len(items))
    children = [_start(prepare, shared, items[i::count]) for i in range(count)]
    try:
        _watch(children, advance)
    finally:
        for child in children:
            child.kill()
            child.communicate()


def map_out(
    function: Callable[[Item, Tick], Result],
    items: Sequence[Item],
    *,
    processes: int,
    advance: Callable[[int], None],
) -> list[Result]:
    """``function(item, tick)`` of every item, in order, from processes as `share_out` has them.

    `function` is one at the top of a module, or a `functools.partial` of one.
    """
    with TemporaryDirectory() as folder:
        numbered = list(enumerate(items))
        share_out(_keeping, (function, folder), numbered, processes=processes, advance=advance)
        return [pickle.loads(_kept(folder, i).read_bytes()) for i, _ in numbered]


def _keeping(shared: tuple[Callable[[Any, Tick], Any], str]) -> Work:
    function, folder = shared

    def work(numbered: tuple[int, Any], tick: Tick) -> None:
        i, item = numbered
        _kept(folder, i).write_bytes(pickle.dumps(function(item, tick)))

    return work


def _kept(folder: str, i: int) -> Path:
    return Path(folder, f"{i}.pickle")


def _start(
    prepare: Callable[[Any], Work], shared: Any, items: Sequence[Any]
) -> subprocess.Popen[bytes]:
    child = subprocess.Popen(
        [sys.executable, "-m", "mmmgpu.processes"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, **ONE_THREAD, **_same_modules()},
        start_new_session=True,  # Ctrl-C is the parent's business, which ends its children
    )
    assert child.stdin is not None
    try:
        pickle.dump((prepare, shared, list(items)), child.stdin)
        child.stdin.flush()
    except BrokenPipeError:
        pass  # it died at once; `_watch` says so
    return child


def _same_modules() -> dict[str, str]:
    """A child imports from where we do, and never from the folder that it happens to run in."""
    return {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p), "PYTHONSAFEPATH": "1"}


def _watch(children: Sequence[subprocess.Popen[bytes]], advance: Callable[[int], None]) -> None:
    with selectors.DefaultSelector() as pipes:
        for child in children:
            assert child.stdout is not None
            pipes.register(child.stdout, selectors.EVENT_READ, child)
        while pipes.get_map():
            for key, _ in pipes.select():
                answer = os.read(key.fd, 4096)
                if not answer:
                    pipes.unregister(key.fileobj)
                    if key.data.wait() != 0:
                        raise RuntimeError(f"a worker process ended with {key.data.returncode}")
                elif FAILED in answer:
                    message = answer[answer.index(FAILED) + 1 :] + key.data.stdout.read()
                    raise InputError(message.decode())
                else:
                    advance(answer.count(DONE))


def main() -> None:
    """Do what the parent says on standard input."""
    answers = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)  # whatever a library prints must not pass for an answer
    try:
        prepare, shared, items = pickle.load(sys.stdin.buffer)
        from mmmgpu.parallel import one_thread_each

        with one_thread_each():
            work = prepare(shared)
            for item in items:
                work(item, lambda: answers.write(DONE) and None)
    except InputError as e:
        answers.write(FAILED + str(e).encode())
    except (BrokenPipeError, EOFError, pickle.UnpicklingError):
        sys.exit(1)  # the parent is gone


if __name__ == "__main__":
    main()
