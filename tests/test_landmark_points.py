import numpy as np
import pytest

from mmmgpu.errors import InputError
from mmmgpu.landmark_points import points_from_landmarks
from mmmgpu.marking import LANDMARK_ROWS, NAMES
from mmmgpu.points import check_frames, write_points
from mmmgpu.reference_pairs import ShownFrame

PICTURE = np.zeros((100, 120, 3), np.uint8)


def spread_landmarks(rng):
    """103 points of one frame that lie apart, (1, 103, 2)."""
    grid = np.stack(np.meshgrid(np.arange(11) * 9.0 + 8, np.arange(10) * 9.0 + 6), axis=-1)
    return grid.reshape(-1, 2)[rng.permutation(110)[:103]][None]


@pytest.fixture
def persons(tmp_path):
    """Frame 3 of one clip of each person, and the folders with their landmarks."""
    rng, shown, folders, truth = np.random.default_rng(0), [], [], []
    for name in ("a", "b"):
        folder = tmp_path / name
        folder.mkdir()
        points = np.concatenate([spread_landmarks(rng) for _ in range(4)])
        np.savez(folder / f"{name}.npz", points=points.astype(np.float32))
        shown.append({"closed": ShownFrame(f"{name}.mp4", 3, PICTURE, (60.0, 50.0, 30.0))})
        folders.append(folder)
        truth.append(points[3])
    return shown, folders, truth


def test_they_are_the_named_landmarks_of_the_frames(persons, tmp_path):
    shown, folders, truth = persons
    (pair,) = points_from_landmarks(*shown, *folders)
    assert (pair.kind, pair.names) == ("closed", NAMES)
    rows = list(LANDMARK_ROWS)
    np.testing.assert_allclose(pair.points_a, truth[0][rows], rtol=1e-6)
    np.testing.assert_allclose(pair.points_b, truth[1][rows], rtol=1e-6)
    assert (pair.a.clip, pair.a.frame, pair.a.size) == ("a.mp4", 3, (120, 100))
    write_points(tmp_path / "p.json", [pair])  # they can be saved
    check_frames([pair], {"closed": (PICTURE, PICTURE)}, tmp_path / "p.json")


@pytest.mark.parametrize("person", [0, 1])
def test_what_lies_outside_or_on_another_point_is_left_out(persons, person):
    shown, folders, truth = persons
    points = np.repeat(truth[person][None], 4, axis=0)
    points[3, LANDMARK_ROWS[4]] = (-1, 50)
    points[3, LANDMARK_ROWS[7]] = points[3, LANDMARK_ROWS[6]] + (0.6, 0.6)
    np.savez(folders[person] / f"{'ab'[person]}.npz", points=points)
    (pair,) = points_from_landmarks(*shown, *folders)
    assert set(NAMES) - set(pair.names) == {NAMES[4], NAMES[7]}
    assert len(pair.points_a) == len(pair.points_b) == len(NAMES) - 2


@pytest.mark.parametrize("frames", [slice(0, 3), slice(0, 0)])
def test_landmarks_that_end_before_the_frame_are_refused(persons, frames):
    shown, folders, truth = persons
    points = np.repeat(truth[1][None], 4, axis=0)[frames]
    np.savez(folders[1] / "b.npz", points=points)
    with pytest.raises(InputError, match=r"b\.mp4 must reach frame 3 .*mark the points by hand"):
        points_from_landmarks(*shown, *folders)
