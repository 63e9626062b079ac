from dataclasses import replace

import numpy as np
import oracles_model as oracles
import pytest
from worlds import make_model

from mmmgpu.dynamics import trajectory
from mmmgpu.errors import InputError
from mmmgpu.models import labels_known, moved_by, project_on_simplex, trajectories
from mmmgpu.phones import stand_in
from mmmgpu.trajectories import synthesize_trajectory


@pytest.fixture(scope="module")
def model(basis):
    return make_model(basis)


@pytest.mark.parametrize("seed", range(4))
def test_the_projection_is_the_nearest_point_of_the_simplex(seed):
    rng = np.random.default_rng(seed)
    beta = rng.normal(0.2, 0.5, (6, 5))
    got = project_on_simplex(beta)
    for row, point in zip(beta, got, strict=True):
        np.testing.assert_allclose(point, oracles.solve_simplex(np.eye(5), row), atol=1e-9)


def test_points_of_the_simplex_stay():
    beta = np.random.default_rng(0).dirichlet(np.ones(7), 4)
    np.testing.assert_allclose(project_on_simplex(beta), beta, atol=1e-12)
    far = project_on_simplex(np.array([[1e6, 0.0, -1e6], [0.0, 0.0, 0.0]]))
    np.testing.assert_allclose(far, [[1, 0, 0], [1 / 3] * 3], atol=1e-9)
    assert project_on_simplex(np.zeros((0, 3))).shape == (0, 3)


@pytest.mark.parametrize("kind", ["trained", "pooled", "other"])
def test_both_streams_follow_the_phones(model, kind):
    other = [m.mean + 0.1 for m in (model.alpha.trained, model.beta.trained)]
    model = replace(model, alternatives={"other": tuple(other)})
    labels = ["SIL"] * 6 + ["AA"] * 5 + ["M"] * 4
    alpha, beta = trajectories(model, labels, kind=kind)
    assert alpha.shape == (15, 4)
    assert beta.shape == (15, 5)
    for got, stream, mean in zip((alpha, beta), (model.alpha, model.beta), other, strict=True):
        models = stream.pooled if kind == "pooled" else stream.trained
        if kind == "other":
            models = replace(models, mean=mean)
        wanted = synthesize_trajectory(
            models, labels, smoothness=stream.smoothness, order=stream.constants.order
        )
        np.testing.assert_array_equal(got, wanted)


def test_training_makes_a_difference(model):
    labels = ["SIL", "AA", "AA", "M", "SIL"]
    for trained, pooled in zip(
        trajectories(model, labels), trajectories(model, labels, kind="pooled"), strict=True
    ):
        assert np.abs(trained - pooled).max() > 1e-3


def test_a_phone_without_model_gets_its_stand_in(model):
    known = {"AA", "M", "SIL"}
    other = stand_in("P", known)
    got = trajectories(model, ["SIL", "P", "SIL"])
    wanted = trajectories(model, ["SIL", other, "SIL"])
    for a, b in zip(got, wanted, strict=True):
        np.testing.assert_array_equal(a, b)


def test_movement_is_that_of_the_model_named(model):
    labels = ["SIL", "AA", "AA", "M"]
    for got, want in zip(
        moved_by(model, labels, "egp02"), trajectories(model, labels), strict=True
    ):
        np.testing.assert_array_equal(got, want)
    for name, pair in model.dynamics.items():
        for got, own in zip(moved_by(model, labels, name), pair, strict=True):
            np.testing.assert_array_equal(got, trajectory(own, labels))
        for got, own in zip(moved_by(model, ["B", "no phone"], name), pair, strict=True):
            np.testing.assert_array_equal(got, trajectory(own, ["M", "AA"]))


def test_a_movement_that_the_model_lacks_is_said(model):
    old = replace(model, dynamics={})
    assert labels_known(old, "egp02") == model.alpha.trained.labels
    says = r"trajectory 'dpds': the model has only egp02; use one of them or train it again"
    with pytest.raises(InputError, match=says):
        moved_by(old, ["AA"], "dpds")
    with pytest.raises(InputError, match="has only egp02, brand, dpds, hmm, slds"):
        labels_known(model, "nn")


def test_no_phone_no_frame(model):
    alpha, beta = trajectories(model, [])
    assert alpha.shape == (0, 4)
    assert beta.shape == (0, 5)


def test_the_frame_size_is_width_and_height(model):
    assert model.frame_size == (60, 50)


def test_a_model_saves_itself(model, tmp_path):
    from mmmgpu import load

    model.save(tmp_path / "person ü.mmm")
    assert load(tmp_path / "person ü.mmm").sources == model.sources
    with pytest.raises(InputError, match="nowhere"):
        model.save(tmp_path / "nowhere" / "a.mmm")
