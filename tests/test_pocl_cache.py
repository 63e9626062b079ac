"""Kernels kept for the next process: whole, replaced at once, and never trusted when damaged."""

import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
from test_backends import ONE_OPERATION, run

from mmmgpu.backends.pocl_cache import (
    OWN,
    archive_path,
    cache_variables,
    hold,
    keep,
    remove_stale,
    unpack,
)


@pytest.fixture
def home(tmp_path):
    """Where a process keeps its kernels and its scratch."""
    (tmp_path / "scratch").mkdir()
    return tmp_path


def in_a_process(home):
    places = {"XDG_CACHE_HOME": str(home / "cache"), "TMPDIR": str(home / "scratch")}
    return run(ONE_OPERATION, "opencl", **places)


def test_the_next_process_finds_what_was_compiled_and_compiles_nothing(home):
    first = in_a_process(home)
    (archive,) = (home / "cache" / "mmmgpu").iterdir()
    kept = archive.read_bytes()
    assert any(name.endswith("sample.so") for name in zipfile.ZipFile(archive).namelist())
    assert in_a_process(home) == first
    assert archive.read_bytes() == kept
    assert list((home / "scratch").iterdir()) == []


def test_a_damaged_archive_is_made_again(home):
    first = in_a_process(home)
    (archive,) = (home / "cache" / "mmmgpu").iterdir()
    kept = bytearray(archive.read_bytes())
    kept[len(kept) // 2] ^= 255  # inside a kernel: the archive's list of files is whole
    archive.write_bytes(kept)
    assert in_a_process(home) == first
    assert zipfile.ZipFile(archive).testzip() is None


def test_a_place_that_cannot_be_written_costs_only_time(home):
    (home / "cache").mkdir()
    (home / "cache" / "mmmgpu").write_text("a file in the way")
    assert in_a_process(home)
    assert list((home / "scratch").iterdir()) == []


def left_behind(scratch, name):
    """The folder of a process that ended long ago."""
    folder = scratch / name
    folder.mkdir()
    (folder / "a.so").write_bytes(b"x")
    os.utime(folder, (0, 0))
    return folder


def test_the_next_process_removes_what_a_killed_one_has_left(home):
    left_behind(home / "scratch", "mmmgpu-opencl-killed")
    assert in_a_process(home)
    assert list((home / "scratch").iterdir()) == []


def test_folders_that_are_held_or_new_or_others_are_not_removed(tmp_path):
    left_behind(tmp_path, "mmmgpu-opencl-killed")
    left_behind(tmp_path, "of-something-else")
    (tmp_path / "mmmgpu-opencl-new").mkdir()
    held = hold(left_behind(tmp_path, "mmmgpu-opencl-held"))
    remove_stale(tmp_path)
    kept = {"mmmgpu-opencl-held", "mmmgpu-opencl-new", "of-something-else"}
    assert {path.name for path in tmp_path.iterdir()} == kept
    os.close(held)
    remove_stale(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == kept - {"mmmgpu-opencl-held"}


def test_a_process_holds_its_folder_with_an_archive_and_without(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("atexit.register", lambda *_: None)
    for name in OWN:
        monkeypatch.delenv(name, raising=False)
    for _ in range(2):
        folder = Path(cache_variables()["POCL_CACHE_DIR"])
        with pytest.raises(OSError, match="unavailable"):
            hold(folder)
        keep(filled(folder, "x/a.so"), archive_path(), set())


def filled(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(name.encode() * 40)
    return folder


@pytest.mark.parametrize("damage", ["missing", "empty", "cut", "flipped", "no archive"])
def test_nothing_is_unpacked_from_what_is_damaged(tmp_path, damage):
    archive, folder = tmp_path / "a.zip", tmp_path / "new"
    keep(filled(tmp_path / "old", "x/a.so", "y/b.bc"), archive, set())
    whole = archive.read_bytes()
    spoilt = np.frombuffer(whole, np.uint8).copy()
    spoilt[60] ^= 255
    damaged = {
        "empty": b"",
        "cut": whole[:-30],
        "flipped": spoilt.tobytes(),
        "no archive": b"x" * 99,
    }
    archive.unlink()
    if damage != "missing":
        archive.write_bytes(damaged[damage])
    folder.mkdir()
    assert unpack(archive, folder) == set()
    assert list(folder.iterdir()) == []


def test_what_is_kept_comes_back_and_others_go(tmp_path):
    archive, folder = tmp_path / "pocl-2.zip", tmp_path / "new"
    (tmp_path / "pocl-1.zip").write_bytes(b"of another version")
    old = filled(tmp_path / "old", "x/a.so", "y/b.bc", "tempfile_1")
    keep(old, archive, set())
    assert not old.exists()
    assert [p.name for p in tmp_path.glob("*.zip")] == ["pocl-2.zip"]
    folder.mkdir()
    assert unpack(archive, folder) == {"x/a.so", "y/b.bc"}
    assert (folder / "x/a.so").read_bytes() == b"x/a.so" * 40


def test_an_archive_that_holds_all_is_not_written_again(tmp_path):
    archive = tmp_path / "a.zip"
    keep(filled(tmp_path / "old", "x/a.so"), archive, {"x/a.so", "y/b.bc"})
    assert not archive.exists()


def test_other_kernels_have_another_archive(tmp_path, monkeypatch):
    from mmmgpu.backends import pocl_cache

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert archive_path().parent == tmp_path / "mmmgpu"
    real = archive_path()
    monkeypatch.setattr(pocl_cache, "files", lambda _: filled(tmp_path / "k", "sample.cl"))
    assert archive_path() != real
