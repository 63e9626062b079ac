"""Kernels that Warp has compiled: verified before they are loaded, and compiled again if damaged.

Warp loads what is in its cache as it is. An object file that a power failure has filled with zeros
has no kernels, and wrong bytes in its code end the process. Here every cache entry, which is a
folder, has a file of checksums beside it: an entry that differs from them is removed. The file is
locked meanwhile: of several processes one compiles, and the others wait for it. Where the cache
cannot be written, what it lacks is compiled by every process for itself.
"""

import functools
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path
from shutil import rmtree
from typing import Any

import warp as wp

SOURCES = (".cpp", ".cu")  # of an entry: not loaded
PREFIX = "mmmgpu-warp-"  # of temporary folders


def load(module: Any, device: Any, block: int) -> Any:
    """A kernel module, compiled for a Warp device and so many threads a block, or from the cache.

    Raises:
        Exception: Whatever Warp's compilers and loaders raise.
    """
    entry = Path(wp.config.kernel_cache_dir or "", module.get_module_identifier(block))
    try:
        with _checksums_beside(entry) as kept:
            known = kept.read()
            if known != checksums(entry) and entry.exists():
                rmtree(entry)
            loaded = module.load(device, block)
            made = checksums(entry)
            if made != known:
                kept.truncate(0)
                kept.write(made)
        return loaded
    except OSError:  # the cache cannot be read or written, or its disk is full
        return _load_apart(module, device, block)


def checksums(entry: Path) -> bytes:
    """Of all that is compiled in an entry, as `sha256sum` prints them; b"" if there is nothing."""
    compiled = sorted(path for path in entry.glob("*") if path.suffix not in SOURCES)
    lines = (f"{sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in compiled)
    return "".join(lines).encode()


@contextmanager
def _checksums_beside(entry: Path) -> Iterator[Any]:
    """The file of an entry's checksums, open, and locked where that is possible.

    Raises:
        OSError: There is none, and it cannot be made.
    """
    path = entry.with_name(f"{entry.name}.sha256")
    try:
        file = path.open("ab+", buffering=0)
    except OSError:
        file = path.open("rb", buffering=0)
    with file, _locked(file):
        file.seek(0)
        yield file


@contextmanager
def _locked(file: Any) -> Iterator[None]:
    if sys.platform == "win32":
        yield
        return
    import fcntl

    with suppress(OSError):  # a file system without locks
        fcntl.flock(file, fcntl.LOCK_EX)
    try:
        yield
    finally:
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_UN)  # closing is not enough if a child was forked


def _load_apart(module: Any, device: Any, block: int) -> Any:
    """A kernel module, compiled in a folder of this process."""
    cache = wp.config.kernel_cache_dir
    wp.config.kernel_cache_dir = own_folder()
    try:
        return module.load(device, block)
    finally:
        wp.config.kernel_cache_dir = cache


def own_folder() -> str:
    """A folder that is removed at the end of the process."""
    return _own_folder().name


@functools.cache
def _own_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix=PREFIX, ignore_cleanup_errors=True)
