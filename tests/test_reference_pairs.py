"""The frames that two persons are compared in: from a model, and from clips alone."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from worlds import POSTURES, RATE, hold, make_model

from mmmgpu import reference_pairs
from mmmgpu.errors import InputError
from mmmgpu.performer import landmarks, masks, performer, render
from mmmgpu.reference_pairs import (
    ShownFrame,
    choose_references,
    most_open,
    openness,
    pose_of,
    source_references,
)
from mmmgpu.regions import Region, lip_mask
from mmmgpu.registration import head_from_frame, project
from mmmgpu.tracks import frame_at, make_reference
from mmmgpu.video_writing import write_video

ROLL, SHIFT = 0.03, 0.04  # of the open prototype's head [rad, face units]


def gaps(face, motion):
    """How many pixels the mouth is open in every frame, (T,)."""
    return np.array([masks(face, motion, t)["inside"].sum() for t in range(len(motion))])


def mouth_of(face, motion, t):
    """(x, y, width) [px] of the lips in truth."""
    lips = landmarks(face, motion, t)[:20]
    return np.array([*lips.mean(axis=0), np.ptp(lips[:, 0])])


@pytest.fixture(scope="module")
def person(face_and_basis):
    """A model whose prototype frames are pictures, the open one with the head moved, and truth."""
    face, basis = face_and_basis
    pose = np.zeros((len(POSTURES), 4))
    pose[2, :3] = SHIFT, -SHIFT, ROLL
    motion = hold(*POSTURES, pose=pose)
    frames = np.stack(list(render(face, motion)))
    mouth = np.array(basis.region.mouth)
    reference = make_reference(frames[0], head_from_frame(frames[0], mouth), basis.region)
    model = replace(make_model(basis), prototype_frames=frames, reference=reference)
    return model, face, motion


def test_openness_is_the_lower_lip_s_way_down_less_the_upper_lip_s():
    region = Region((0, 0, 40, 30), (20.0, 12.0, 16.0))
    flow = np.zeros((30, 40, 2), np.float32)
    flow[..., 0] = 7
    flow[13:, :, 1] = 3
    flow[:13, :, 1] = -2
    assert_allclose(openness(flow, region, lip_mask(region)), 5, rtol=1e-5)
    assert_allclose(openness(flow + np.float32(4), region, lip_mask(region)), 5, rtol=1e-5)
    outside = np.where(lip_mask(region)[..., None] > 0, flow, np.float32(99))
    assert_allclose(openness(outside, region, lip_mask(region)), 5, rtol=1e-5)
    assert_allclose(openness(-flow, region, lip_mask(region)), -5, rtol=1e-5)


def test_openness_knows_where_the_region_lies_in_the_frame():
    region = Region((100, 60, 40, 30), (120.0, 72.0, 16.0))
    flow = np.zeros((30, 40, 2), np.float32)
    flow[13:, :, 1] = 3
    assert_allclose(openness(flow, region, lip_mask(region)), 3, rtol=1e-5)


def test_the_most_open_prototype_is_the_most_open_one(basis):
    assert most_open(basis) == 2


def test_a_model_shows_its_reference_and_its_most_open_prototype(person):
    model, face, motion = person
    shown = source_references(model)
    assert list(shown) == ["closed", "open"]
    for kind, i in (("closed", 0), ("open", 2)):
        assert (shown[kind].clip, shown[kind].frame) == model.sources[i]
        assert_array_equal(shown[kind].picture, model.prototype_frames[i])
    assert_allclose(shown["closed"].mouth, model.basis.region.mouth, atol=0.3)
    # where the reference's mouth is carried to: the head's way, not the lips'
    here = hold({}, {}, pose=motion.pose[[0, 2]])
    assert_allclose(shown["open"].mouth, mouth_of(face, here, 1), atol=1.5)
    assert np.abs(mouth_of(face, here, 1) - mouth_of(face, here, 0)).max() > 2


def test_a_prototype_without_the_head_is_an_error(person):
    model, _, _ = person
    frames = model.prototype_frames.copy()
    frames[2] = np.random.default_rng(0).integers(0, 256, frames[2].shape)
    name, frame = model.sources[2]
    with pytest.raises(InputError, match=rf"prototype 2 \({name}, frame {frame}\).*another frame"):
        source_references(replace(model, prototype_frames=frames))


def test_the_pose_of_the_reference_itself_is_none(person):
    model, _, _ = person
    pose = pose_of(model.prototype_frames[0], model.reference, "here")
    x, y, width = model.basis.region.mouth
    corners = np.array([[x - width / 2, y], [x + width / 2, y], [x, y + width / 2]])
    assert_allclose(project(pose, corners), corners, atol=0.5)


@pytest.fixture(scope="module")
def chosen(world):
    return choose_references(world.clips)


def place(world, shown):
    names = [clip.name for clip in world.clips]
    return names.index(shown.clip), shown.frame


def test_what_is_shown_is_a_frame_as_filmed(world, chosen):
    assert list(chosen) == ["closed", "open"]
    for shown in chosen.values():
        assert isinstance(shown, ShownFrame)
        clip, t = place(world, shown)
        assert_array_equal(shown.picture, frame_at(world.clips[clip], t))


def test_the_closed_frame_is_silent_and_has_a_closed_mouth(world, chosen):
    clip, t = place(world, chosen["closed"])
    assert gaps(world.face, world.motions[clip])[t] == 0
    assert world.motions[clip].column("jaw")[t] < 0.05


def test_the_open_frame_is_one_of_the_most_open(world, chosen):
    clip, t = place(world, chosen["open"])
    every = np.concatenate([gaps(world.face, motion) for motion in world.motions])
    assert gaps(world.face, world.motions[clip])[t] >= 0.95 * every.max()


def test_a_frame_whose_head_is_lost_is_not_chosen(world, chosen, monkeypatch):
    lost, real = chosen["open"], reference_pairs.track_clip

    def track(path, reference):
        found = real(path, reference)
        if path.name == lost.clip:
            found.registered[lost.frame] = False
        return found

    monkeypatch.setattr(reference_pairs, "track_clip", track)
    again = choose_references(world.clips)["open"]
    assert (again.clip, again.frame) != (lost.clip, lost.frame)


def test_the_mouth_is_where_it_is(world, chosen):
    for shown in chosen.values():
        clip, t = place(world, shown)
        motion = world.motions[clip]
        rest = replace(motion, values=np.tile(hold({}).values, (len(motion), 1)))
        x, y, width = mouth_of(world.face, rest, t)
        assert np.hypot(shown.mouth[0] - x, shown.mouth[1] - y) < 0.3 * width
        assert 0.6 * width < shown.mouth[2] < 1.4 * width


def test_a_clip_without_the_head_is_passed_over(world, tmp_path):
    odd = tmp_path / "odd.mkv"
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (10, 160, 144, 3), np.uint8)
    sound = (np.zeros(RATE * 10 // 25, np.float32), RATE)
    write_video(odd, frames, fps=25, sound=sound, lossless=True)
    again = choose_references([*world.clips, odd])
    assert all(shown.clip != odd.name for shown in again.values())


def test_clips_that_cannot_be_used_are_errors(world, tmp_path):
    with pytest.raises(InputError, match="nothing"):
        choose_references([tmp_path / "nothing.mkv"])
    with pytest.raises(InputError, match="--region 100,80,60,60"):
        choose_references(world.clips, region=(100, 80, 60, 60))
    still = tmp_path / "still.mkv"
    (frame,) = render(performer(3, size=(160, 144)), hold({}))
    write_video(still, [frame] * 12, fps=25, lossless=True)
    with pytest.raises(InputError, match=r"still\.mkv"):
        choose_references([still])
