import numpy as np
import pytest
from worlds import texture

from mmmgpu.pictures import psnr, ssim


def pair(seed=0, noise=12):
    rng = np.random.default_rng(seed)
    a = np.rint(255 * texture(40, 52, seed=seed)).astype(np.uint8)
    b = np.clip(np.rint(a + rng.normal(0, noise, a.shape)), 0, 255).astype(np.uint8)
    where = np.zeros(a.shape[:2], bool)
    where[12:27, 10:37] = rng.random((15, 27)) > 0.3
    return a, b, where


def test_psnr_is_its_formula():
    a, b, where = pair()
    errors = [(float(p) - float(q)) ** 2 for p, q in zip(a[where].flat, b[where].flat, strict=True)]
    np.testing.assert_allclose(
        psnr(a, b, where), 20 * np.log10(255 / np.sqrt(sum(errors) / len(errors))), rtol=1e-12
    )


def test_one_level_everywhere_is_48_db():
    a = np.full((9, 7, 3), 100, np.uint8)
    everywhere = np.ones((9, 7), bool)
    np.testing.assert_allclose(psnr(a, a + 1, everywhere), 48.1308, atol=1e-4)
    np.testing.assert_allclose(psnr(a, a - 1, everywhere), 48.1308, atol=1e-4)
    np.testing.assert_allclose(psnr(255 - 0 * a, 0 * a, everywhere), 0.0, atol=1e-12)


def test_what_lies_elsewhere_does_not_count():
    a, b, where = pair()
    far = a.copy()
    far[:3] = 0
    assert psnr(a, far, where) == 99
    np.testing.assert_allclose(ssim(a, far, where), 1, rtol=1e-12)
    assert psnr(a, b, where) < 40


def ssim_oracle(a, b, where):
    """Wang et al. 2004, Eq. 13-16, window by window and channel by channel."""
    across = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    weight = np.outer(across, across)
    weight /= weight.sum()
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    scores = []
    for y, x in zip(*np.nonzero(where), strict=True):
        window = (slice(y - 5, y + 6), slice(x - 5, x + 6))
        for channel in range(3):
            p, q = a[window][..., channel].astype(float), b[window][..., channel].astype(float)
            mp, mq = (weight * p).sum(), (weight * q).sum()
            vp, vq = (weight * (p - mp) ** 2).sum(), (weight * (q - mq) ** 2).sum()
            both = (weight * (p - mp) * (q - mq)).sum()
            score = (2 * mp * mq + c1) * (2 * both + c2)
            scores.append(score / ((mp**2 + mq**2 + c1) * (vp + vq + c2)))
    return np.mean(scores)


@pytest.mark.parametrize("noise", [0, 4, 40])
def test_ssim_is_its_formula(noise):
    a, b, where = pair(1, noise)
    np.testing.assert_allclose(ssim(a, b, where), ssim_oracle(a, b, where), rtol=1e-9)


def test_ssim_works_at_the_edge_of_the_picture():
    a, b, _ = pair(2)
    corner = np.zeros(a.shape[:2], bool)
    corner[:4, -4:] = True
    np.testing.assert_allclose(ssim(a, a, corner), 1, rtol=1e-12)
    assert 0 < ssim(a, b, corner) < 1
