from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from test_reconstruction import make_person, write_clip
from worlds import POSTURES, hold, make_model

from mmmgpu.alignments import Alignment, Segment, cover
from mmmgpu.errors import InputError
from mmmgpu.models import moved_by, project_on_simplex, trajectories
from mmmgpu.sounds import read_sound
from mmmgpu.speaking import FAINT, FOCUS, at_rate, focused, plan, render, silent_mouth, speak
from mmmgpu.trajectory_files import Trajectory
from mmmgpu.videos import probe, read_frames
from mmmgpu.voices import Speech

SAID = (Segment("SIL", 0, 0.1), Segment("AA", 0.1, 0.25), Segment("M", 0.25, 0.3))
ALIGNMENT = Alignment(SAID, (), 0.3)
FPS = 30  # of the background; the model has 25


@pytest.fixture(scope="module")
def person(face_and_basis, tmp_path_factory):
    """A model whose calm clip has three frames at `FPS`."""
    face = face_and_basis[0]
    clip = tmp_path_factory.mktemp("calm") / "calm.mkv"
    write_clip(clip, face, hold(*POSTURES[:1] * 3), fps=FPS)
    return make_person(face_and_basis, clip)


@pytest.fixture(scope="module")
def speech():
    samples = 0.2 * np.random.default_rng(0).standard_normal(round(0.3 * 16000))
    return Speech(samples.astype(np.float32), 16000, ALIGNMENT)


# ---- planning -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fps", "duration", "frames"),
    [
        (25, 0.3, 8),
        (25, 0.32, 8),
        (25, 0.321, 9),
        (Fraction(30000, 1001), 1.001, 30),
        (25, 1e-3, 1),
    ],
)
def test_a_plan_is_as_long_as_what_is_said(basis, fps, duration, frames):
    model = replace(make_model(basis), fps=Fraction(fps))
    planned = plan(model, Alignment((Segment("AA", 0, duration),), (), duration))
    assert len(planned) == frames
    assert planned.alpha.shape == (frames, 4)
    assert planned.beta.shape == (frames, 5)
    assert set(planned.labels[: int(duration * fps)]) <= {"AA"}
    assert planned.fps == fps


@pytest.mark.parametrize("articulation", [0.5, 1.0, 1.5])
def test_beta_keeps_to_the_simplex_and_to_its_strongest_textures(basis, articulation):
    model = replace(make_model(basis), fps=Fraction(25))
    planned = plan(model, ALIGNMENT, articulation=articulation)
    assert planned.labels == ("SIL",) * 3 + ("AA",) * 3 + ("M",) * 2
    np.testing.assert_allclose(planned.beta.sum(axis=1), 1, atol=1e-12)
    assert (planned.beta >= 0).all()
    alpha, beta = trajectories(model, planned.labels)
    silent = silent_mouth(model)
    np.testing.assert_allclose(
        planned.alpha, silent[0] + articulation * (alpha - silent[0]), atol=1e-12
    )
    near = project_on_simplex(silent[1] + articulation * (beta - silent[1]))
    kept = [[max((b / max(row)) ** FOCUS - FAINT, 0) for b in row] for row in near]
    assert 0 < np.mean(planned.beta == 0) < 1
    assert (planned.beta.max(axis=1) >= near.max(axis=1)).all()
    np.testing.assert_allclose(planned.beta, [np.array(r) / sum(r) for r in kept], atol=1e-12)


@pytest.mark.parametrize("movement", ["hmm", "brand", "slds", "dpds"])
def test_other_movements_are_planned_alike(basis, movement):
    model = replace(make_model(basis), fps=Fraction(25))
    planned = plan(model, ALIGNMENT, movement=movement)
    alpha, beta = moved_by(model, planned.labels, movement)
    np.testing.assert_array_equal(planned.alpha, alpha)
    np.testing.assert_array_equal(planned.beta, focused(project_on_simplex(beta)))
    assert (planned.alpha != plan(model, ALIGNMENT).alpha).any()


def test_many_equal_textures_are_all_kept(basis):
    """A model may have more prototypes than one over the share that goes."""
    many = replace(
        basis, images=np.repeat(basis.images, 12, axis=0), flows=np.repeat(basis.flows, 12, axis=0)
    )
    model = make_model(many)
    equal = replace(model.beta.trained, mean=np.full_like(model.beta.trained.mean, 1 / 60))
    model = replace(model, beta=replace(model.beta, trained=equal))
    np.testing.assert_allclose(plan(model, ALIGNMENT).beta, 1 / 60, atol=1e-9)


def test_articulation_1_is_the_default(basis):
    model = make_model(basis)
    one, default = plan(model, ALIGNMENT, articulation=1), plan(model, ALIGNMENT)
    np.testing.assert_array_equal(one.alpha, default.alpha)
    np.testing.assert_array_equal(one.beta, default.beta)
    np.testing.assert_array_equal(default.alpha, trajectories(model, default.labels)[0])


@pytest.mark.parametrize("articulation", [0.49, 1.51, -1.0, float("nan"), float("inf")])
def test_other_articulation_is_refused(basis, articulation):
    with pytest.raises(InputError, match=r"between 0\.5 and 1\.5"):
        plan(make_model(basis), ALIGNMENT, articulation=articulation)


def test_the_silent_mouth_is_that_of_silence(basis):
    model = make_model(basis)
    row = model.alpha.trained.labels.index("SIL")
    alpha, beta = silent_mouth(model)
    np.testing.assert_array_equal(alpha, model.alpha.trained.mean[row])
    np.testing.assert_array_equal(beta, model.beta.trained.mean[row])


