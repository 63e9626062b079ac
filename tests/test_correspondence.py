"""Dense correspondence: against SciPy, loops and differences, and its inverse against itself."""

import numpy as np
import oracles_kernels as oracles
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.interpolate import RBFInterpolator

from mmmgpu import operations, performer
from mmmgpu.alignments import Segment
from mmmgpu.correspondence import DEFAULT_C, Correspondence, rbf_correspondence
from mmmgpu.errors import InputError

MARKED = [*range(0, 20, 2), 23, 25, 27, 33, 35, 37, *range(42, 60, 3), 50]  # lips and jaw
MARKED += [61, 64, 66, 68, 69, 70, 73, 87, 88, 91, 92, 93, 94, 97, 98]  # nose and cheeks
TRIANGLE = [[10, 10], [90, 20], [30, 80]]


def marks(seed=0, number=38, *, noise=3.0, width=256):
    """Points scattered in one picture, and their places in a larger, turned one."""
    rng = np.random.default_rng(seed)
    cells = rng.permutation(49)[:number]
    a = (np.stack([cells % 7, cells // 7], axis=1) + rng.uniform(0.2, 0.8, (number, 2))) * width / 7
    b = a @ [[1.4, -0.1], [0.1, 1.3]] + [20, -7] + rng.normal(0, noise, (number, 2))
    return a, b


def pixels(width, height):
    y, x = np.mgrid[:height, :width]
    return np.stack([x, y], axis=-1)


def distance(p, q):
    return np.hypot(*np.moveaxis(np.asarray(p) - q, -1, 0))


@pytest.mark.parametrize("c", [0.3, 0.5, 1, DEFAULT_C, 10])
@pytest.mark.parametrize("number", [3, 4, 38])
@pytest.mark.parametrize("width", [30, 256, 4000])
def test_exact_at_the_points(width, number, c):
    a, b = marks(number=number, width=width)
    assert_allclose(rbf_correspondence(a, b, c=c)(a), b, rtol=0, atol=1e-6)


@pytest.mark.parametrize("c", [0.5, 1, DEFAULT_C, 10])
@pytest.mark.parametrize("number", [3, 4, 38])
def test_equal_to_scipy_everywhere(number, c):
    a, b = marks(number=number)
    s = rbf_correspondence(a, b, c=c)
    width = np.sqrt(c) / s.spacing
    peer = RBFInterpolator(a, b, kernel="gaussian", epsilon=width, degree=1)
    p = np.random.default_rng(1).uniform(-50, 300, (500, 2))
    assert_allclose(s(p), peer(p), rtol=0, atol=1e-8)


@pytest.mark.parametrize("smoothing", [0.1, 8.0, 100])
def test_smoothed_it_is_scipy_s_smoothed_one(smoothing):
    a, b = marks()
    s = rbf_correspondence(a, b, smoothing=smoothing)
    width = np.sqrt(DEFAULT_C) / s.spacing
    options = {"kernel": "gaussian", "epsilon": width, "degree": 1}
    peer = RBFInterpolator(a, b, smoothing=smoothing, **options)
    p = np.random.default_rng(1).uniform(-50, 300, (500, 2))
    assert_allclose(s(p), peer(p), rtol=0, atol=1e-6)
    assert np.abs(s(a) - b).max() > 0.01


@pytest.mark.parametrize("smoothing", [-1, np.nan, 101])
def test_a_smoothing_that_makes_no_map(smoothing):
    with pytest.raises(InputError, match=f"^smoothing must be between 0 and 100, got {smoothing}"):
        rbf_correspondence(*marks(), smoothing=smoothing)


def test_equal_to_the_sum_term_by_term():
    s = rbf_correspondence(*marks())
    p = np.random.default_rng(1).uniform(-50, 300, (50, 2))
    desired = oracles.evaluate_rbf(p, s.centres, s.weights, s.affine, s.c / s.spacing**2)
    assert_allclose(s(p), desired, rtol=0, atol=1e-9)


def test_the_operation_is_the_same_map(backend):
    s = rbf_correspondence(*marks())
    p = pixels(256, 100)
    given = s.centres, s.weights, s.affine, s.sharpness
    actual = operations.evaluate_rbf(p, *given, backend=backend)
    assert_allclose(actual, s(p), rtol=0, atol=2e-3)


def test_spacing_is_the_mean_distance_to_the_nearest_other_point():
    a = np.array([[0, 0], [3, 0], [0, 4], [30, 40]])
    s = rbf_correspondence(a, a, c=2)
    nearest = [3, 3, 4, np.hypot(27, 40) if np.hypot(27, 40) < np.hypot(30, 36) else 0]
    nearest[3] = min(distance(a[:3], a[3]))
    assert_allclose(s.spacing, np.mean(nearest), rtol=1e-12)
    assert_allclose(s.sharpness, 2 / s.spacing**2, rtol=1e-12)


def test_the_usual_sharpness():
    assert rbf_correspondence(*marks()).c == DEFAULT_C


def test_an_affine_map_of_the_points_needs_no_gaussians():
    s = rbf_correspondence(*marks(noise=0))
    assert_allclose(s.weights, 0, rtol=0, atol=1e-9)
    assert_allclose(s.affine, [[20, 1.4, 0.1], [-7, -0.1, 1.3]], rtol=0, atol=1e-9)


def test_the_side_conditions_hold():
    s = rbf_correspondence(*marks())
    assert np.abs(s.weights).max() > 1
    assert_allclose(s.weights.sum(axis=0), 0, rtol=0, atol=1e-9)
    assert_allclose(s.weights.T @ s.centres, 0, rtol=0, atol=1e-8)


@pytest.mark.parametrize("c", [0.5, DEFAULT_C])
def test_the_jacobian_is_that_of_central_differences(c):
    s = rbf_correspondence(*marks(), c=c)
    p = np.random.default_rng(1).uniform(0, 256, (200, 2))
    for j, step in enumerate(1e-4 * np.eye(2)):
        slope = (s(p + step) - s(p - step)) / 2e-4
        assert_allclose(s.jacobian(p)[..., j], slope, rtol=0, atol=1e-7)


@pytest.mark.parametrize("shape", [(2,), (0, 2), (5, 2), (3, 4, 2)])
def test_points_of_any_shape(shape):
    s = rbf_correspondence(*marks())
    p = np.random.default_rng(1).uniform(0, 256, shape)
    assert s(p).shape == s.inverse(p).shape == shape
    assert s.jacobian(p).shape == (*shape, 2)
    for i in np.ndindex(shape[:-1]):
        assert_allclose(s(p)[i], s(p[i]), rtol=0, atol=1e-9)


def test_more_points_than_are_done_at_a_time():
    s = rbf_correspondence(*marks())
    p = pixels(200, 100)
    assert_allclose(s(p)[90:], s(p[90:]), rtol=0, atol=1e-9)
    assert_allclose(s.jacobian(p)[90:], s.jacobian(p[90:]), rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_the_inverse_of_a_map_that_does_not_fold(seed):
    s = rbf_correspondence(*marks(seed))
    assert not s.folds(256, 256).any()
    p = pixels(256, 256)[::3, ::3]
    q = s(p)
    assert_allclose(s(s.inverse(q)), q, rtol=0, atol=1e-6)
    assert_allclose(s.inverse(q), p, rtol=0, atol=1e-6)


@pytest.mark.parametrize("noise", [15, 20])
def test_the_inverse_finds_a_point_where_the_map_folds(noise):
    s = rbf_correspondence(*marks(noise=noise))
    assert s.folds(256, 256).any()
    q = s(pixels(256, 256)[::3, ::3])
    assert_allclose(s(s.inverse(q)), q, rtol=0, atol=1e-6)


@pytest.mark.parametrize("spacing", [5.0, 70.0])
def test_what_has_no_inverse_gets_the_nearest_that_was_met(spacing):
    """All of A lands between (0, 0) and (5, 0): the best that there is for (9, 3) is (5, 0)."""
    one = np.array([[5.0, 0], [0, 0], [0, 0]])
    s = Correspondence(np.array(TRIANGLE, float), one, np.zeros((2, 3)), 2.0, spacing)
    p = s.inverse([[9, 3], [4.9, 0]])
    assert_allclose(p[0], TRIANGLE[0], rtol=0, atol=1)
    assert_allclose(s(p), [[5, 0], [4.9, 0]], rtol=0, atol=1e-3)


def test_folds_are_where_the_map_turns_over():
    """Two points that change places turn the picture over between them, and only there."""
    a = np.array([[0, 0], [100, 0], [0, 60], [100, 60], [45, 30], [55, 30]], float)
    b = a[[0, 1, 2, 3, 5, 4]]
    s = rbf_correspondence(a, b)
    folds = s.folds(101, 61)
    assert folds.shape == (61, 101)
    assert folds[30, 50]
    assert not folds[[0, 0, 60, 60], [0, 100, 0, 100]].any()
    assert_array_equal(folds, np.linalg.det(s.jacobian(pixels(101, 61))) <= 0)


def test_identity_folds_nowhere_and_a_mirror_everywhere():
    a, _ = marks()
    assert not rbf_correspondence(a, a).folds(9, 5).any()
    assert rbf_correspondence(a, a * [-1, 1]).folds(9, 5).all()


@pytest.mark.parametrize("sound", ["SIL", "AA"])
def test_lip_points_of_another_person_that_nobody_marked(sound):
    """Between the marked points the map is right to a fraction of a pixel."""
    faces = []
    for seed in (0, 1):
        person = performer.performer(seed)
        spoken = [Segment(sound, 0.0, 1.0)]
        posture = performer.articulate(person, spoken, 25, 25.0, np.random.default_rng(0))
        faces.append(performer.landmarks(person, posture, 12))
    closed = distance(*(f for f in faces[0][[25, 35]])) < 3
    marked = [k for k in MARKED if not (closed and 31 <= k <= 39)]  # where lips touch, one seam
    rest = np.setdiff1d(np.arange(31 if closed else 40), marked)
    a, b = faces
    s = rbf_correspondence(a[marked], b[marked])
    assert distance(s(a[rest]), b[rest]).mean() < 0.7
    assert not s.folds(256, 256)[140:220, 70:190].any()


@pytest.mark.parametrize(
    ("points_a", "points_b", "message"),
    [
        (TRIANGLE[:2], TRIANGLE[:2], "points_a has 2 points; at least 3 are needed"),
        (TRIANGLE, TRIANGLE[:2], "points_b has 2 points; at least 3 are needed"),
        (marks()[0], TRIANGLE, "points_a has 38 points and points_b 3: every point needs"),
        (np.ones(6), TRIANGLE, r"points_a must have shape \(N, 2\), .* got \(6,\)"),
        (TRIANGLE, np.ones((3, 3)), r"points_b must have shape \(N, 2\), .* got \(3, 3\)"),
        (TRIANGLE, [[1, 2], [3], [4, 5]], "points_b must be an array of numbers"),
        ([["a", "b"]] * 3, TRIANGLE, "points_a must be an array of numbers"),
        ([*TRIANGLE, [1, np.nan]], TRIANGLE, r"points_a\[3\] is not finite: \[1.0, nan\]"),
        (TRIANGLE, [[np.inf, 0], *TRIANGLE], r"points_b\[0\] is not finite"),
        ([*TRIANGLE, TRIANGLE[1]], [*TRIANGLE, [0, 0]], r"points_a\[1\] and points_a\[3\] are at"),
        (
            [*TRIANGLE, [0, 0]],
            [*TRIANGLE, TRIANGLE[2]],
            r"points_b\[2\] .*\(30.00, 80.00\); remove",
        ),
        ([[0, 0], [50, 50], [90, 90]], TRIANGLE, "points_a lie on one line; add points beside it"),
        (TRIANGLE, [[0, 0], [0, 50], [0.1, 90]], "points_b lie on one line"),
    ],
)
def test_points_that_make_no_map(points_a, points_b, message):
    with pytest.raises(InputError, match=f"^{message}"):
        rbf_correspondence(points_a, points_b)


@pytest.mark.parametrize("c", [0, -1, np.nan, np.inf])
def test_a_sharpness_that_makes_no_gaussians(c):
    with pytest.raises(InputError, match=f"^c must be a finite number above 0, got {c}; leave"):
        rbf_correspondence(*marks(), c=c)


def test_gaussians_too_wide_for_the_points():
    with pytest.raises(InputError, match=r"^c = 0.01 leaves .* ill-conditioned \(.e\+.*; give"):
        rbf_correspondence(*marks(), c=0.01)


def test_points_that_nearly_coincide():
    a, b = marks()
    a = np.append(a, [a[5] + [0.02, 0]], axis=0)
    b = np.append(b, [b[5] + [9, 0]], axis=0)
    with pytest.raises(InputError, match=r"remove points_a\[5\] or \[38\], .* 0.02 px apart$"):
        rbf_correspondence(a, b)


def test_inputs_are_unchanged_and_not_kept():
    a, b = marks()
    s = rbf_correspondence(a, b)
    a += 5
    assert_allclose(s(a - 5), b, rtol=0, atol=1e-6)
