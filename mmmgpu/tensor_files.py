"""Files of named arrays: safetensors with one JSON header, checked before it is used.

What is no array lies, with ``format`` and ``version``, as JSON in the header's one entry ``mmmgpu``
(several would come in random order, and the same content would not be the same bytes). No pickle
anywhere. What a file must hold is said by those who read it.
"""

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from mmmgpu.errors import InputError
from mmmgpu.files import write_bytes

Tensors = dict[str, NDArray[Any]]
Facts = dict[str, Any]
Wanted = Mapping[str, tuple[tuple[int, ...], str]]
T = TypeVar("T")

HEADER = "mmmgpu"


@dataclass(frozen=True)
class FileKind:
    """A kind of file.

    format, version: what its header says; higher versions are refused.
    name: what a person calls it. maker: the command that writes it. remedy: how to get a good one.
    """

    format: str
    version: int
    name: str
    maker: str
    remedy: str


def write_tensors(
    path: str | os.PathLike[str], kind: FileKind, facts: Facts, tensors: Tensors
) -> None:
    """Write arrays and the JSON values `facts` to `path`, whole or not at all."""
    from safetensors.numpy import save

    said = {"format": kind.format, "version": kind.version, **facts}
    header = {HEADER: json.dumps(said, ensure_ascii=False, allow_nan=False)}
    whole = {name: np.ascontiguousarray(value) for name, value in tensors.items()}
    write_bytes(path, save(whole, metadata=header))  # its save_file hides why it fails


def read_tensors(
    path: str | os.PathLike[str], kind: FileKind, assemble: Callable[[Path, Tensors, Facts], T]
) -> T:
    """What `assemble` makes of the arrays and facts in the file at `path`, which it checks.

    Raises:
        InputError: No such file, not of this kind, truncated, of a newer version, or what
            `assemble` raises; errors of lookup, type and value in it mean a header like no other.
    """
    from safetensors import SafetensorError, safe_open

    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such {kind.name} file; make one with: {kind.maker}")
    try:
        with safe_open(str(path), framework="numpy") as file:
            facts = _check_header(path, kind, _parsed((file.metadata() or {}).get(HEADER, "")))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return assemble(path, tensors, facts)
    except InputError:
        raise
    except (SafetensorError, OSError) as e:
        raise InputError(
            f"{path}: truncated, damaged or not a {kind.name} ({e}); {kind.remedy}"
        ) from e
    except (LookupError, TypeError, ValueError, AttributeError) as e:
        raise InputError(f"{path}: the {kind.name} lacks or misstates {e}; {kind.remedy}") from e


def format_of(path: str | os.PathLike[str]) -> str | None:
    """What the header of the file at `path` says it is; None where it is no such file."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="numpy") as file:
            facts = _parsed((file.metadata() or {}).get(HEADER, ""))
    except (SafetensorError, OSError):
        return None
    found = facts.get("format") if isinstance(facts, dict) else None
    return found if isinstance(found, str) else None


def check_tensors(path: Path, kind: FileKind, tensors: Tensors, wanted: Wanted) -> None:
    """Every one of `wanted`, shape and type by name, is there, so, and finite."""
    for name, (shape, code) in wanted.items():
        tensor = tensors[name]
        if tensor.shape != shape or tensor.dtype != np.dtype(code):
            raise InputError(
                f"{path}: tensor {name} must be {np.dtype(code)} {shape}, "
                f"is {tensor.dtype} {tensor.shape}; {kind.remedy}"
            )
        if tensor.dtype.kind == "f" and not np.isfinite(tensor).all():
            raise InputError(f"{path}: tensor {name} holds NaN or infinity; {kind.remedy}")


def _parsed(text: str) -> Any:
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return None


def _check_header(path: Path, kind: FileKind, facts: Any) -> Facts:
    if not isinstance(facts, dict) or facts.get("format") != kind.format:
        raise InputError(
            f"{path}: not a mmmgpu {kind.name}; give a file that {kind.maker} has written"
        )
    version = facts.get("version")
    if type(version) is not int or not 1 <= version <= kind.version:
        raise InputError(
            f"{path}: has format version {version}, this mmmgpu reads up to {kind.version}; "
            "update mmmgpu"
        )
    return facts
