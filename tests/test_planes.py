import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mmmgpu.backends.planes import LANES, picture, pitch_of, planes


@pytest.mark.parametrize(("width", "pitch"), [(1, 16), (16, 16), (17, 32), (250, 256)])
def test_rows_are_whole_vectors(width, pitch):
    assert pitch_of(width) == pitch
    assert pitch % LANES == 0


@pytest.mark.parametrize("width", [1, 16, 37])
@pytest.mark.parametrize("batch", [(), (2,), (2, 3), (0,)])
def test_planes_are_the_channels_in_padded_rows(batch, width):
    given = np.random.default_rng(0).random((*batch, 5, width, 3), dtype=np.float32)
    made = planes(given)
    assert made.shape == (*batch, 3, 5, pitch_of(width))
    for c in range(3):
        assert_array_equal(made[..., c, :, :width], given[..., c])
    assert_array_equal(made[..., width:], 0)


@pytest.mark.parametrize("channels", [2, 3])
@pytest.mark.parametrize("width", [1, 16, 37])
def test_planes_become_a_picture_again(channels, width):
    given = np.random.default_rng(1).random((5, width, channels), dtype=np.float32)
    again = picture(planes(given), width)
    assert_array_equal(again, given)
    assert again.flags.c_contiguous
