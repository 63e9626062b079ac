import weakref

import numpy as np
import pytest

from mmmgpu.errors import InputError
from mmmgpu.prototypes import (
    COMPONENTS,
    choose_prototypes,
    most_neutral,
    principal_coordinates,
)


def thumbnails(lengths, *, rank=6, pixels=60, seed=0):
    """Clips of byte pictures that vary in `rank` directions of falling strength."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(rank, pixels))
    strength = 30 * 0.6 ** np.arange(rank)
    return [
        np.clip(128 + rng.normal(size=(n, rank)) * strength @ directions / 3, 0, 255)
        .round()
        .astype(np.uint8)
        for n in lengths
    ]


def full_pca(clips, components):
    """Whitened coordinates by a singular value decomposition of everything at once."""
    stacked = np.concatenate(clips).astype(np.float64)
    centred = stacked - stacked.mean(axis=0)
    u, _, _ = np.linalg.svd(centred, full_matrices=False)
    return u[:, :components] * np.sqrt(len(stacked) - 1)


@pytest.mark.parametrize("lengths", [(70, 3, 200, 40), (90,), (1, 1, 30, 2)])
def test_coordinates_are_those_of_a_full_pca(lengths):
    clips = thumbnails(lengths)
    got = principal_coordinates(clips)
    assert got.shape == (sum(lengths), COMPONENTS)
    assert got.dtype == np.float32
    wanted = full_pca(clips, 4)
    sign = np.sign((got[:, :4] * wanted).sum(axis=0))
    np.testing.assert_allclose(got[:, :4] * sign, wanted, atol=0.02)


def test_coordinates_are_white():
    got = principal_coordinates(thumbnails((150, 80, 170)))
    np.testing.assert_allclose(got.mean(axis=0), 0, atol=1e-3)
    np.testing.assert_allclose(np.cov(got[:, :6].T), np.eye(6), atol=0.02)


def test_few_frames_have_few_components():
    got = principal_coordinates(thumbnails((4, 5)))
    assert got.shape[0] == 9
    assert got.shape[1] <= 9
    assert np.isfinite(got).all()


def test_directions_without_variance_do_not_count():
    """A dozen pictures seen three times: noise of the last bits must not be whitened."""
    pictures = thumbnails((12,))[0]
    assert principal_coordinates([pictures] * 3).shape == (36, 11)


def test_clips_are_never_held_all_at_once():
    clips = thumbnails((40,) * 12)
    given, most = [], 0

    class Lazy:
        def __len__(self):
            return len(clips)

        def __getitem__(self, i):
            nonlocal most
            clip = clips[i].copy()
            given.append(weakref.ref(clip))
            most = max(most, sum(reference() is not None for reference in given))
            return clip

    np.testing.assert_array_equal(principal_coordinates(Lazy()), principal_coordinates(clips))
    assert most <= 3


def clouds(seed=0):
    """Five tight clouds of 30 points and their centres."""
    rng = np.random.default_rng(seed)
    centres = 20 * rng.normal(size=(5, 3))
    points = np.repeat(centres, 30, axis=0) + rng.normal(size=(150, 3))
    return points.astype(np.float32), centres


def test_each_cloud_gives_the_frame_nearest_to_its_centre():
    points, _ = clouds()
    chosen = choose_prototypes(points, 5, seed=1)
    assert chosen.tolist() == sorted(chosen.tolist())
    for k, i in enumerate(chosen):
        cloud = points[30 * k : 30 * k + 30].astype(np.float64)
        distance = np.linalg.norm(cloud - cloud.mean(axis=0), axis=1)
        assert i == 30 * k + distance.argmin()


@pytest.mark.filterwarnings("ignore:Number of distinct clusters")
@pytest.mark.parametrize("count", [1, 7, 20])
def test_prototypes_are_distinct_even_of_equal_frames(count):
    points = np.tile(np.random.default_rng(0).normal(size=(10, 2)), (2, 1))
    chosen = choose_prototypes(points.astype(np.float32), count, seed=0)
    assert len(set(chosen.tolist())) == count


def test_same_seed_same_prototypes():
    points = np.random.default_rng(5).normal(size=(200, 4)).astype(np.float32)
    again = choose_prototypes(points, 12, seed=3)
    np.testing.assert_array_equal(choose_prototypes(points, 12, seed=3), again)
    assert (choose_prototypes(points, 12, seed=4) != again).any()


def test_too_few_frames_are_an_error():
    with pytest.raises(InputError, match=r"4 usable frames .* 5 prototypes; .*--prototypes"):
        choose_prototypes(np.zeros((4, 2), np.float32), 5, seed=0)


def test_the_reference_is_like_silence():
    points = np.array([[0], [1], [2], [3], [20], [21], [90]], np.float32)
    silent = np.array([0, 0, 0, 0, 1, 1, 1], bool)
    chosen = np.array([0, 2, 5, 6])
    assert most_neutral(points, chosen, silent) == 2  # the median of silence; its mean is 43.7
    assert most_neutral(points, chosen, ~silent) == 1
    assert most_neutral(points, chosen, np.zeros(7, bool)) == 1  # the median of all is 3
