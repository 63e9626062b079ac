import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmmgpu import aam_tracking
from mmmgpu.aam_fitting import prepare_fitting
from mmmgpu.aam_tracking import (
    Start,
    best_match,
    start_in_box,
    start_of_clip,
    track_clip,
    write_tracked,
)
from mmmgpu.backends import get_backend
from mmmgpu.errors import InputError
from mmmgpu.labelled_clips import read_labelled_clip
from mmmgpu.landmarks import read_landmarks


def distance(a, b):
    """Root mean square over the points (..., N, 2)."""
    return np.sqrt(((a - b) ** 2).sum(axis=-1).mean(axis=-1))


def test_a_box_holds_the_mean_shape(drawn):
    start = start_in_box(drawn.aam, (30, 50, 80, 60))
    low, high = start.points.min(axis=0), start.points.max(axis=0)
    assert_allclose((low + high) / 2, (70, 80))
    assert_allclose(high[0] - low[0], 80)
    mean = drawn.aam.mesh.vertices
    scale = 80 / np.ptp(mean[:, 0])
    assert_allclose(start.points - low, (mean - mean.min(axis=0)) * scale)
    with pytest.raises(InputError, match="has no area"):
        start_in_box(drawn.aam, (30, 50, 0, 60))


def test_a_rough_start_is_looked_for_about(drawn):
    frame, truth = drawn.frame(drawn.held_out, 0), drawn.points(drawn.held_out)[0]
    size = distance(truth, truth.mean(axis=0))
    found = best_match(
        prepare_fitting(drawn.aam), frame, truth + 0.3 * size, get_backend("warp", 1)
    )
    assert distance(found.shape, truth) < 1.5


def test_a_clip_is_tracked_both_ways_from_where_it_starts(drawn):
    truth = drawn.points(drawn.held_out)
    tracked = track_clip(drawn.aam, drawn.held_out, Start(20, truth[20] + (3, -2)))
    assert tracked.points.shape == truth.shape
    assert tracked.features.shape == (len(truth), len(drawn.aam.variance))
    off = distance(tracked.points, truth)
    assert np.median(off) < 1
    assert off.max() < 3
    assert tracked.settled.mean() > 0.8
    still = distance(truth[20], truth)
    assert np.median(off / np.maximum(still, 0.5)) < 0.6  # it follows


@pytest.fixture(scope="module")
def written(drawn, tmp_path_factory):
    folder = tmp_path_factory.mktemp("tracked")
    truth = drawn.points(drawn.held_out)
    tracked = aam_tracking.Tracked(
        truth, np.zeros((len(truth), 10)), np.zeros(len(truth)), np.ones(len(truth), bool)
    )
    write_tracked(tracked, drawn.aam, folder / f"{drawn.held_out.stem}.npz")
    return folder


def test_what_was_tracked_is_read_as_landmarks(drawn, written):
    truth = drawn.points(drawn.held_out)
    again = read_labelled_clip(drawn.held_out, written, drawn.aam.rows)
    assert_allclose(again.points, truth, atol=1e-4)
    assert again.is_complete
    two = drawn.aam.rows[5], drawn.aam.rows[2], drawn.aam.rows[9]
    some = read_labelled_clip(drawn.held_out, written, two)
    assert_array_equal(some.points, again.points[:, [5, 2, 9]])
    start = start_of_clip(drawn.aam, drawn.held_out, written)
    assert start.frame == 0
    assert_array_equal(start.points, again.points[0])


def test_chosen_landmarks_are_not_taken_for_a_trackers(drawn, written):
    with pytest.raises(InputError, match="holds 38 landmarks chosen for an appearance model"):
        read_landmarks(written, drawn.held_out)
    other = (0, 1, 2, 103)
    with pytest.raises(InputError, match="has 38 landmarks a frame"):
        read_labelled_clip(drawn.held_out, written, other)


def test_rows_that_are_not_those_of_the_points_are_refused(drawn, tmp_path):
    points = drawn.points(drawn.held_out)
    np.savez(tmp_path / f"{drawn.held_out.stem}.npz", points=points, rows=np.arange(37))
    with pytest.raises(InputError, match="one of the 'rows' for each point"):
        read_labelled_clip(drawn.held_out, tmp_path, drawn.aam.rows)


@pytest.mark.parametrize("frame", [0, 500])
def test_a_start_outside_is_refused(drawn, frame):
    points = drawn.points(drawn.held_out)[0] + (0 if frame else 500)
    with pytest.raises(InputError, match="the start lies outside"):
        track_clip(drawn.aam, drawn.held_out, Start(frame, points))
