import cv2
import numpy as np
import pytest
from worlds import FPS, say, sentence_motion

from mmmgpu.errors import InputError
from mmmgpu.performer import landmarks, performer, render
from mmmgpu.regions import (
    SEARCH_WIDTH,
    cover_mask,
    lip_mask,
    locate_mouth,
    mouth_mask,
    refine_centre,
    region_around,
    region_from_box,
    shrink,
    speech_motion,
    width_from_eyes,
)
from mmmgpu.videos import read_frames

MASKS = {"cover": cover_mask, "lip": lip_mask, "mouth": mouth_mask}


def test_a_region_lies_around_its_mouth():
    region = region_around((100.0, 120.0, 40.0), (300, 400))
    x, y, w, h = region.box
    assert region.shape == (h, w)
    assert x + w / 2 == pytest.approx(100, abs=1)
    assert y < 120 - 0.7 * 40
    assert y + h > 120 + 1.15 * 40  # the chin moves too
    np.testing.assert_allclose(region.to_frame @ [3, 4, 1], [x + 3, y + 4, 1])


def test_a_region_is_cut_at_the_edge_of_the_picture():
    x, y, w, h = region_around((20.0, 180.0, 40.0), (160, 200)).box
    assert (x, y + h) == (0, 200)
    assert 0 < w < 100
    assert y >= 0


@pytest.mark.parametrize(
    "box", [(0, 0, 15, 40), (0, 0, 40, 15), (-1, 0, 40, 40), (0, -1, 40, 40), (61, 0, 40, 40),
            (0, 41, 40, 40), (0, 0, 0, 0)]
)  # fmt: skip
def test_a_bad_box_is_named(box):
    with pytest.raises(InputError, match=r"--region -?\d+,-?\d+,\d+,\d+: .*16 x 16.* 100 x 80"):
        region_from_box(box, (100, 80))


@pytest.mark.parametrize("box", [(0, 0, 100, 80), (10, 20, 16, 16), (60, 0, 40, 80)])
def test_a_given_box_is_kept_and_its_mouth_lies_inside(box):
    region = region_from_box(box, (100, 80))
    assert region.box == box
    x, y, width = region.mouth
    assert box[0] < x - width / 2 < x + width / 2 < box[0] + box[2]
    assert box[1] < y < box[1] + box[3]


def test_a_box_from_a_mouth_gives_that_mouth_back():
    region = region_around((150.0, 160.0, 50.0), (400, 400))
    again = region_from_box(region.box, (400, 400))
    np.testing.assert_allclose(again.mouth, region.mouth, atol=0.6)


@pytest.mark.parametrize("mask", MASKS)
@pytest.mark.parametrize(
    "region",
    [
        region_around((100.0, 120.0, 40.0), (300, 400)),
        region_around((30.0, 170.0, 40.0), (160, 200)),  # cut on two sides
        region_from_box((0, 0, 120, 40), (300, 200)),
    ],
    ids=["whole", "cut", "wide"],
)
def test_masks_are_one_inside_and_fade_to_zero_at_the_border(mask, region):
    m = MASKS[mask](region)
    assert m.shape == region.shape
    assert m.dtype == np.float32
    assert m.min() == 0
    assert m.max() <= 1
    for edge in (m[0], m[-1], m[:, 0], m[:, -1]):
        np.testing.assert_array_equal(edge, 0)
    x, y, width = region.mouth
    column, row = round(x - region.box[0]), round(y - region.box[1])
    assert m[row, column] == 1
    reach = int(0.3 * width)
    assert (m[row, column - reach : column + reach + 1] == 1).all()
    step = max(np.abs(np.diff(m, axis=0)).max(), np.abs(np.diff(m, axis=1)).max())
    assert step < 14 / width  # no edge that could be seen: at least a tenth of the mouth wide


def test_the_cover_holds_the_other_masks():
    region = region_around((100.0, 120.0, 60.0), (300, 400))
    cover = cover_mask(region)
    for mask in (lip_mask(region), mouth_mask(region)):
        assert (cover[mask > 0.5] > 0.9).all()


