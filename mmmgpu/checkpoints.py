"""A folder of finished steps beside a result that takes long, so that a killed job continues.

Every step is one ``.npz`` written whole or not at all. The folder belongs to one set of inputs and
options, told by a fingerprint; steps of others are thrown away.
"""

import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from mmmgpu.errors import InputError
from mmmgpu.files import TEMPORARY, atomic_path, require_folder, write_text

Arrays = Mapping[str, NDArray[Any]]


def fingerprint(files: Sequence[Path], options: Mapping[str, Any]) -> str:
    """Hash of the names, sizes and times of `files` and of `options` (JSON values)."""
    stats = [(str(f), f.stat().st_size, f.stat().st_mtime_ns) for f in files]
    return hashlib.sha256(json.dumps([stats, dict(options)]).encode()).hexdigest()


def open_checkpoints(folder: Path, mark: str) -> Path:
    """`folder`, holding only steps made under the fingerprint `mark`.

    Raises:
        InputError: The folder holds files but no fingerprint: it is not ours to empty.
    """
    name = require_folder(folder) / "fingerprint"
    if name.is_file():
        if name.read_text() != mark:
            shutil.rmtree(folder)
            require_folder(folder)
    elif any(not file.name.startswith(TEMPORARY) for file in folder.iterdir()):
        raise InputError(
            f"{folder}: is needed for steps of the work but holds files not made by mmmgpu; "
            "move it or choose another name for the result"
        )
    _remove_unfinished(folder)
    write_text(name, mark)
    return folder


@contextmanager
def finished_steps_only(folder: Path) -> Iterator[None]:
    """Removes from `folder` at the end what killed processes were still writing."""
    try:
        yield
    finally:
        _remove_unfinished(folder)


def _remove_unfinished(folder: Path) -> None:
    for file in folder.glob(f"{TEMPORARY}*"):
        file.unlink()


def read_step(folder: Path, name: str) -> dict[str, NDArray[Any]] | None:
    """The arrays of a finished step; None if it has yet to be done, or its file is damaged."""
    path = folder / f"{name}.npz"
    if not path.is_file():
        return None
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return dict(arrays)
    except (OSError, EOFError, ValueError, BadZipFile):
        return None


def write_step(folder: Path, name: str, arrays: Arrays) -> None:
    """Keep the arrays of a finished step."""
    with atomic_path(folder / f"{name}.npz") as temporary:
        # NumPy before 2.2 would take `allow_pickle` for the name of an array
        np.savez(temporary, **arrays)  # type: ignore[arg-type]
