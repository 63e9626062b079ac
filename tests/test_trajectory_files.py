from fractions import Fraction

import numpy as np
import pytest

from mmmgpu.errors import InputError
from mmmgpu.trajectory_files import Trajectory, read_trajectory, write_trajectory

FPS = Fraction(30000, 1001)
HEADER = "time,phone,alpha0,alpha1,beta0,beta1,beta2\n"
GOOD = "0.0000,SIL,0.5,-1,0.2,0.3,0.5\n"


def make_trajectory(frames=7, prototypes=3, seed=0):
    rng = np.random.default_rng(seed)
    labels = tuple(rng.choice(["SIL", "AA", 'odd, "label"'], frames))
    alpha = rng.normal(size=(frames, prototypes - 1)) * 10.0 ** rng.integers(-5, 3)
    return Trajectory(labels, alpha, rng.dirichlet(np.ones(prototypes), frames), FPS)


@pytest.mark.parametrize("seed", range(4))
def test_a_trajectory_comes_back(tmp_path, seed):
    path = tmp_path / "t.csv"
    trajectory = make_trajectory(seed=seed)
    write_trajectory(trajectory, path)
    again = read_trajectory(path, 3, FPS)
    assert again.labels == trajectory.labels
    assert again.fps == FPS
    assert len(again) == 7
    np.testing.assert_allclose(again.alpha, trajectory.alpha, rtol=1e-5)
    np.testing.assert_allclose(again.beta, trajectory.beta, rtol=2e-5, atol=1e-9)
    np.testing.assert_allclose(again.beta.sum(axis=1), 1, rtol=1e-12)


def test_the_file_is_a_table(tmp_path):
    path = tmp_path / "t.csv"
    trajectory = Trajectory(
        ("SIL", "AA"), np.array([[0.5, -1.0], [0, 2]]), np.eye(3)[:2], Fraction(25)
    )
    write_trajectory(trajectory, path)
    assert path.read_text() == HEADER + "0.0000,SIL,0.5,-1,1,0,0\n0.0400,AA,0,2,0,1,0\n"


def test_one_prototype_has_no_alpha(tmp_path):
    path = tmp_path / "t.csv"
    write_trajectory(make_trajectory(prototypes=1), path)
    assert read_trajectory(path, 1, FPS).alpha.shape == (7, 0)


def test_beta_is_scaled_to_sum_to_1(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text(HEADER + "0,AA,0,0,2,1,1\n")
    np.testing.assert_allclose(read_trajectory(path, 3, FPS).beta, [[0.5, 0.25, 0.25]])


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        (HEADER + GOOD + "0,AA,1,2,0.2,0.8\n", 3, "6 columns, this model needs 7"),
        (HEADER + GOOD + "0,AA,1,2,0.2,0.8,0,0\n", 3, "8 columns"),
        (HEADER + GOOD + GOOD + "\n", 4, "0 columns"),
        (HEADER + "0,AA,1,much,0.2,0.8,0\n", 2, "much"),
        (HEADER + "0,AA,1,,0.2,0.8,0\n", 2, "correct the row"),
        (HEADER + GOOD + "0,AA,nan,1,0.2,0.8,0\n", 3, "NaN or infinity"),
        (HEADER + GOOD + "0,AA,1,1,0.2,inf,0\n", 3, "NaN or infinity"),
        (HEADER + GOOD + "0,AA,1,1,1.2,-0.2,0\n", 3, "beta must be >= 0"),
        (HEADER + GOOD + GOOD + "0,AA,1,1,0,0,0\n", 4, "not all 0"),
    ],
)
def test_a_bad_row_is_named(tmp_path, text, line, says):
    path = tmp_path / "t.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=says) as caught:
        read_trajectory(path, 3, FPS)
    assert str(caught.value).startswith(f"{path}:{line}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("data", [b"", HEADER.encode(), b"\xff\xfe\x00\x81", None])
def test_a_file_without_frames_is_named(tmp_path, data):
    path = tmp_path / "t.csv"
    if data is not None:
        path.write_bytes(data)
    with pytest.raises(InputError) as caught:
        read_trajectory(path, 3, FPS)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_folder_is_no_trajectory(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_trajectory(tmp_path, 3, FPS)
