from dataclasses import replace

import numpy as np
import pytest
from worlds import FPS, texture

from mmmgpu.errors import InputError
from mmmgpu.performer import landmarks
from mmmgpu.regions import Region, region_around
from mmmgpu.registration import head_from_frame, project
from mmmgpu.tracks import (
    Track,
    crop,
    crops,
    frame_at,
    make_reference,
    rebase,
    track_clip,
)
from mmmgpu.video_writing import write_video

UPPER_FACE = slice(61, 87)  # landmarks of nose and eyes


@pytest.fixture(scope="module")
def reference(world):
    """The first frame of the first clip, with the true place of the mouth."""
    frame = frame_at(world.clips[0], 0)
    points = landmarks(world.face, world.motions[0], 0)[:20]
    mouth = np.array([*points.mean(axis=0), np.ptp(points[:, 0])])
    region = region_around(mouth, (frame.shape[1], frame.shape[0]))
    return make_reference(frame, head_from_frame(frame, mouth), region)


@pytest.fixture(scope="module")
def tracks(world, reference):
    return [track_clip(clip, reference) for clip in world.clips[:2]]


def true_points(world, clip, t):
    return landmarks(world.face, world.motions[clip], t)[UPPER_FACE]


def test_tracks_follow_the_head(world, tracks):
    start = true_points(world, 0, 0)
    for i, track in enumerate(tracks):
        assert len(track) == len(world.motions[i])
        assert track.registered.all()
        miss = [
            np.linalg.norm(project(pose, start) - true_points(world, i, t), axis=1)
            for t, pose in enumerate(track.poses)
            if world.motions[i].blink[t] == world.motions[0].blink[0]
        ]
        still = [np.linalg.norm(start - true_points(world, i, t)) for t in range(len(track))]
        assert np.mean(miss) < 0.35
        assert np.max(miss) < 1.0
        assert track.residual < 0.3
        assert max(still) / len(start) ** 0.5 > 3 * np.mean(miss)  # there was something to follow


def test_the_same_camera_has_the_same_exposure(tracks):
    for track in tracks:
        np.testing.assert_allclose(track.gain, 1, atol=0.02)
        np.testing.assert_allclose(track.offset, 0, atol=0.01)


def exposed(frames, gain, offset):
    """`frames` as a camera sees them for which ``frame = gain * seen + offset``."""
    for frame in frames:
        seen = (frame / 255.0 - offset) / gain
        yield np.clip(np.rint(255 * seen), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("gain", "offset"),
    [((1.3, 1.3, 1.3), (0.0, 0.0, 0.0)), ((0.9, 1.0, 1.15), (0.04, -0.02, 0.01))],
    ids=["exposure", "white balance"],
)
def test_exposure_and_white_balance_are_recovered(world, reference, tmp_path, gain, offset):
    frames = [frame_at(world.clips[0], t) for t in range(8)]
    clip = tmp_path / "other camera.mkv"
    seen = exposed(frames, np.array(gain), np.array(offset))
    write_video(clip, seen, fps=FPS, lossless=True)
    track = track_clip(clip, reference)
    skin = np.array([[0.35, 0.25, 0.2], [0.55, 0.42, 0.35], [0.7, 0.55, 0.45]])
    darkened = (skin - np.array(offset)) / np.array(gain)
    np.testing.assert_allclose(track.gain * darkened + track.offset, skin, atol=0.01)
    plain = track_clip(world.clips[0], reference)
    pictures = [
        crop(frame, plain.poses[i], plain, reference.region) for i, frame in enumerate(frames)
    ]
    for a, b in zip(crops(clip, track, reference.region), pictures, strict=True):
        assert np.sqrt(np.mean((a - b) ** 2)) < 0.008


def test_a_clip_of_another_scene_is_refused(reference, tmp_path):
    clip = tmp_path / "wall ü.mkv"
    wall = (255 * texture(160, 144, seed=3)).astype(np.uint8)
    write_video(clip, [wall] * 6, fps=FPS, lossless=True)
    with pytest.raises(InputError, match=r"wall ü\.mkv: the head .* in 0 of 6 frames") as error:
        track_clip(clip, reference)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("bad", "fine"), [(4, True), (8, False)])
def test_half_of_the_frames_must_show_the_head(world, reference, tmp_path, bad, fine):
    frames = [frame_at(world.clips[0], t) for t in range(12)]
    for t in range(2, 2 + bad):
        frames[t] = np.full_like(frames[t], 40)
    clip = tmp_path / "gap.mkv"
    write_video(clip, frames, fps=FPS, lossless=True)
    if not fine:
        with pytest.raises(InputError, match=f"in {12 - bad} of 12 frames"):
            track_clip(clip, reference)
        return
    track = track_clip(clip, reference)
    assert np.flatnonzero(~track.registered).tolist() == list(range(2, 2 + bad))
    start = true_points(world, 0, 0)
    for t, pose in enumerate(track.poses):  # the gap is bridged
        assert np.linalg.norm(project(pose, start) - true_points(world, 0, t), axis=1).mean() < 1.0


