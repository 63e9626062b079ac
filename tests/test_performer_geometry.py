import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from mmmgpu import performer_geometry as g
from mmmgpu.performer import ARTICULATORS, performer

SHAPE = performer(5).shape


def mouths(count=12):
    rng = np.random.default_rng(0)
    for values in rng.random((count, len(ARTICULATORS))):
        yield g.pucker(SHAPE, dict(zip(ARTICULATORS, values, strict=True)))


@pytest.mark.parametrize("p", list(mouths()))
def test_squeezing_is_undone(p):
    rng = np.random.default_rng(1)
    x, v = rng.uniform(-0.7, 0.7, 500), rng.uniform(0.1, 0.9, 500)
    u = g.squeeze(SHAPE, p, x, v)
    np.testing.assert_allclose(g.unsqueeze(SHAPE, p, u, v), x, rtol=0, atol=1e-10)


@pytest.mark.parametrize("p", list(mouths()))
def test_the_vertical_map_is_monotone_and_undone(p):
    x = np.linspace(-0.6, 0.6, 121)
    c = g.columns(SHAPE, p, x)
    for upper in (True, False):
        side = np.full(x.shape, upper)
        first, last = (0.2, c.upper_lip()) if upper else (c.lower_lip(), 1.2)
        y = first + (last - first) * np.linspace(0, 1, 60)[:, None]
        v = g.to_neutral(c, y, side)
        assert np.diff(v, axis=0).min() > 0
        again = np.stack([g.from_neutral(c, row, side) for row in v])
        np.testing.assert_allclose(again, np.broadcast_to(y, v.shape), rtol=0, atol=1e-7)


@pytest.mark.parametrize("p", list(mouths()))
def test_the_lips_open_between_the_corners_only(p):
    x = np.linspace(-0.5, 0.5, 201)
    c = g.columns(SHAPE, p, x)
    gap = c.lower_lip() - c.upper_lip()
    assert gap.min() >= 0
    np.testing.assert_array_equal(gap[np.abs(x) >= p.half_width], 0)
    seam = g.seam(SHAPE, g.squeeze(SHAPE, p, x, np.full_like(x, SHAPE.mouth)))
    np.testing.assert_allclose(
        g.to_neutral(c, c.upper_lip(), np.ones(201, bool)), seam, rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(
        g.to_neutral(c, c.lower_lip(), np.zeros(201, bool)), seam, rtol=0, atol=1e-12
    )


def test_the_vertical_map_is_the_spline_through_its_knots():
    """Oracle: SciPy's Hermite spline with the same slopes, one column at a time."""
    rng = np.random.default_rng(2)
    knots = np.cumsum(rng.uniform(0.05, 0.4, (4, 7)), axis=0)
    values = np.cumsum(rng.uniform(0.05, 0.4, (4, 7)), axis=0)
    y = rng.uniform(knots[0], knots[-1], (50, 7))
    got = g._monotone(y, knots, values)
    for k in range(7):
        secant = np.diff(values[:, k]) / np.diff(knots[:, k])
        inner = 2 / (1 / secant[1:] + 1 / secant[:-1])
        slopes = [min(1, 3 * secant[0]), *inner, min(1, 3 * secant[-1])]
        want = CubicHermiteSpline(knots[:, k], values[:, k], slopes)(y[:, k])
        np.testing.assert_allclose(got[:, k], want, rtol=0, atol=1e-12)


def test_rest_moves_nothing():
    rest = dict.fromkeys(ARTICULATORS, 0.0) | {"width": 0.5}
    p = g.pucker(SHAPE, rest)
    x = np.linspace(-0.5, 0.5, 51)
    c = g.columns(SHAPE, p, x)
    y = np.linspace(0.3, 1.0, 40)[:, None]
    v = g.to_neutral(c, y, y < c.upper_lip())
    np.testing.assert_allclose(v, np.broadcast_to(y, v.shape), rtol=0, atol=1e-9)
    np.testing.assert_allclose(g.squeeze(SHAPE, p, x, x + 0.5), x, rtol=0, atol=1e-12)


def test_the_pose_is_undone_and_leaves_the_shoulders():
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-1, 1, 400), rng.uniform(-0.95, 1.1, 400)
    pose = np.array([0.03, -0.02, 0.05, 0.02])
    hx, hy = g.undo_pose(pose, x, y)
    bx, by = g.apply_pose(pose, hx, hy)
    np.testing.assert_allclose(np.stack([bx, by]), np.stack([x, y]), rtol=0, atol=1e-9)
    corner = np.array([0.9]), np.array([1.1])
    np.testing.assert_array_equal(np.stack(g.undo_pose(pose, *corner)), np.stack(corner))
