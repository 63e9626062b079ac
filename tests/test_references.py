from dataclasses import replace

import numpy as np
import pytest

from mmmgpu.corpora import open_corpus
from mmmgpu.errors import InputError
from mmmgpu.performer import landmarks
from mmmgpu.references import check_sound, find_reference, rebase_reference
from mmmgpu.regions import region_from_box
from mmmgpu.registration import project
from mmmgpu.sounds import energy, read_sound
from mmmgpu.tracks import frame_at, make_reference, rebase, track_clip
from mmmgpu.video_writing import write_video
from mmmgpu.videos import probe, read_frames


@pytest.fixture(scope="module")
def corpus(world):
    return open_corpus(world.clips, world.alignments)


@pytest.fixture(scope="module")
def found(corpus):
    return find_reference(corpus, None)


def true_mouth(world, clip=None, t=0):
    """(x, y, width) [px] of the lips in frame `t`; the provisional reference is the default."""
    clip = len(world.clips) // 2 if clip is None else clip
    lips = landmarks(world.face, world.motions[clip], t)[:20]
    return np.array([*lips.mean(axis=0), np.ptp(lips[:, 0])])


def test_the_mouth_of_a_moving_head_is_found(world, found):
    x, y, width = true_mouth(world)
    got = found.region.mouth
    assert np.hypot(got[0] - x, got[1] - y) < 0.3 * width
    assert 0.6 * width < got[2] < 1.4 * width
    left, top, w, h = found.region.box
    assert left < x - width / 2 < x + width / 2 < left + w
    assert top < y < top + h


def test_the_head_is_that_of_the_first_frame_of_the_middle_clip(world, found):
    again = make_reference(frame_at(world.clips[2], 0), found.head, found.region)
    np.testing.assert_array_equal(found.colours, again.colours)


def test_a_given_region_is_taken_as_it_is(corpus):
    box = (40, 80, 60, 60)
    reference = find_reference(corpus, box)
    assert reference.region == region_from_box(box, (144, 160))


def test_a_bad_region_is_an_error(corpus):
    with pytest.raises(InputError, match="--region 100,80,60,60"):
        find_reference(corpus, (100, 80, 60, 60))


def test_a_middle_clip_without_the_head_is_passed_over(world, tmp_path):
    """The next clip gives the reference; what moves with the sound in the odd one is ignored."""
    corpus = open_corpus(world.clips, world.alignments)
    sound = read_sound(world.clips[2])
    loud = energy(*sound, corpus[2].info.frames, 25.0)
    lamp = np.zeros((len(loud), 160, 144, 3), np.uint8)
    lamp[:, 10:40, 100:130] = (255 * loud / loud.max())[:, None, None, None]
    lamp[::2] = 0
    odd = tmp_path / world.clips[2].name
    write_video(odd, lamp, fps=25, sound=sound, lossless=True)
    corpus[2] = replace(corpus[2], path=odd, info=probe(odd))
    reference = find_reference(corpus, None)
    again = make_reference(frame_at(world.clips[0], 0), reference.head, reference.region)
    np.testing.assert_array_equal(reference.colours, again.colours)
    x, y, width = true_mouth(world, clip=0)
    got = reference.region.mouth
    assert np.hypot(got[0] - x, got[1] - y) < 0.3 * width
    assert 0.6 * width < got[2] < 1.4 * width


def late_sound(world, folder, seconds):
    """The clips with their sound moved later by `seconds`."""
    clips = []
    for clip in world.clips[:3]:
        samples, rate = read_sound(clip)
        moved = np.roll(samples, round(seconds * rate))
        clips.append(folder / clip.name)
        write_video(clips[-1], read_frames(clip), fps=25, sound=(moved, rate), lossless=True)
    return open_corpus(clips, world.alignments)


def test_sync_brings_sound_and_picture_together(world, tmp_path):
    """Sound that is late by 0.4 s is of use only after it has been moved back."""
    corpus = late_sound(world, tmp_path, 0.4)
    x, y, width = true_mouth(world, clip=1)
    moved = find_reference(corpus, None, sync=-0.4).region.mouth
    assert np.hypot(moved[0] - x, moved[1] - y) < 0.3 * width
    wrong = find_reference(corpus, None).region.mouth
    assert np.hypot(wrong[0] - x, wrong[1] - y) > np.hypot(moved[0] - x, moved[1] - y)


def test_sound_is_needed_and_asked_for(world, corpus, tmp_path):
    check_sound(corpus)
    mute = tmp_path / "mute.mkv"
    write_video(mute, read_frames(world.clips[0], stop=10), fps=25, lossless=True)
    alone = [replace(corpus[0], path=mute, info=probe(mute))]
    with pytest.raises(InputError, match=r"mute\.mkv: has no sound.*--region"):
        check_sound([*corpus, *alone])


@pytest.mark.parametrize("keep_box", [True, False])
def test_a_rebased_reference_sees_its_own_frame_at_the_identity(world, found, keep_box):
    clip, t = 0, 20
    track = track_clip(world.clips[clip], found)
    new = rebase_reference(found, track, t, (144, 160), keep_box=keep_box)
    moved = rebase(track, track.poses[t], track.gain, track.offset)
    np.testing.assert_allclose(moved.poses[t], np.eye(3), atol=1e-9)

    again = track_clip(world.clips[clip], new)  # tracking by the new one gives the same
    points = project(new.head.to_frame, np.array([[30.0, 30], [60, 40], [40, 70]]))
    for a, b in zip(again.poses, moved.poses, strict=True):
        np.testing.assert_allclose(project(a, points), project(b, points), atol=0.25)
    np.testing.assert_allclose(again.gain, moved.gain, atol=0.02)
    np.testing.assert_allclose(again.offset, moved.offset, atol=0.02)

    old_mouth = np.array(found.region.mouth)
    carried = project(track.poses[t], old_mouth[None, :2])[0]
    np.testing.assert_allclose(new.region.mouth[:2], carried)
    assert new.region.mouth[2] == pytest.approx(old_mouth[2], rel=0.05)
    if keep_box:
        assert new.region.box[2:] == found.region.box[2:]
        shift = np.subtract(new.region.box[:2], found.region.box[:2])
        np.testing.assert_allclose(shift, carried - old_mouth[:2], atol=0.51)


def test_a_rebased_reference_has_the_colours_of_its_own_clip(world, found):
    track = track_clip(world.clips[0], found)
    gain, offset = np.array([1.2, 0.9, 1.0]), np.array([0.1, 0.0, -0.05])
    other = replace(track, gain=gain, offset=offset)  # as if the clip had another exposure
    new = rebase_reference(found, other, 3, (144, 160), keep_box=False)
    np.testing.assert_allclose(gain * new.colours + offset, found.colours, atol=1e-6)
    assert new.colours.dtype == np.float32


def test_a_kept_box_stays_in_the_picture(world, corpus):
    reference = find_reference(corpus, (84, 100, 60, 60))  # touches two edges
    track = track_clip(world.clips[0], reference)
    for t in range(0, len(track), 9):
        x, y, w, h = rebase_reference(reference, track, t, (144, 160), keep_box=True).region.box
        assert (w, h) == (60, 60)
        assert 0 <= x <= 144 - w
        assert 0 <= y <= 160 - h
