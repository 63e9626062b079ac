"""Less at a time where the memory of a device does not hold all at once."""

from collections.abc import Callable
from typing import TypeVar

from mmmgpu.errors import DeviceMemoryError

Part = TypeVar("Part")


def in_parts(compute: Callable[[slice], Part], count: int) -> list[Part]:
    """`compute(slice)` for the items 0 ... `count` - 1, in as few parts as memory allows.

    A part that does not fit is halved. Parts come in order.

    Args:
        compute: Gives its result in host memory, and keeps nothing on the device.
        count: Number of items, at least 1.

    Raises:
        DeviceMemoryError: A single item does not fit.
    """
    return _halved(compute, 0, count)


def _halved(compute: Callable[[slice], Part], first: int, last: int) -> list[Part]:
    try:
        return [compute(slice(first, last))]
    except DeviceMemoryError:
        if last - first == 1:
            raise
    # outside of `except`: what the failed attempt held on the device is free by now
    middle = (first + last) // 2
    return _halved(compute, first, middle) + _halved(compute, middle, last)
