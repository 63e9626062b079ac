import errno
import json
import os

import pytest

from mmmgpu.errors import InputError
from mmmgpu.files import (
    atomic_folder,
    atomic_path,
    read_text,
    require_folder,
    write_bytes,
    write_json,
    write_text,
)


@pytest.mark.parametrize(
    "name", ["a.json", "with space.json", "-f.json", "día_日本.json", "x" * 255]
)
def test_the_file_appears_at_the_end(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    with atomic_path(name) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.name.startswith(".")
        assert temporary.suffix == os.path.splitext(name)[1]
        temporary.write_text("new")
        assert not os.path.exists(name)
        inode = temporary.stat().st_ino
    assert os.stat(name).st_ino == inode  # renamed, not copied
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [(name, "new")]


def test_permissions_are_those_of_any_new_file(tmp_path):
    (tmp_path / "plain").touch()
    write_text(tmp_path / "ours", "text")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize("error", [ValueError("x"), KeyboardInterrupt(), SystemExit(3)])
@pytest.mark.parametrize("old", [None, "old"])
def test_an_exception_leaves_what_was_there(tmp_path, error, old):
    if old:
        (tmp_path / "a").write_text(old)

    def interrupted():
        with atomic_path(tmp_path / "a") as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(type(error)) as caught:
        interrupted()
    assert caught.value is error
    assert [p.read_text() for p in tmp_path.iterdir()] == ([old] if old else [])


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (errno.ENOSPC, "the disk is full"),
        (errno.EDQUOT, "the disk quota is used up"),
        (errno.EACCES, "permission denied"),
        (errno.EROFS, "the file system is read-only"),
        (errno.EIO, "input/output error"),
    ],
)
def test_what_the_system_refuses_is_one_line(tmp_path, code, words):
    def refused():
        with atomic_path(tmp_path / "a.json") as temporary:
            temporary.write_text("half")
            raise OSError(code, os.strerror(code))

    with pytest.raises(InputError, match=words) as error:
        refused()
    assert str(error.value).startswith(f"cannot write {tmp_path / 'a.json'}: ")
    assert "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_errors_about_other_files_are_not_blamed_on_this_one(tmp_path):
    def reading_another():
        with atomic_path(tmp_path / "a"):
            (tmp_path / "missing").read_text()

    with pytest.raises(FileNotFoundError, match="missing"):
        reading_another()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_no_folder(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    for path, words in [
        (tmp_path / "file" / "a", "a part of the path is a file"),
        (tmp_path / "missing" / "a", "the folder does not exist"),
        (tmp_path / "folder", "it is a folder"),
    ]:
        with pytest.raises(InputError, match=words):
            write_bytes(path, b"")
    with pytest.raises(InputError, match=r"cannot create the folder .*file: a file of that name"):
        require_folder(tmp_path / "file")
    with pytest.raises(InputError, match=r"cannot create the folder .*is a file, not a folder"):
        require_folder(tmp_path / "file" / "below")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder"]


def test_a_folder_in_the_way_is_found_before_the_work(tmp_path):
    reached = []

    def work():
        with atomic_path(tmp_path) as temporary:
            reached.append(temporary)

    with pytest.raises(InputError, match="it is a folder"):
        work()
    assert reached == []


def test_a_folder_that_may_not_be_written(tmp_path, monkeypatch):
    """The superuser may write everywhere, so the system's answer is made up here."""

    def refuse(path, *_):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr("os.open", refuse)
    with pytest.raises(InputError, match="permission denied: choose"):
        write_text(tmp_path / "a", "text")


def test_folders_are_made_with_their_parents(tmp_path):
    assert require_folder(tmp_path / "a" / "b c") == tmp_path / "a" / "b c"
    assert require_folder(str(tmp_path / "a" / "b c")).is_dir()


def test_text_and_json_come_back(tmp_path):
    write_text(tmp_path / "t", "é\r\nñ\n")
    assert (tmp_path / "t").read_bytes() == "é\r\nñ\n".encode()
    value = {"b": [1, 2.5, None], "a": "日本"}
    write_json(tmp_path / "j", value)
    text = (tmp_path / "j").read_text(encoding="utf-8")
    assert json.loads(text) == value
    assert "日本" in text
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "n", float("nan"))
    assert not (tmp_path / "n").exists()


def test_text_is_read_without_its_mark(tmp_path):
    (tmp_path / "a").write_bytes("\ufeffä b".encode())
    assert read_text(tmp_path / "a") == "ä b"
    (tmp_path / "a").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"a: is not text in UTF-8; convert it"):
        read_text(tmp_path / "a")
    with pytest.raises(InputError, match=r"b: cannot be read"):
        read_text(tmp_path / "b")


@pytest.mark.parametrize("exists", [False, True])
def test_the_folder_appears_at_the_end(tmp_path, exists):
    target = tmp_path / "new" / "folder"
    if exists:
        target.mkdir(parents=True)
    with atomic_folder(target) as temporary:
        (temporary / "a").write_text("x")
        assert temporary.parent == target.parent
        assert exists or not target.exists()
    assert [p.name for p in target.parent.iterdir()] == ["folder"]
    assert (target / "a").read_text() == "x"


@pytest.mark.parametrize("error", [ValueError("x"), KeyboardInterrupt()])
def test_of_a_failed_folder_nothing_is_left(tmp_path, error):
    def interrupted():
        with atomic_folder(tmp_path / "a") as temporary:
            (temporary / "b").write_text("half")
            raise error

    with pytest.raises(type(error)) as caught:
        interrupted()
    assert caught.value is error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("what", ["file", "full folder"])
def test_a_folder_replaces_nothing(tmp_path, what):
    target = tmp_path / "a"
    if what == "file":
        target.write_text("old")
    else:
        write_text(require_folder(target) / "b", "old")
    with pytest.raises(InputError, match="exists already"), atomic_folder(target):
        pass
    assert (target if what == "file" else target / "b").read_text() == "old"


def test_a_folder_inside_a_file_is_refused(tmp_path):
    (tmp_path / "a").write_text("")
    with (
        pytest.raises(InputError, match="cannot create the folder"),
        atomic_folder(tmp_path / "a" / "b"),
    ):
        pass


def test_a_full_disk_is_one_line_about_the_folder(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("os.replace", full)
    with (
        pytest.raises(InputError, match=r"cannot write .*a: the disk is full"),
        atomic_folder(tmp_path / "a"),
    ):
        pass
    assert list(tmp_path.iterdir()) == []
