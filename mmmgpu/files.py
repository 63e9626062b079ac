"""Files that are either whole or not there, and file errors that fit on one line.

Everything is written under a hidden temporary name beside its target and renamed at the end, so an
exception, an interrupt or a full disk leaves neither a half-written file nor a damaged old one.
"""

import errno
import json
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .errors import InputError

TEMPORARY = ".mmmgpu-"  # how the name of a file begins that is still being written

_REMEDIES = {
    errno.ENOSPC: "the disk is full: free some space or choose another folder",
    errno.EDQUOT: "the disk quota is used up: free some space or choose another folder",
    errno.EACCES: "permission denied: choose a folder and file that you may write",
    errno.EPERM: "not permitted: choose a folder and file that you may write",
    errno.EROFS: "the file system is read-only: choose another folder",
    errno.ENOTDIR: "a part of the path is a file, not a folder: choose another name",
    errno.EEXIST: "a file of that name is in the way: choose another name",
    errno.ENOENT: "the folder does not exist: create it first or correct the path",
    errno.EISDIR: "it is a folder: give the name of a file",
    errno.ENAMETOOLONG: "the name is too long: choose a shorter one",
    errno.EFBIG: "the file system takes no file that large: choose another folder",
    errno.EIO: "the disk reports an input/output error: choose another disk",
}


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path to write; on success it becomes `path`, otherwise it is removed.

    The temporary file exists (empty), lies in the folder of `path` and has its suffix. A failure to
    write (disk full, no permission, ...) is an InputError; other exceptions pass unchanged.
    """
    target = Path(path)
    temporary = _temporary(target)
    try:
        _create(temporary, target)
        yield temporary
        _flush_to_disk(temporary)
        os.replace(temporary, target)
    except OSError as error:
        if error.errno not in _REMEDIES or not _is_about(error, temporary):
            raise
        raise InputError(f"cannot write {target}: {_REMEDIES[error.errno]}") from error
    finally:
        _remove(temporary)


@contextmanager
def atomic_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a new folder to fill; on success it becomes `path`, otherwise it is removed.

    Raises:
        InputError: There is something at `path` already that is no empty folder, or a new folder
            cannot be made there.
    """
    target = Path(path)
    if target.exists() and not (target.is_dir() and not any(target.iterdir())):
        raise InputError(f"{target}: exists already; choose another name, or take it away")
    require_folder(target.absolute().parent)
    temporary = _temporary(target)
    try:
        temporary.mkdir()
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        if error.errno not in _REMEDIES or not _is_about(error, temporary):
            raise
        raise InputError(f"cannot write {target}: {_REMEDIES[error.errno]}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def require_writable(path: str | os.PathLike[str]) -> None:
    """Raise InputError, which says why, unless the file `path` can be written.

    Its folder is made where it does not exist; the file itself is neither made nor changed.
    """
    target = Path(path)
    require_folder(target.parent)
    temporary = _temporary(target)
    try:
        _create(temporary, target)
    except OSError as error:
        reason = _REMEDIES.get(error.errno or 0, str(error))
        raise InputError(f"cannot write {target}: {reason}") from error
    finally:
        _remove(temporary)


def _temporary(target: Path) -> Path:
    return target.absolute().with_name(f"{TEMPORARY}{secrets.token_hex(6)}{target.suffix}")


def _create(temporary: Path, target: Path) -> None:
    """Make the empty file `temporary`, unless `target` is a folder."""
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))


def _is_about(error: OSError, temporary: Path) -> bool:
    """Whether a failure inside the block concerns the file being written, not another one."""
    return error.filename is None or str(temporary) in os.fsdecode(error.filename)


def _flush_to_disk(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _remove(path: Path) -> None:
    try:
        path.unlink()
    except OSError:
        return  # renamed already, never created, or beyond our reach


def require_folder(path: str | os.PathLike[str]) -> Path:
    """Return `path` as a folder that exists, creating it and its parents.

    An InputError says why that is not possible.
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = _REMEDIES.get(error.errno or 0, str(error))
        raise InputError(f"cannot create the folder {folder}: {reason}") from error
    return folder


def read_text(path: str | os.PathLike[str]) -> str:
    """Return the text in the UTF-8 file `path`.

    Raises:
        InputError: There is none.
    """
    try:
        return Path(path).read_text("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text in UTF-8; convert it") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write `data` to `path`, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write `text` to `path` in UTF-8 with its line ends as they are, whole or not at all."""
    write_bytes(path, text.encode())


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Write `value` to `path` as indented JSON, whole or not at all.

    NaN and infinity are a ValueError: they are not JSON.
    """
    write_text(path, json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n")