def moving_picture(rng, *, frames=90, speech=None, blinks=(20, 55)):
    """Grey frames (T, 80, 64): a mouth that moves with the sound, eyes that blink, noise."""
    speech = np.clip(np.sin(np.arange(frames) / 9), 0, 1) if speech is None else speech
    pictures = np.full((frames, 80, 64), 120.0)
    wobble = np.sin(np.arange(frames) * 1.9)
    pictures[:, 52:60, 24:40] += (40 * speech * wobble)[:, None, None]  # centre (31.5, 55.5)
    for t in blinks:
        pictures[t : t + 3, 20:26, 10:54] -= 90
    pictures += rng.normal(0, 1.0, pictures.shape)
    return np.clip(pictures, 0, 255).astype(np.uint8), 0.3 * speech + 1e-3


def test_what_moves_with_the_sound_is_the_mouth():
    pictures, energy = moving_picture(np.random.default_rng(0))
    motion = speech_motion(list(pictures), energy)
    assert motion.shape == (80, 64)
    assert motion.sum() == pytest.approx(1, abs=1e-4)
    assert motion[50:62, 22:42].sum() > 0.9
    x, y, width = locate_mouth(motion)
    assert (x, y) == pytest.approx((31.5, 55.5), abs=1.5)
    assert 8 < width < 20
    assert refine_centre(motion[36:76, 12:52], 16.0) == pytest.approx((19.5, 19.5), abs=1.0)


def test_what_moves_without_the_sound_is_not():
    pictures, energy = moving_picture(np.random.default_rng(0))
    shown = pictures.copy()
    silence = energy < 0.05
    shown[silence, 5:20, 40:60] = np.where(np.arange(silence.sum()) % 4 < 2, 40, 200)[:, None, None]
    motion = speech_motion(list(shown), energy)
    assert motion[50:62, 22:42].sum() > 0.8


def test_blinks_of_a_speaker_are_not_the_mouth():
    """They come while there is sound, are stronger than the lips' motion, but short."""
    pictures, energy = moving_picture(np.random.default_rng(0), blinks=(12, 18, 70))
    motion = speech_motion(list(pictures), energy)
    assert motion[50:62, 22:42].sum() > 0.85


def test_a_still_picture_has_no_mouth():
    still = [np.full((40, 30), 90, np.uint8)] * 20
    motion = speech_motion(still, np.linspace(0, 1, 20))
    assert not motion.any()
    with pytest.raises(InputError, match="moves with the sound; give --region"):
        locate_mouth(motion)


@pytest.mark.parametrize("seed", [1, 4])  # person 4 blinks
def test_a_first_look_finds_the_mouth_of_a_performer(seed):
    face = performer(seed, size=(160, 144))
    alignment = say("B IY M AA W UW F AE L OW S EH P AH D IY")
    motion = sentence_motion(face, alignment, np.random.default_rng(seed))
    loud = [0.002, 0.1, 0.3]
    energy = np.zeros(len(motion))
    for label, start, end in alignment.phones:
        frames = slice(round(start * FPS), round(end * FPS))
        energy[frames] = loud[0 if label == "SIL" else 2 if label[0] in "AEIOU" else 1]
    small, scale = shrink(render(face, motion, rng=np.random.default_rng(0)))
    x, y, width = (v / scale for v in locate_mouth(speech_motion(small, energy)))
    truth = np.mean([landmarks(face, motion, t)[:20] for t in range(len(motion))], axis=0)
    centre, true_width = truth.mean(axis=0), np.ptp(truth[:, 0])
    assert np.hypot(x - centre[0], y - centre[1]) < 0.5 * true_width  # a first look: the jaw pulls
    assert 0.5 * true_width < width < 1.5 * true_width


def test_shrunk_frames_are_grey_and_of_the_search_size():
    rng = np.random.default_rng(0)
    frame = cv2.GaussianBlur(rng.integers(0, 256, (600, 512, 3), np.uint8), (0, 0), 5)
    small, scale = shrink([frame, frame])
    assert len(small) == 2
    assert small[0].shape == (SEARCH_WIDTH, round(512 * SEARCH_WIDTH / 600))
    assert scale == SEARCH_WIDTH / 600
    assert small[0].mean() == pytest.approx(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY).mean(), abs=1)


def test_the_eyes_tell_the_width_of_the_mouth_from_a_wrong_guess(world):
    frame = next(iter(read_frames(world.clips[0])))
    lips = landmarks(world.face, world.motions[0], 0)[:20]
    x, y = lips.mean(axis=0)
    true = np.ptp(lips[:, 0])
    for guess in (0.75, 1.0, 1.3):
        found = width_from_eyes(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), (x, y, guess * true))
        assert 0.85 * true < found < 1.35 * true
