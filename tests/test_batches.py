import itertools

import pytest

from mmmgpu.batches import in_parts
from mmmgpu.errors import DeviceMemoryError


def holding(most, log):
    """A computation that holds at most so many items at a time."""

    def compute(part):
        log.append((part.start, part.stop))
        if part.stop - part.start > most:
            raise DeviceMemoryError("not enough memory")
        return list(range(part.start, part.stop))

    return compute


@pytest.mark.parametrize("count", [1, 2, 5, 16, 17])
@pytest.mark.parametrize("most", [1, 2, 3, 16, 100])
def test_parts_come_in_order_and_fit(count, most):
    parts = in_parts(holding(most, []), count)
    assert [*itertools.chain.from_iterable(parts)] == list(range(count))
    assert max(map(len, parts)) <= most


def test_what_fits_is_done_at_once():
    log = []
    in_parts(holding(8, log), 8)
    assert log == [(0, 8)]


def test_a_single_item_that_does_not_fit_is_an_error():
    log = []
    with pytest.raises(DeviceMemoryError):
        in_parts(holding(0, log), 4)
    assert log == [(0, 4), (0, 2), (0, 1)]


def test_other_errors_pass_at_once():
    log = []

    def compute(part):
        log.append(part)
        return 1 // 0

    with pytest.raises(ZeroDivisionError):
        in_parts(compute, 4)
    assert log == [slice(0, 4)]
