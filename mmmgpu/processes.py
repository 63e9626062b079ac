"""Work shared out to Python processes, for long jobs that the interpreter lock would hold up.

Unlike `multiprocessing`, calling scripts need no ``if __name__ == "__main__"``: a child is a plain
``python -m mmmgpu.processes`` that is told over its standard input what to do, once or again and
again, and answers with one byte for every piece of work done. Results go to files: finished steps
(see `mmmgpu.checkpoints`), or with `map_out` such as nobody else sees.
"""

import os
import pickle
import selectors
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

from mmmgpu.errors import InputError

Tick = Callable[[], None]
Work = Callable[[Any, Tick], None]
Job = tuple[Callable[[Any], Work], Any, list[Any]]  # prepare, shared and items of `share_out`
Child = subprocess.Popen[bytes]
Item = TypeVar("Item")
Result = TypeVar("Result")

ONE_THREAD = dict.fromkeys(
    ("MMMGPU_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "POCL_MAX_PTHREAD_COUNT"), "1"
)
DONE, FAILED, READY = b".", b"!", b"\n"  # READY: for more work
# Children to be given more work; None: none are kept. Not an argument: every job would hand it down
# through all of its steps, only to start less often.
_IDLE: ContextVar[list[Child] | None] = ContextVar("idle", default=None)


@contextmanager
def kept_processes() -> Iterator[None]:
    """Inside, children that have done their work are given more; they keep what memory they have.

    Others are started only where these are too few. Inside another one, its children are kept on.
    """
    if _IDLE.get() is not None:
        yield
        return
    idle: list[Child] = []
    token = _IDLE.set(idle)
    try:
        yield
    finally:
        _IDLE.reset(token)
        _dismiss(idle)


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
    count, idle = min(processes, len(items)), _IDLE.get()
    children: list[Child] = []
    try:
        for i in range(count):
            children.append(_ready_one(idle or []) or _start())
            _tell(children[-1], (prepare, shared, list(items[i::count])))
        _watch(children, advance)
    except BaseException:
        for child in children:
            child.kill()
            child.communicate()
        raise
    if idle is None:
        _dismiss(children)
    else:
        idle += children


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


def _ready_one(idle: list[Child]) -> Child | None:
    """One of `idle`, which it leaves, and those that have died."""
    while idle:
        child = idle.pop()
        if child.poll() is None:
            return child
        child.communicate()
    return None


def _start() -> Child:
    return subprocess.Popen(
        [sys.executable, "-m", "mmmgpu.processes"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, **ONE_THREAD, **_same_modules()},
        start_new_session=True,  # Ctrl-C is the parent's business, which ends its children
    )


def _tell(child: Child, job: Job) -> None:
    assert child.stdin is not None
    try:
        pickle.dump(job, child.stdin)
        child.stdin.flush()
    except BrokenPipeError:
        pass  # it died at once; `_watch` says so


def _dismiss(children: Iterable[Child]) -> None:
    """Tell them that there is no more work, and wait until they have ended."""
    for child in children:
        child.communicate()


def _same_modules() -> dict[str, str]:
    """A child imports from where we do, and never from the folder that it happens to run in."""
    return {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p), "PYTHONSAFEPATH": "1"}


def _watch(children: Sequence[Child], advance: Callable[[int], None]) -> None:
    """Until all are ready for more work."""
    with selectors.DefaultSelector() as pipes:
        for child in children:
            assert child.stdout is not None
            pipes.register(child.stdout, selectors.EVENT_READ, child)
        while pipes.get_map():
            for key, _ in pipes.select():
                answer = os.read(key.fd, 4096)
                if not answer:
                    raise RuntimeError(f"a worker process ended with {key.data.wait()}")
                if FAILED in answer:
                    message = answer[answer.index(FAILED) + 1 :] + key.data.stdout.read()
                    raise InputError(message.decode())
                if answer.endswith(READY):
                    pipes.unregister(key.fileobj)
                if DONE in answer:
                    advance(answer.count(DONE))


def main() -> None:
    """Do what the parent says on standard input, until it says no more."""
    jobs, answers = os.fdopen(0, "rb"), os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)  # whatever a library prints must not pass for an answer

    def tick() -> None:
        answers.write(DONE)

    try:
        while jobs.peek(1):
            _do(pickle.load(jobs), tick)
            answers.write(READY)
    except InputError as e:
        answers.write(FAILED + str(e).encode())
    except (BrokenPipeError, EOFError, pickle.UnpicklingError):
        sys.exit(1)  # the parent is gone


def _do(job: Job, tick: Tick) -> None:
    from mmmgpu.parallel import one_thread_each

    prepare, shared, items = job
    with one_thread_each():
        work = prepare(shared)
        for item in items:
            work(item, tick)


if __name__ == "__main__":
    main()
