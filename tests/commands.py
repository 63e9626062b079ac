"""Commands run inside the test process, and what is expected of a refusal."""

from dataclasses import dataclass

import pytest

from mmmgpu.cli import app
from mmmgpu.training import Options, train

SMALL = Options(prototypes=6)


@dataclass(frozen=True)
class Ended:
    """How a command ended: its status and what it wrote."""

    status: int
    out: str
    err: str


def run_command(capfd, *args):
    """Run ``mmmgpu ARGS...`` as the console script does, less the handling of Ctrl-C."""
    capfd.readouterr()
    with pytest.raises(SystemExit) as end:
        app([str(arg) for arg in args], prog_name="mmmgpu")
    out, err = capfd.readouterr()
    return Ended(end.value.code, out, err)


def assert_refused(ended, *words):
    """Status 1, no results, and one line for a person that holds all `words`."""
    assert (ended.status, ended.out) == (1, "")
    assert "Traceback" not in ended.err
    (line,) = [line for line in ended.err.splitlines() if line.startswith("mmmgpu: error: ")]
    assert "defect" not in line
    for word in words:
        assert str(word) in line


def trained_model(world):
    """A model of the first two clips of `world`, trained once."""
    path = world.alignments / "person.mmm"
    if not path.exists():
        train(world.clips[:2], world.alignments, path, options=SMALL)
    return path
