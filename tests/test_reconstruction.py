from dataclasses import replace
from fractions import Fraction

import cv2
import numpy as np
import pytest
from media import encode, grey_levels
from worlds import POSTURES, RATE, hold, make_model

from mmmgpu.compositing import composite
from mmmgpu.errors import InputError
from mmmgpu.models import Calm
from mmmgpu.performer import render
from mmmgpu.reconstruction import analyse_clip, reconstruct
from mmmgpu.registration import head_from_frame
from mmmgpu.sounds import read_sound
from mmmgpu.synthesis import synthesize
from mmmgpu.tracks import Track, make_reference
from mmmgpu.video_writing import write_video
from mmmgpu.videos import probe, read_frames

POSES = np.array([[0, 0, 0, 0], [0.01, 0, 0, 0], [0.01, 0.01, 0.02, 0], [0, 0.01, 0.03, 0]])


def make_person(face_and_basis, clip, *, fps=25):
    """A model that knows the head of the performer, with the `clip` of a still head as its calm."""
    face, basis = face_and_basis
    pictures = np.stack(list(render(face, hold(*POSTURES))))
    head = head_from_frame(pictures[0], np.array(basis.region.mouth))
    frames = probe(clip).frames
    still = Track(
        np.stack([np.eye(3)] * frames),
        np.ones(frames, bool),
        np.ones(frames),
        np.ones(3),
        np.zeros(3),
        0.0,
    )
    return replace(
        make_model(basis),
        reference=make_reference(pictures[0], head, basis.region),
        fps=Fraction(fps),
        prototype_frames=pictures,
        sources=tuple(("postures.mkv", i) for i in range(len(pictures))),
        calm=Calm(np.frombuffer(clip.read_bytes(), np.uint8), clip.suffix, still),
    )


def write_clip(path, face, motion, *, fps=25, sound=True):
    """A lossless clip of `motion` with noise for its sound."""
    samples = 0.1 * np.random.default_rng(0).standard_normal((len(motion.pose) * RATE) // fps)
    noise = (samples.astype(np.float32), RATE) if sound else None
    write_video(path, render(face, motion), fps=fps, sound=noise, lossless=True)
    return path


@pytest.fixture(scope="module")
def clip(face_and_basis, tmp_path_factory):
    """Four frames of a moving head that speaks."""
    motion = hold(*POSTURES[1:], pose=POSES)
    return write_clip(tmp_path_factory.mktemp("clip") / "clip.mkv", face_and_basis[0], motion)


@pytest.fixture(scope="module")
def model(face_and_basis, clip):
    return make_person(face_and_basis, clip)


@pytest.fixture(scope="module")
def reconstruction(model, clip):
    """(what `reconstruct` returned, the file it wrote)."""
    out = clip.with_name("again.mkv")
    return reconstruct(model, clip, out, lossless=True, backend="numpy"), out


def test_size_length_and_sound_are_those_of_the_clip(clip, reconstruction):
    real, made = probe(clip), probe(reconstruction[1])
    assert replace(made, path=clip) == real
    assert made.frames == len(POSES)
    for again, wanted in zip(read_sound(reconstruction[1]), read_sound(clip), strict=True):
        np.testing.assert_array_equal(again, wanted)


def test_it_is_what_the_model_makes_of_its_coordinates(model, clip, reconstruction):
    analysed, out = reconstruction
    basis, track = model.basis, analysed.track
    assert analysed.alpha.shape == (4, 4)
    np.testing.assert_allclose(analysed.beta.sum(axis=1), 1, atol=1e-6)
    images = synthesize(basis, analysed.alpha, analysed.beta, backend="numpy")
    frames = zip(read_frames(out), read_frames(clip), images, track.poses, strict=True)
    for made, real, image, pose in frames:
        wanted = composite(real, image, basis.cover, pose, track, basis.region)
        np.testing.assert_array_equal(made, wanted)


def test_outside_the_cover_nothing_changes_and_inside_little(model, clip, reconstruction):
    analysed, out = reconstruction
    basis = model.basis
    frames = zip(read_frames(clip), read_frames(out), analysed.track.poses, strict=True)
    for real, made, pose in frames:
        matrix = pose @ basis.region.to_frame
        reach = cv2.dilate(basis.cover, np.ones((3, 3)))
        cover = cv2.warpPerspective(reach, matrix, real.shape[1::-1])
        assert 0.1 < (cover == 0).mean() < 0.95
        np.testing.assert_array_equal(made[cover == 0], real[cover == 0])
        error = made[cover > 0].astype(float) - real[cover > 0]
        assert 0 < np.sqrt(np.mean(error**2)) < 6


def test_lossy_files_are_written_too(model, clip, tmp_path):
    out = tmp_path / "again.mp4"
    reconstruct(model, clip, out, backend="numpy")
    made, real = probe(out), probe(clip)
    assert (made.width, made.height, made.frames) == (real.width, real.height, real.frames)
    assert made.fps == real.fps
    error = np.stack(list(read_frames(out))).astype(float) - np.stack(list(read_frames(clip)))
    assert np.sqrt(np.mean(error**2)) < 8


def test_a_clip_without_sound_stays_without(model, face_and_basis, tmp_path):
    motion = hold(*POSTURES[:2])
    silent = write_clip(tmp_path / "silent.mkv", face_and_basis[0], motion, sound=False)
    reconstruct(model, silent, tmp_path / "again.mkv", backend="numpy")
    assert not probe(tmp_path / "again.mkv").has_sound


def test_another_picture_is_refused(model, tmp_path):
    grey = encode(tmp_path / "grey.mkv", grey_levels(3, 144, 160))
    with pytest.raises(InputError, match=r"grey\.mkv: the head .* 0 of 3 frames"):
        analyse_clip(model, grey, backend="numpy")
    one = encode(tmp_path / "one.mkv", grey_levels(1, 144, 160))
    with pytest.raises(InputError, match="2 are needed"):
        reconstruct(model, one, tmp_path / "out.mkv", backend="numpy")
    assert not (tmp_path / "out.mkv").exists()
