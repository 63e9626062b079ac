import os
import subprocess
import sys

import numpy as np
import pytest

from mmmgpu.checkpoints import (
    fingerprint,
    finished_steps_only,
    open_checkpoints,
    read_step,
    write_step,
)
from mmmgpu.errors import InputError


@pytest.fixture
def clips(tmp_path):
    paths = [tmp_path / name for name in ("a.mkv", "b.mkv")]
    for path in paths:
        path.write_bytes(b"12345")
        os.utime(path, ns=(10**18, 10**18))
    return paths


def test_same_inputs_same_fingerprint(clips):
    assert fingerprint(clips, {"seed": 1, "region": None}) == fingerprint(
        clips, {"seed": 1, "region": None}
    )


CHANGES = {
    "length": lambda clips: clips[1].write_bytes(b"123456"),
    "time": lambda clips: os.utime(clips[1], ns=(10**18, 10**18 + 1)),
    "order": lambda clips: clips.reverse(),
    "fewer": lambda clips: clips.pop(),
}


@pytest.mark.parametrize("change", CHANGES)
def test_another_file_is_another_fingerprint(clips, change):
    before = fingerprint(clips, {})
    CHANGES[change](clips)
    if change == "length":  # and nothing but the length
        os.utime(clips[1], ns=(10**18, 10**18))
    assert fingerprint(clips, {}) != before


def test_another_option_is_another_fingerprint(clips):
    marks = [
        fingerprint(clips, options) for options in ({}, {"seed": 0}, {"seed": 1}, {"seed": [0]})
    ]
    assert len(set(marks)) == 4


def test_a_step_comes_back_bit_for_bit(tmp_path):
    folder = open_checkpoints(tmp_path / "new" / "work", "mark")
    arrays = {
        "pose": np.random.default_rng(0).normal(size=(3, 3)),
        "registered": np.array([True, False]),
        "skipped": np.array("clip ü: why"),
        "empty": np.zeros((0, 2), np.float32),
    }
    assert read_step(folder, "track-a b.mkv") is None
    write_step(folder, "track-a b.mkv", arrays)
    known = read_step(folder, "track-a b.mkv")
    assert known.keys() == arrays.keys()
    for name, array in arrays.items():
        assert known[name].dtype == array.dtype
        np.testing.assert_array_equal(known[name], array)


def test_steps_stay_for_the_same_inputs_and_go_for_others(tmp_path):
    folder = open_checkpoints(tmp_path / "work", "mark")
    write_step(folder, "step", {"x": np.arange(3)})
    open_checkpoints(tmp_path / "work", "mark")
    assert read_step(folder, "step") is not None
    open_checkpoints(tmp_path / "work", "another mark")
    assert read_step(folder, "step") is None
    assert [p.name for p in folder.iterdir()] == ["fingerprint"]


def test_a_folder_of_somebody_else_is_not_touched(tmp_path):
    theirs = tmp_path / "work"
    theirs.mkdir()
    (theirs / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match=r"work: .*not made by mmmgpu"):
        open_checkpoints(theirs, "mark")
    assert (theirs / "thesis.txt").read_text() == "years of work"


def test_a_folder_left_without_fingerprint_is_used(tmp_path):
    (tmp_path / "work").mkdir()  # killed between the making of the folder and of the fingerprint
    folder = open_checkpoints(tmp_path / "work", "mark")
    assert (folder / "fingerprint").read_text() == "mark"


def test_a_file_in_the_way_is_said(tmp_path):
    (tmp_path / "work").write_text("")
    with pytest.raises(InputError, match="work"):
        open_checkpoints(tmp_path / "work", "mark")


@pytest.mark.parametrize("share", [0.0, 0.3, 0.95])
def test_a_damaged_step_is_done_again(tmp_path, share):
    folder = open_checkpoints(tmp_path / "work", "mark")
    write_step(folder, "step", {"x": np.arange(300)})
    file = folder / "step.npz"
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    assert read_step(folder, "step") is None


def test_no_step_is_written_by_halves(tmp_path):
    folder = open_checkpoints(tmp_path / "work", "mark")
    with pytest.raises(ZeroDivisionError):
        write_step(folder, "step", {"good": np.arange(3), "bad": Unwritable()})
    assert [p.name for p in folder.iterdir()] == ["fingerprint"]


def written_when_killed(folder):
    """A process is killed while it writes a step."""
    writing = (
        "import os, sys; from pathlib import Path; from mmmgpu.files import atomic_path\n"
        "with atomic_path(Path(sys.argv[1]) / 'b.npz') as path:\n"
        "    path.write_bytes(b'half'); os.kill(os.getpid(), 9)"
    )
    killed = subprocess.run([sys.executable, "-c", writing, str(folder)], check=False)
    assert killed.returncode == -9
    assert len(list(folder.iterdir())) == 3


def test_what_a_killed_process_was_writing_is_removed(tmp_path):
    folder = open_checkpoints(tmp_path / "work", "mark")
    write_step(folder, "a", {"x": np.arange(3)})
    with finished_steps_only(folder):
        written_when_killed(folder)
    assert {p.name for p in folder.iterdir()} == {"fingerprint", "a.npz"}
    written_when_killed(folder)
    open_checkpoints(folder, "mark")
    assert {p.name for p in folder.iterdir()} == {"fingerprint", "a.npz"}


def test_no_pickle_is_read(tmp_path):
    folder = open_checkpoints(tmp_path / "work", "mark")
    write_step(folder, "step", {"bad": np.array([{"a": 1}], object)})
    assert read_step(folder, "step") is None


class Unwritable:
    def __array__(self, dtype=None, copy=None):
        raise ZeroDivisionError
