"""Records of labels and arrays: what their tensors must be, said once, and checked when read.

A record is a frozen dataclass with a field `labels`, P strings, and fields annotated as tensors:

    mean: Annotated[NDArray[np.float64], tensor("Qd")]

It knows nothing of files: `mmmgpu.dynamics` and `mmmgpu.model_files` write and read the tensors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar, get_type_hints

import numpy as np
from numpy.typing import NDArray

from mmmgpu.errors import InputError

Array = NDArray[Any]
Rule = Callable[[Array], bool]
Record = TypeVar("Record")


@dataclass(frozen=True)
class Tensor:
    """What an array must be; see `tensor`."""

    shapes: tuple[str, ...]
    rule: str
    dtype: np.dtype[Any]


def tensor(*shapes: str, rule: str = "finite", dtype: str = "f8") -> Tensor:
    """What the array of an annotated field must be.

    Args:
        shapes: Those it may have, a letter an axis: Q is P + 1 rows, 1 is one, d any one number,
            the same in all fields.
        rule: One of `RULES`.
        dtype: As NumPy writes it.
    """
    return Tensor(shapes, rule, np.dtype(dtype))


def _above_zero(a: Array) -> bool:
    return bool((a > 0).all())


def _definite(a: Array) -> bool:
    """Variances, all above zero; or covariances, the last two axes, positive definite."""
    if a.ndim < 3:
        return _above_zero(a)
    symmetric = np.array_equal(a, a.swapaxes(-1, -2))
    return symmetric and bool((np.linalg.eigvalsh(a) > 0).all())


def _stable(a: Array) -> bool:
    """|A| < 1: entries of diagonal ones, or eigenvalues of full ones."""
    values = a if a.ndim < 3 else np.linalg.eigvals(a)
    return bool((np.abs(values) < 1).all())


RULES: dict[str, tuple[Rule, str]] = {
    "finite": (lambda a: True, ""),
    "above zero": (_above_zero, "must be above zero"),
    "definite": (_definite, "must be positive definite"),
    "stable": (_stable, "must be below 1 in size"),
}


def tensors_of(record: Any) -> dict[str, Array]:
    """The arrays of `record` by the names of their fields."""
    return {name: getattr(record, name) for name in _tensors(type(record))}


def record_of(kind: type[Record], labels: Any, tensors: Mapping[str, Array]) -> Record:
    """A `kind` with these labels and arrays, after a check of all of them.

    Raises:
        InputError: Labels are not different strings; an array is missing, has another shape or
            type than its field says, holds NaN or infinity, or breaks its rule.
    """
    if not isinstance(labels, list | tuple) or not all(isinstance(x, str) for x in labels):
        raise InputError("labels must be a row of strings")
    if len(set(labels)) != len(labels) or not labels:
        raise InputError("labels must be different from each other, and at least one")
    sizes = {"Q": len(labels) + 1, "1": 1}
    arrays: dict[str, Any] = {"labels": tuple(labels)}
    for name, wanted in _tensors(kind).items():
        if name not in tensors:
            raise InputError(f"tensor {name} is missing")
        _check(name, wanted, tensors[name], sizes)
        arrays[name] = tensors[name]
    return kind(**arrays)


def _tensors(kind: type[Any]) -> dict[str, Tensor]:
    """The annotated fields of `kind`, in order."""
    found = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        for said in getattr(hint, "__metadata__", ()):
            if isinstance(said, Tensor):
                found[name] = said
    return found


def _check(name: str, wanted: Tensor, array: Array, sizes: dict[str, int]) -> None:
    """Raise unless `array` is as `wanted`; letters that it settles are added to `sizes`."""
    if array.dtype != wanted.dtype or not any(
        _fits(array.shape, shape, sizes) for shape in wanted.shapes
    ):
        shapes = " or ".join(
            f"({', '.join(str(sizes.get(axis, axis)) for axis in shape)})"
            for shape in wanted.shapes
        )
        raise InputError(
            f"tensor {name} must be {wanted.dtype} {shapes}, is {array.dtype} {array.shape}"
        )
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise InputError(f"tensor {name} holds NaN or infinity")
    good, said = RULES[wanted.rule]
    if not good(array):
        raise InputError(f"tensor {name} {said}")


def _fits(shape: tuple[int, ...], letters: str, sizes: dict[str, int]) -> bool:
    if len(shape) != len(letters):
        return False
    found = dict(sizes)
    for size, axis in zip(shape, letters, strict=True):
        if size < 1 or found.setdefault(axis, size) != size:
            return False
    sizes.update(found)
    return True
