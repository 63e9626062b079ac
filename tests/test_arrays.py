import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mmmgpu.arrays import as_batch, as_float32, as_indices
from mmmgpu.errors import InputError


def test_float32_arrays_are_not_copied():
    array = np.ones((2, 3), np.float32)
    assert as_float32("a", array, "N", 3) is array


@pytest.mark.parametrize("kind", [np.int32, np.int64, np.uint8, np.float64])
def test_indices_of_any_type_become_int32(kind):
    indices = as_indices("a", np.array([[0, 3]], kind), 4, "N", 2)
    assert indices.dtype == np.int32
    assert_array_equal(indices, [[0, 3]])


@pytest.mark.parametrize("bad", [4, -1, 0.5])
def test_indices_out_of_range_are_an_error_that_shows_one(bad):
    with pytest.raises(InputError, match=rf"^a must hold whole numbers from 0 to 3, got {bad}"):
        as_indices("a", [0, 3, bad, 1], 4, "N")


@pytest.mark.parametrize(
    ("axes", "shape"), [(("N", 3), (2, 4)), (("N",), (2, 3)), (("...", 2, "C"), (3, 3, 1))]
)
def test_axes_are_checked(axes, shape):
    with pytest.raises(InputError, match=r"^a must have shape \(.*\), got \(.*\)$"):
        as_float32("a", np.zeros(shape), *axes)


def test_more_elements_than_a_kernel_counts_are_an_error():
    huge = np.broadcast_to(np.float32(0), (2**16, 2**15))
    with pytest.raises(InputError, match=r"a has 2147483648 elements, more than 2147483647"):
        as_float32("a", huge, "N", "P")


def test_a_batch_of_one_is_not_repeated():
    field = np.ones((1, 1, 4, 5, 3), np.float32)
    assert as_batch(field, (2, 7), 3).shape == (1, 4, 5, 3)


def test_a_batch_that_broadcasts_is_repeated_in_c_order():
    field = np.arange(2).reshape(2, 1, 1, 1, 1) * np.ones((2, 1, 4, 5, 3))
    assert_array_equal(as_batch(field, (2, 3), 3)[:, 0, 0, 0], [0, 0, 0, 1, 1, 1])
