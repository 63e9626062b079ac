"""Arrays at the border: what the public functions accept, checked once and turned into float32.

Inner code and the backends trust what has passed here.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mmmgpu.errors import InputError

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]
LARGEST = 2**31 - 1  # elements; the kernels count in int32


def as_float32(name: str, array: ArrayLike, *axes: str | int) -> F32:
    """`array` as C-order float32, after checking that it is real, finite and ends in `axes`.

    Args:
        name: The argument's name, for the error.
        array: Numbers, any real dtype; not copied if it already is C-order float32.
        axes: The last axes: a letter for any size, a number for exactly that size. A leading
            "..." allows any number of axes before them.

    Raises:
        InputError: Not numeric, wrong shape, NaN or infinite (also by overflow of float32), or
            more than 2**31 - 1 elements.
    """
    given = _numeric(name, array)
    _check_shape(name, given.shape, axes)
    if given.size > LARGEST:
        raise InputError(f"{name} has {given.size} elements, more than {LARGEST}; give it in parts")
    with np.errstate(over="ignore"):
        a = np.asarray(given, dtype=np.float32, order="C")
    if not (math.isfinite(a.min(initial=0)) and math.isfinite(a.max(initial=0))):
        raise InputError(f"{name} holds NaN or infinite values (as float32); remove or mask them")
    return a


def as_indices(name: str, array: ArrayLike, below: int, *axes: str | int) -> I32:
    """`array` as C-order int32, after checking that it holds whole numbers 0 ... `below` - 1.

    Args:
        name: The argument's name, for the error.
        array: Whole numbers, any real dtype.
        below: How many things there are to choose from.
        axes: As for `as_float32`.

    Raises:
        InputError: As `as_float32`; also numbers that are not whole, or out of range.
    """
    given = _numeric(name, array)
    _check_shape(name, given.shape, axes)
    if not np.isfinite(given).all():
        raise InputError(f"{name} holds NaN or infinite values; remove or mask them")
    bad = given[(given != np.floor(given)) | (given < 0) | (given >= below)]
    if bad.size:
        raise InputError(f"{name} must hold whole numbers from 0 to {below - 1}, got {bad.flat[0]}")
    return np.asarray(given, dtype=np.int32, order="C")


def _numeric(name: str, array: ArrayLike) -> NDArray[Any]:
    try:
        given = np.asarray(array)
    except ValueError:
        raise InputError(f"{name} is not an array of numbers: its rows differ in length") from None
    if given.dtype.kind not in "fiub":
        raise InputError(f"{name} must hold real numbers, got dtype {given.dtype}")
    return given


def _check_shape(name: str, shape: tuple[int, ...], axes: tuple[str | int, ...]) -> None:
    fixed = axes[1:] if axes[:1] == ("...",) else axes
    tail = shape[len(shape) - len(fixed) :]
    fits = len(shape) >= len(fixed) if fixed is not axes else len(shape) == len(fixed)
    if not fits or any(isinstance(w, int) and w != g for w, g in zip(fixed, tail, strict=True)):
        want = ", ".join(str(a) for a in axes)
        raise InputError(f"{name} must have shape ({want}), got {shape}")


def broadcast_leads(**leads: tuple[int, ...]) -> tuple[int, ...]:
    """The common shape of the leading (batch) axes of several named arguments.

    Raises:
        InputError: They do not broadcast.
    """
    try:
        return np.broadcast_shapes(*leads.values())
    except ValueError:
        got = ", ".join(f"{name} {lead}" for name, lead in leads.items())
        raise InputError(f"the leading axes do not broadcast: {got}") from None


def as_batch(array: F32, lead: tuple[int, ...], tail: int) -> F32:
    """`array` with its axes before the last `tail` turned into one batch axis that fits `lead`.

    An array that is the same for the whole batch keeps a batch of one: nothing is copied.
    """
    own, rest = array.shape[: array.ndim - tail], array.shape[array.ndim - tail :]
    if math.prod(own) != 1 and math.prod(own) != math.prod(lead):
        array = np.broadcast_to(array, (*lead, *rest))
    return array.reshape(-1, *rest)


def check_some_valid(valid: NDArray[Any]) -> None:
    """Raise for the first field of a batch without a valid pixel: there is nothing to fill with.

    Args:
        valid: Number of valid pixels of each field, shape (B,).
    """
    if not valid.all():
        raise InputError(
            f"weight: field {int(np.argmin(valid))} of the batch has no pixel that reaches the "
            "threshold; lower the threshold or leave that field out"
        )
