"""How alike two pictures are: PSNR and SSIM over a part of them."""

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]


def psnr(a: Picture, b: Picture, where: NDArray[np.bool_]) -> float:
    """Peak signal-to-noise ratio [dB] of two RGB pictures over the pixels `where`; 99 if equal."""
    mse = float(np.mean((a[where].astype(np.float64) - b[where]) ** 2))
    return 99.0 if mse == 0 else float(10 * np.log10(255**2 / mse))


def ssim(a: Picture, b: Picture, where: NDArray[np.bool_]) -> float:
    """Mean structural similarity over the pixels `where`, averaged over the channels.

    Gaussian window of deviation 1.5 px, K1 = 0.01, K2 = 0.03 (Wang et al. 2004).
    """
    rows, columns = np.nonzero(where)
    box = (
        slice(max(rows.min() - 8, 0), rows.max() + 9),
        slice(max(columns.min() - 8, 0), columns.max() + 9),
    )
    x, y = a[box].astype(np.float64), b[box].astype(np.float64)

    def smooth(z: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(cv2.GaussianBlur(z, (11, 11), 1.5))

    mx, my = smooth(x), smooth(y)
    vx, vy, vxy = smooth(x * x) - mx**2, smooth(y * y) - my**2, smooth(x * y) - mx * my
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    score = (2 * mx * my + c1) * (2 * vxy + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
    return float(score[where[box]].mean())