def some_track(rng, frames=5):
    poses = np.tile(np.eye(3), (frames, 1, 1)) + 0.01 * rng.normal(size=(frames, 3, 3))
    poses[:, :2, 2] += 5 * rng.normal(size=(frames, 2))
    poses[:, 2, :2] *= 0.01
    poses = poses / poses[:, 2:, 2:]
    gain, offset = rng.uniform(0.8, 1.2, 3), rng.uniform(-0.1, 0.1, 3)
    return Track(poses, np.ones(frames, bool), np.ones(frames), gain, offset, 0.1)


def test_rebasing_makes_the_new_reference_the_identity():
    first, other = (some_track(np.random.default_rng(seed)) for seed in range(2))
    pose = first.poses[3]
    again = rebase(first, pose, first.gain, first.offset)
    np.testing.assert_allclose(again.poses[3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(again.gain, 1)
    np.testing.assert_allclose(again.offset, 0, atol=1e-15)

    moved = rebase(other, pose, first.gain, first.offset)
    points = np.array([[30.0, 40], [80, 25], [60, 90]])
    for a, b in zip(moved.poses, other.poses, strict=True):
        np.testing.assert_allclose(project(a, project(pose, points)), project(b, points))
        assert a[2, 2] == 1
    colour = np.array([0.2, 0.5, 0.7])  # in the other clip, seen by the old and the new reference
    old = other.gain * colour + other.offset
    new = moved.gain * colour + moved.offset
    np.testing.assert_allclose(first.gain * new + first.offset, old)
    np.testing.assert_array_equal(moved.registered, other.registered)


def test_a_crop_is_the_picture_under_the_region():
    rng = np.random.default_rng(0)
    frame = (255 * texture(60, 70, grain=3.0)).astype(np.uint8)
    track = replace(
        some_track(rng), gain=np.array([1.0, 0.5, 2.0]), offset=np.array([0, 0.25, -0.2])
    )
    region = Region((10, 15, 30, 20), (25.0, 25.0, 12.0))
    pose = np.eye(3)
    pose[:2, 2] = 4, -3
    got = crop(frame, pose, track, region)
    assert got.shape == (20, 30, 3)
    assert got.dtype == np.float32
    wanted = np.clip(frame[12:32, 14:44] / 255 * track.gain + track.offset, 0, 1)
    np.testing.assert_allclose(got, wanted, atol=1e-6)


def test_a_crop_beyond_the_edge_repeats_it():
    frame = np.zeros((40, 40, 3), np.uint8)
    frame[:, :5] = 255
    track = replace(some_track(np.random.default_rng(0)), gain=np.ones(3), offset=np.zeros(3))
    got = crop(frame, np.eye(3), track, Region((-10, 5, 12, 20), (0.0, 15.0, 8.0)))
    np.testing.assert_array_equal(got, np.ones((20, 12, 3)))


def test_crops_are_the_crop_of_every_frame(world, reference, tracks):
    pictures = list(crops(world.clips[1], tracks[1], reference.region))
    assert len(pictures) == len(tracks[1])
    for t in (0, 7, len(pictures) - 1):
        np.testing.assert_array_equal(
            crop(frame_at(world.clips[1], t), tracks[1].poses[t], tracks[1], reference.region),
            pictures[t],
        )


def test_crops_of_a_stretch_are_those_of_the_clip(world, reference, tracks):
    pictures = list(crops(world.clips[1], tracks[1], reference.region))
    stretch = list(crops(world.clips[1], tracks[1], reference.region, start=5, stop=9))
    np.testing.assert_array_equal(stretch, pictures[5:9])
    rest = list(crops(world.clips[1], tracks[1], reference.region, start=len(pictures) - 2))
    np.testing.assert_array_equal(rest, pictures[-2:])


def test_tracking_tells_of_every_frame(world, reference):
    ticks = []
    track = track_clip(world.clips[0], reference, tick=lambda: ticks.append(None))
    assert len(ticks) == len(track)


def test_stabilised_crops_hold_still(world, reference, tracks):
    """Cheeks beside the mouth stay where they are although the head moves."""
    wide = Region((20, 60, 100, 40), reference.region.mouth)
    still = np.stack(list(crops(world.clips[1], tracks[1], wide)))
    loose = replace(tracks[1], poses=np.tile(np.eye(3), (len(tracks[1]), 1, 1)))
    moving = np.stack(list(crops(world.clips[1], loose, wide)))
    assert still.std(axis=0).mean() < 0.7 * moving.std(axis=0).mean()


def test_colours_are_read_inside_the_picture(world, reference):
    assert len(reference.colours) == len(reference.colour_points) > 100
    assert reference.colours.dtype == np.float32
    assert reference.colours.min() >= 0
    assert reference.colours.max() <= 1
    frame = frame_at(world.clips[0], 0)
    for mouth in ([10.0, 30.0, 26.0], [134.0, 180.0, 26.0]):  # such a head leaves the picture
        cut = make_reference(frame, head_from_frame(frame, np.array(mouth)), reference.region)
        assert 0 < len(cut.colour_points) < len(reference.colour_points)
        assert (cut.colour_points >= 0).all()
        assert (cut.colour_points <= (143, 159)).all()
