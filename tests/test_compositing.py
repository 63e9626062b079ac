import numpy as np
import pytest
from worlds import texture

from mmmgpu.compositing import composite, composite_matched, looked_at
from mmmgpu.regions import cover_mask, region_around
from mmmgpu.tracks import Track

H, W = 96, 120
REGION = region_around((60, 46, 26), (W, H))
COVER = cover_mask(REGION)
INSIDE = (
    slice(REGION.box[1], REGION.box[1] + REGION.box[3]),
    slice(REGION.box[0], REGION.box[0] + REGION.box[2]),
)


def track(gain=1.0, offset=0.0):
    return Track(
        np.eye(3)[None], np.ones(1, bool), np.ones(1), np.full(3, gain), np.full(3, offset), 0.0
    )


def shifted(dx, dy):
    return np.array([[1.0, 0, dx], [0, 1.0, dy], [0, 0, 1.0]])


def frame(seed=0, *, grain=3.0):
    return np.rint(255 * (0.2 + 0.6 * texture(H, W, grain=grain, seed=seed))).astype(np.uint8)


def image(seed=1):
    return 0.2 + 0.6 * texture(*REGION.shape, seed=seed)


def in_frame(cover, dx=0, dy=0):
    """The cover moved by whole pixels, as large as the frame."""
    whole = np.zeros((H, W), np.float32)
    whole[INSIDE] = cover
    return np.roll(whole, (dy, dx), axis=(0, 1))


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (1.3, -0.04)])
@pytest.mark.parametrize(("dx", "dy"), [(0, 0), (7, -3)])
def test_a_picture_lies_where_the_pose_puts_it(gain, offset, dx, dy):
    under, own = frame(), image()
    whole = np.zeros((H, W, 3))
    whole[INSIDE] = (own - offset) / gain * 255
    placed = np.roll(whole, (dy, dx), axis=(0, 1))
    share = in_frame(COVER, dx, dy)[..., None]
    wanted = share * placed + (1 - share) * under
    got = composite(under, own, COVER, shifted(dx, dy), track(gain, offset), REGION)
    np.testing.assert_allclose(got, wanted, atol=0.51)
    assert (share == 1).sum() > 500
    np.testing.assert_array_equal(got[share[..., 0] == 0], under[share[..., 0] == 0])


@pytest.mark.parametrize("dx", [0.0, 0.4])
def test_pixels_outside_the_cover_keep_their_bits(dx):
    under, before = frame(), frame()
    pose = shifted(dx, 0.3)
    near = in_frame(COVER)
    reach = np.maximum.reduce([np.roll(near, (y, x), (0, 1)) for y in (0, 1) for x in (0, 1)])
    rng = np.random.default_rng(0)
    for got in (
        composite(under, image(), COVER, pose, track(), REGION),
        composite_matched(under, image(), COVER, pose, track(), REGION, rng),
    ):
        np.testing.assert_array_equal(got[reach == 0], before[reach == 0])
        assert (got[near == 1] != before[near == 1]).any(axis=-1).mean() > 0.9
    np.testing.assert_array_equal(under, before)


def test_a_region_half_out_of_the_frame_is_cut():
    under = frame()
    got = composite(under, image(), COVER, shifted(55, 0), track(), REGION)
    share = in_frame(COVER, 0, 0)
    moved = np.zeros_like(share)
    moved[:, 55:] = share[:, :-55]
    np.testing.assert_array_equal(got[moved == 0], under[moved == 0])
    assert (got != under).any()


@pytest.mark.parametrize("move", [(-500, 0), (500, 0), (0, -500), (0, 500)])
def test_a_region_out_of_the_frame_changes_nothing(move):
    under, rng = frame(), np.random.default_rng(0)
    given = (image(), COVER, shifted(*move), track(), REGION)
    np.testing.assert_array_equal(composite(under, *given), under)
    np.testing.assert_array_equal(composite_matched(under, *given, rng), under)


@pytest.mark.parametrize("slope", [0.0, 0.1])
def test_a_planar_difference_of_colour_is_undone(slope):
    under = frame()
    own = under[INSIDE] / np.float32(255)
    h, w = REGION.shape
    tilt = slope * ((np.arange(w) / w - 0.5) - (np.arange(h)[:, None] / h - 0.5))
    other = (own + np.array([0.05, -0.03, 0.02]) + tilt[..., None]).astype(np.float32)
    rng = np.random.default_rng(0)
    got = composite_matched(under, other, COVER, np.eye(3), track(), REGION, rng)
    plain = composite(under, other, COVER, np.eye(3), track(), REGION)
    assert np.abs(plain.astype(int) - under).max() >= 12
    assert np.abs(got.astype(int) - under).max() <= 1


def test_what_differs_inside_the_rim_stays():
    under = frame(grain=20.0)
    own = under[INSIDE] / np.float32(255)
    h, w = REGION.shape
    lips = (slice(h // 2 - 6, h // 2 + 2), slice(w // 2 - 8, w // 2 + 8))
    own[lips] += np.float32(0.15)
    rng = np.random.default_rng(0)
    got = composite_matched(under, own, COVER, np.eye(3), track(), REGION, rng)[INSIDE]
    np.testing.assert_allclose(got[lips], own[lips] * 255, atol=2)


def fine(picture):
    """Standard deviation of the differences of neighbours deep inside the cover [levels]."""
    grey = picture[INSIDE].astype(float).mean(-1)
    h, w = grey.shape
    return np.diff(grey[h // 3 : -h // 3, w // 3 : -w // 3], axis=1).std()


def test_grain_is_added_where_the_frame_has_some():
    own = np.full((*REGION.shape, 3), 0.5, np.float32)
    smooth = np.full((H, W, 3), 120, np.uint8)
    noise = np.random.default_rng(3).normal(0, 2, (H, W, 1))
    rough = np.clip(np.rint(smooth + noise), 0, 255).astype(np.uint8)

    def made(under, seed=0):
        rng = np.random.default_rng(seed)
        return composite_matched(under, own, COVER, np.eye(3), track(), REGION, rng)

    assert fine(made(smooth)) == 0
    assert 0.5 * fine(rough) < fine(made(rough)) < 1.5 * fine(rough)
    np.testing.assert_array_equal(made(rough), made(rough))
    assert (made(rough) != made(rough, seed=1)).any()


def test_no_more_grain_than_the_frame():
    own = image()
    under = frame()
    under[INSIDE] = np.rint(own * 255)
    rng = np.random.default_rng(0)
    got = composite_matched(under, own, COVER, np.eye(3), track(), REGION, rng)
    assert np.abs(got.astype(int) - under).max() <= 1


@pytest.mark.parametrize("grow", [0.8, 1.0, 1.3])
def test_what_is_not_looked_at_does_not_matter(grow):
    """Behind a hard edge, between pixels, and with the picture made larger or smaller."""
    hard = (COVER > 0.5).astype(np.float32)
    shown = looked_at(hard)
    assert hard.sum() < shown.sum() < shown.size
    other = np.where(shown[..., None], image(), 1 - image()).astype(np.float32)
    pose = shifted(0.37, 0.61) @ np.diag([grow, grow, 1.0])
    seen, same = (composite(frame(), i, hard, pose, track(), REGION) for i in (image(), other))
    np.testing.assert_array_equal(seen, same)
