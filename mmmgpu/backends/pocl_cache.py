"""Kernels that PoCL has compiled, kept for the next process.

PoCL's own cache is not used as it is: processes that fill it at the same time race, and a damaged
entry ends the process (pocl/pocl issues 430 and 1480). Here every process has a cache folder of its
own, filled from one archive when the driver is loaded. At the end of a process that compiled
something, its folder becomes the archive, replaced as a whole. Checksums are those of the archive:
a damaged one counts for none. A process holds a lock on its folder, so that the next one can tell
what a killed one has left, and removes it.
"""

import atexit
import hashlib
import os
import shutil
import sys
import tempfile
import time
import zipfile
import zlib
from contextlib import suppress
from importlib.resources import files
from pathlib import Path

from mmmgpu.errors import InputError
from mmmgpu.files import atomic_path

OWN = ("POCL_CACHE_DIR", "POCL_KERNEL_CACHE")  # who sets one of these has a cache of their own
KEPT = ("*.bc", "*.so")  # programs and kernels; the rest is PoCL's scratch
PREFIX = "mmmgpu-opencl-"  # of the folders; those of earlier versions are never locked
NEW = 60  # s: a younger folder may not be locked yet
UNUSED = {"POCL_KERNEL_CACHE": "0"}


def cache_variables() -> dict[str, str]:
    """The environment in which PoCL's driver is to be loaded; to be called once in a process."""
    if any(name in os.environ for name in OWN):
        return UNUSED
    remove_stale(Path(tempfile.gettempdir()))
    folder = Path(tempfile.mkdtemp(prefix=PREFIX))
    archive = archive_path()
    known = unpack(archive, folder)  # which may make the folder anew
    with suppress(OSError):
        hold(folder)  # until the process ends
    atexit.register(keep, folder, archive, known)
    return {"POCL_CACHE_DIR": str(folder), "POCL_KERNEL_CACHE": "1"}


def remove_stale(scratch: Path) -> None:
    """Remove the folders in `scratch` that no process holds any more."""
    for folder in scratch.glob(f"{PREFIX}*"):
        with suppress(OSError):  # held, or another user's, or gone by now
            if time.time() - folder.stat().st_mtime > NEW:
                held = hold(folder)
                shutil.rmtree(folder, ignore_errors=True)
                os.close(held)


def hold(folder: Path) -> int:
    """Lock a folder; closing what is returned, or the end of the process, unlocks it.

    Raises:
        OSError: It is locked, or cannot be.
    """
    if sys.platform == "win32":
        raise OSError("folders cannot be locked here")
    import fcntl

    held = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(held)
        raise
    return held


def archive_path() -> Path:
    """Where the kernels of this version are kept; others are of no use."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    digest = hashlib.sha256()
    for source in sorted(files("mmmgpu.kernels").iterdir(), key=lambda file: file.name):
        if source.name.endswith(".cl"):
            digest.update(source.read_bytes())
    return home / "mmmgpu" / f"pocl-{digest.hexdigest()[:16]}.zip"


def unpack(archive: Path, folder: Path) -> set[str]:
    """Fill `folder` from the archive: the names of its files, none if it is missing or damaged."""
    try:
        with zipfile.ZipFile(archive) as packed:
            packed.extractall(folder)
            return set(packed.namelist())
    except (OSError, zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(exist_ok=True)
        return set()


def keep(folder: Path, archive: Path, known: set[str]) -> None:
    """Make `folder` the archive if it holds more than what came from there, and remove it."""
    try:
        made = {str(path.relative_to(folder)) for suffix in KEPT for path in folder.rglob(suffix)}
        if made - known:
            archive.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(archive) as path, zipfile.ZipFile(path, "w") as packed:
                for name in sorted(made):
                    packed.write(folder / name, name)
            for other in archive.parent.glob("pocl-*.zip"):
                if other != archive:
                    other.unlink(missing_ok=True)
    except (OSError, InputError):
        pass  # a full disk, or a home that cannot be written: compiled again next time
    shutil.rmtree(folder, ignore_errors=True)
