from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmmgpu import aam_evaluation
from mmmgpu.aam_evaluation import evaluate_aam
from mmmgpu.errors import InputError


@pytest.fixture(scope="module")
def judged(drawn):
    return evaluate_aam(drawn.aam, [drawn.held_out], drawn.folder)


def test_a_drawn_face_is_shown_and_found(judged, drawn):
    assert judged["clips"] == [drawn.held_out.name]
    assert judged["frames"] == len(drawn.points(drawn.held_out))
    assert judged["psnr_db"]["mean"] > 36
    assert 25 < judged["psnr_of_worst_frame_db"] <= judged["psnr_db"]["mean"]
    assert 0 < judged["points_of_features_px"] < 0.5
    assert judged["within_1_px"] >= 0.95
    assert judged["converged"] >= judged["within_1_px"]
    fit = judged["fit_px"]
    assert 0 < fit["median"] <= fit["95_percent_within"] <= fit["worst"]


def test_the_jitter_is_what_landmarks_move_by(judged, drawn):
    points = drawn.points(drawn.held_out)
    moved = np.sqrt((np.diff(points, axis=0) ** 2).sum(axis=2).mean(axis=1))
    assert_allclose(judged["landmark_jitter_px"], np.median(moved))


def test_starts_are_so_far_away_in_all_directions():
    steps = aam_evaluation._directions(400, 5.0, np.random.default_rng(0))
    assert_allclose(np.linalg.norm(steps, axis=1), 5)
    assert np.abs(steps.mean(axis=0)).max() < 0.6


def test_faces_that_are_too_far_are_not_found(drawn, judged):
    lost = evaluate_aam(drawn.aam, [drawn.held_out], drawn.folder, away=40.0)
    assert lost["converged"] < 0.5
    assert lost["fit_px"]["median"] > 5
    assert lost["psnr_db"] == judged["psnr_db"]


def test_fewer_features_show_less(drawn, judged):
    few = replace(
        drawn.aam,
        modes_of_shape=drawn.aam.modes_of_shape[:2],
        modes_of_texture=drawn.aam.modes_of_texture[:2],
        variance=drawn.aam.variance[:2],
    )
    found = evaluate_aam(few, [drawn.held_out], drawn.folder)
    assert found["psnr_db"]["mean"] < judged["psnr_db"]["mean"] - 3
    assert found["points_of_features_px"] > judged["points_of_features_px"]


def test_several_clips_have_an_interval(drawn):
    found = evaluate_aam(drawn.aam, [drawn.held_out, drawn.clips[0]], drawn.folder)
    assert found["psnr_db"]["half_width_95"] > 0
    assert found["frames"] == sum(len(drawn.points(c)) for c in (drawn.held_out, drawn.clips[0]))


def test_no_clip_is_an_error(drawn):
    with pytest.raises(InputError, match="no clip given"):
        evaluate_aam(drawn.aam, [], drawn.folder)
