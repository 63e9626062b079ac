"""Light on skin: a height field, an albedo and two lights make a picture.

Diffuse light wraps around the shape, further for red than for blue, which is what scattering under
the skin looks like from afar; gloss is a broad Blinn-Phong lobe. All colours are linear light;
`to_bytes` encodes them with a square root, close to sRGB and quick.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from mmmgpu.performer_traits import Field, Light

Image = Field
_STEEPEST = 1.35
_WRAP = (0.42, 0.26, 0.19)
_KEY_COLOUR = (1.06, 1.00, 0.92)
_BOUNCE_COLOUR = (1.10, 0.85, 0.72)
_FILL_COLOUR = (0.90, 0.98, 1.10)


def blur(image: Image, sigma: float) -> Image:
    """Gaussian blur, `sigma` [px]."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.float32)


def smoothstep(low: float | Field, high: float | Field, x: Field) -> Image:
    """0 below `low`, 1 above `high`, a cubic between; `low` may be the larger one."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t), dtype=np.float32)


def noise(rng: np.random.Generator, shape: tuple[int, int], cell: tuple[float, float]) -> Image:
    """Smooth noise of unit variance; `cell` is the size (x, y) [px] of its grain."""
    rows = max(int(shape[0] / cell[1]) + 3, 4)
    cols = max(int(shape[1] / cell[0]) + 3, 4)
    grid = rng.normal(size=(rows, cols)).astype(np.float32)
    field = cv2.resize(grid, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    return np.asarray(field / max(float(field.std()), 1e-6), dtype=np.float32)


def normals(height: Image, px_per_unit: float) -> tuple[Image, Image, Image]:
    """Unit normals (x, y, z) of a height field in face units; steep slopes are made gentler."""
    gain = px_per_unit / 8
    gx = cv2.Sobel(height, cv2.CV_32F, 1, 0, scale=gain)
    gy = cv2.Sobel(height, cv2.CV_32F, 0, 1, scale=gain)
    gentle = 1 / np.sqrt(1 + (gx * gx + gy * gy) / _STEEPEST**2)
    gx, gy = gx * gentle, gy * gentle
    nz = 1 / np.sqrt(1 + gx * gx + gy * gy)
    return -gx * nz, -gy * nz, nz


def shade(
    albedo: Image, height: Image, lit: Image, gloss: Image, light: Light, px_per_unit: float
) -> Image:
    """Radiance of a surface, shape (H, W, 3).

    `lit` (H, W) is the share of light that is not occluded; `gloss` (H, W) scales the highlights.
    """
    nx, ny, nz = normals(height, px_per_unit)
    key = _facing(nx, ny, nz, light.key_direction)
    fill = _facing(nx, ny, nz, light.fill_direction)
    sky = light.ambient * (0.75 - 0.30 * ny) * lit
    bounce = light.ambient * 0.9 * np.maximum(ny, 0) * lit
    out = np.empty_like(albedo)
    shine = gloss * light.key * _highlight(nx, ny, nz, light.key_direction) * lit
    warmth = (1 + light.warmth, 1.0, 1 - light.warmth)
    for c in range(3):
        w = _WRAP[c]
        direct = light.key * _KEY_COLOUR[c] * warmth[c] * np.maximum((key + w) / (1 + w), 0)
        soft = light.fill * _FILL_COLOUR[c] * np.maximum((fill + w) / (1 + w), 0)
        shadow = lit ** (1.0 - 0.5 * w)  # shadows on skin are red at their edges
        out[..., c] = (
            albedo[..., c] * ((direct + soft) * shadow + sky + bounce * _BOUNCE_COLOUR[c]) + shine
        )
    return out


def _facing(nx: Image, ny: Image, nz: Image, d: tuple[float, float, float]) -> Image:
    return np.asarray(nx * np.float32(d[0]) + ny * np.float32(d[1]) + nz * np.float32(d[2]))


def _highlight(nx: Image, ny: Image, nz: Image, d: tuple[float, float, float]) -> Image:
    """Blinn-Phong: a broad lobe for skin and a tight one for what is wet or oily."""
    half = np.array([d[0], d[1], d[2] + 1])
    half /= np.linalg.norm(half)
    h = np.maximum(_facing(nx, ny, nz, (float(half[0]), float(half[1]), float(half[2]))), 0)
    h4 = h * h
    h4 = h4 * h4
    h16 = h4 * h4
    h16 = h16 * h16
    h32 = h16 * h16
    return np.asarray(0.10 * h16 + 0.10 * h32 * h32, dtype=np.float32)


def occlusion(height: Image, px_per_unit: float, strength: float = 1.0) -> Image:
    """Share of the sky seen from a height field: hollows are dark, at three scales."""
    open_sky = np.ones_like(height)
    for radius, depth in ((0.012, 10.0), (0.035, 5.0), (0.10, 1.8)):
        hollow = blur(height, radius * px_per_unit) - height
        open_sky *= 1 / (1 + strength * depth * np.maximum(hollow, 0))
    return open_sky


def cast_shadow(height: Image, light: Light, px_per_unit: float, softness: float) -> Image:
    """Share of the key light that reaches each point past the rest of the height field."""
    lx, ly, lz = light.key_direction
    reach = np.full_like(height, -1.0)
    for step in np.linspace(0.02, 0.34, 24):
        shift = np.array([[1, 0, step * lx * px_per_unit], [0, 1, step * ly * px_per_unit]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        size = height.shape[::-1]
        other = cv2.warpAffine(height, shift, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        np.maximum(reach, (other - height - step * lz) / step, out=reach)
    return 1 - smoothstep(-softness, softness, reach)


def to_bytes(linear: Image) -> NDArray[np.uint8]:
    """Encode linear light as 8-bit display values, with a soft shoulder above 0.8."""
    x = np.maximum(linear, 0)
    x = np.where(x > 0.6, 0.6 + 0.4 * np.tanh((x - 0.6) / 0.4), x)
    return np.asarray(np.sqrt(x) * 255 + 0.5, dtype=np.uint8)