def test_without_silence_it_is_the_reference(basis):
    model = make_model(basis)
    deaf = replace(model.alpha.trained, labels=("AA", "M", "UW"))
    alpha, beta = silent_mouth(replace(model, alpha=replace(model.alpha, trained=deaf)))
    np.testing.assert_array_equal(alpha, np.zeros(4))
    np.testing.assert_array_equal(beta, np.eye(5)[basis.reference])


# ---- frame rates ----------------------------------------------------------------------------


def ramp(frames, fps, labels=None):
    """A trajectory linear in time, whatever the rate: alpha = t, beta = (1 - t, t) / 2 [s]."""
    time = (np.arange(frames) + 0.5) / float(fps)
    beta = np.stack([1 - time / 2, time / 2], axis=1)
    return Trajectory(labels or ("AA",) * frames, time[:, None], beta, Fraction(fps))


def test_the_same_rate_changes_nothing(basis):
    trajectory = ramp(9, 25)
    assert at_rate(trajectory, Fraction(25)) is trajectory


@pytest.mark.parametrize(
    ("old", "new", "frames"), [(25, 50, 40), (30, 25, 17), (Fraction(30000, 1001), 25, 17)]
)
def test_a_ramp_stays_a_ramp(old, new, frames):
    slow = ramp(20, old)
    got = at_rate(slow, Fraction(new))
    wanted = ramp(frames, new)
    assert len(got) == len(got.labels) == frames
    assert got.fps == new
    inside = (wanted.alpha[:, 0] >= slow.alpha[0]) & (wanted.alpha[:, 0] <= slow.alpha[-1])
    assert inside.sum() >= frames - 2
    np.testing.assert_allclose(got.alpha[inside], wanted.alpha[inside], atol=1e-12)
    np.testing.assert_allclose(got.beta[inside], wanted.beta[inside], atol=1e-12)
    np.testing.assert_allclose(got.beta.sum(axis=1), 1, atol=1e-12)
    assert slow.alpha.min() <= got.alpha.min() <= got.alpha.max() <= slow.alpha.max()


def test_labels_keep_their_times():
    slow = ramp(4, 10, ("SIL", "AA", "AA", "M"))
    assert at_rate(slow, Fraction(20)).labels == ("SIL",) * 2 + ("AA",) * 4 + ("M",) * 2
    assert at_rate(ramp(1, 100), Fraction(10)).labels == ("AA",)


# ---- from end to end ------------------------------------------------------------------------


def test_what_is_spoken_is_a_video_with_sound(person, speech, tmp_path):
    out = tmp_path / "said.mkv"
    done = speak(person, speech, out, lossless=True, backend="numpy")
    info = probe(out)
    assert (info.width, info.height) == person.frame_size == (144, 160)
    assert info.fps == FPS
    assert info.frames == 10  # 8 frames at 25 a second are 9.6 at 30
    samples, rate = read_sound(out)
    assert rate == speech.rate
    np.testing.assert_array_equal(samples[: len(speech.samples)], speech.samples)
    planned = plan(person, speech.alignment)
    assert done.labels == planned.labels
    np.testing.assert_array_equal(done.alpha, planned.alpha)


def test_the_same_words_give_the_same_bits(person, speech, tmp_path):
    outs = [tmp_path / f"{i}.mkv" for i in range(2)]
    for out in outs:
        speak(person, speech, out, lossless=True, backend="numpy")
    first, second = (np.stack(list(read_frames(out))) for out in outs)
    np.testing.assert_array_equal(first, second)


def test_only_the_mouth_moves(person, face_and_basis, tmp_path):
    """Movement of one prototype and texture of another, on a background of its own."""
    behind = write_clip(tmp_path / "behind.mkv", face_and_basis[0], hold(*POSTURES[:1] * 3))
    basis = person.basis
    alpha, beta = np.zeros((3, 4)), np.tile(np.eye(5)[basis.reference], (3, 1))
    alpha[1], beta[1] = np.eye(4)[1], np.eye(5)[2]
    out = tmp_path / "out.mkv"
    render(
        person,
        Trajectory(("SIL", "AA", "SIL"), alpha, beta, Fraction(25)),
        out,
        background=behind,
        lossless=True,
        backend="numpy",
    )
    assert not probe(out).has_sound
    made, real = (np.stack(list(read_frames(p))).astype(float) for p in (out, behind))
    changed = np.abs(made - real).max(axis=-1)
    x, y, w, h = basis.region.box
    outside = np.ones(changed.shape[1:], bool)
    outside[y - 1 : y + h + 1, x - 1 : x + w + 1] = False
    assert not changed[:, outside].any()
    assert changed[[0, 2]].max() <= 30
    assert changed[1].max() > 60


def test_a_bad_background_is_refused(person, speech, tmp_path):
    out = tmp_path / "out.mkv"
    with pytest.raises(InputError, match="no such file"):
        speak(person, speech, out, background=tmp_path / "none.mkv", backend="numpy")
    assert not out.exists()


def test_a_vowel_may_be_held_as_long_as_in_a_song(basis):
    """Ten seconds of AA: the mouth gets to the vowel, stays there, and leaves again."""
    model = replace(make_model(basis), fps=Fraction(25))
    song = cover([Segment("AA", 0.4, 10.4)], 10.8)
    planned = plan(model, Alignment(song, (), 10.8))
    assert len(planned) == 270
    middle = planned.alpha[100:170]
    wanted = model.alpha.trained.mean[model.alpha.trained.labels.index("AA")]
    np.testing.assert_allclose(middle, np.broadcast_to(wanted, middle.shape), atol=1e-3)
    np.testing.assert_allclose(planned.beta.sum(axis=1), 1, atol=1e-12)
    assert np.isfinite(planned.alpha).all()
