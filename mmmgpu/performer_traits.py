"""What one built-in performer is: the numbers that a seed draws, and nothing that moves.

Lengths are in face units: 1 is the width of the face at the cheekbones (about 140 mm). The origin
is between the pupils, x grows to the right of the picture, y downwards, z towards the viewer.
Colours are linear light in [0, 1].
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Colour = tuple[float, float, float]
Field = NDArray[np.floating[Any]]  # float32 where pictures are made, float64 where points are moved
SUPERSAMPLING = 2
_VIEW_UNITS = 2.06  # height (or width, if smaller) of the picture in face units
_VIEW_CENTRE = 0.075


@dataclass(frozen=True)
class Shape:
    """Geometry of the head [face units]."""

    jaw_width: float
    chin: float
    eye_x: float
    eye_width: float
    eye_open: float
    eye_tilt: float
    brow_height: float
    brow_thickness: float
    brow_arch: float
    nose_width: float
    nose_base: float
    nose_depth: float
    mouth: float
    mouth_width: float
    upper_lip: float
    lower_lip: float
    cupid: float
    seam_curve: float
    cheek: float
    fold: float
    skull: float
    neck: float
    shoulder: float


@dataclass(frozen=True)
class Skin:
    """Colours and fine texture of the skin, lips, eyes and teeth."""

    base: Colour
    blush: float
    freckles: float
    stubble: float
    roughness: float
    gloss: float
    lip: Colour
    iris: Colour
    teeth: Colour


@dataclass(frozen=True)
class Hair:
    """Hair and clothes: `style` "short", "side", "long" or "tied", `neckline` "crew" or "vee"."""

    style: str
    colour: Colour
    hairline: float
    recess: float
    volume: float
    parting: float
    shirt: Colour
    neckline: str
    background: Colour


@dataclass(frozen=True)
class Light:
    """Directions (unit vectors towards the light) and strengths of key, fill and ambient light."""

    key_direction: tuple[float, float, float]
    fill_direction: tuple[float, float, float]
    key: float
    fill: float
    ambient: float
    warmth: float


@dataclass(frozen=True)
class Style:
    """How the performer speaks: scale of the movement, time constants [s], habits."""

    amplitude: float
    anticipation: float
    smoothness: float
    spread: float
    rounding: float
    head_motion: float
    blink_interval: float
    targets_seed: int


@dataclass(frozen=True)
class Performer:
    """One talking face: geometry, skin, hair, light and speaking style.

    `seed` also fixes every texture. `size` is (height, width) [px] of the pictures.
    """

    seed: int
    size: tuple[int, int]
    shape: Shape
    skin: Skin
    hair: Hair
    light: Light
    style: Style

    @property
    def scale(self) -> float:
        """Output pixels per face unit."""
        return min(self.size) / _VIEW_UNITS

    @property
    def origin(self) -> tuple[float, float]:
        """Position (x, y) [px] of the face's origin, the pixel centres being whole numbers."""
        height, width = self.size
        return (width - 1) / 2, (height - 1) / 2 - _VIEW_CENTRE * self.scale


def draw_performer(seed: int, size: tuple[int, int]) -> Performer:
    """Draw a performer; the same seed gives the same person at every size."""
    rng = np.random.default_rng(seed)
    male = float(rng.uniform() < 0.5) * 0.75 + rng.uniform(0, 0.25)
    tone = float(rng.beta(1.3, 1.9))
    return Performer(
        seed=seed,
        size=size,
        shape=_draw_shape(rng, male),
        skin=_draw_skin(rng, male, tone),
        hair=_draw_hair(rng, male, tone),
        light=_draw_light(rng),
        style=_draw_style(rng),
    )


def _around(rng: np.random.Generator, mean: float, spread: float) -> float:
    """A draw from a normal cut at two deviations."""
    return mean + spread * float(np.clip(rng.normal(), -2, 2))


def _mix(a: Colour, b: Colour, t: float) -> Colour:
    """Colour between `a` (t = 0) and `b` (t = 1)."""
    return (
        a[0] + (b[0] - a[0]) * t,
        a[1] + (b[1] - a[1]) * t,
        a[2] + (b[2] - a[2]) * t,
    )


def _draw_shape(rng: np.random.Generator, male: float) -> Shape:
    mouth = _around(rng, 0.49, 0.01)
    return Shape(
        jaw_width=_around(rng, 0.97 + 0.07 * male, 0.03),
        chin=_around(rng, 0.790 + 0.035 * male, 0.018),
        eye_x=_around(rng, 0.222, 0.006),
        eye_width=_around(rng, 0.112, 0.004),
        eye_open=_around(rng, 0.079 - 0.011 * male, 0.006),
        eye_tilt=_around(rng, 0.010, 0.004),
        brow_height=_around(rng, 0.150 - 0.016 * male, 0.008),
        brow_thickness=_around(rng, 0.024 + 0.011 * male, 0.003),
        brow_arch=_around(rng, 0.022 - 0.012 * male, 0.004),
        nose_width=_around(rng, 0.118 + 0.014 * male, 0.009),
        nose_base=_around(rng, mouth - 0.152, 0.006),
        nose_depth=_around(rng, 0.150, 0.012),
        mouth=mouth,
        mouth_width=_around(rng, 0.187, 0.010),
        upper_lip=_around(rng, 0.058 - 0.012 * male, 0.007),
        lower_lip=_around(rng, 0.074 - 0.010 * male, 0.008),
        cupid=_around(rng, 0.16, 0.05),
        seam_curve=_around(rng, -0.012, 0.004),
        cheek=_around(rng, 1.0, 0.2),
        fold=_around(rng, 0.8 + 0.4 * male, 0.2),
        skull=_around(rng, 0.80, 0.015),
        neck=_around(rng, 0.255 + 0.065 * male, 0.012),
        shoulder=_around(rng, 1.12 + 0.06 * male, 0.03),
    )


def _draw_skin(rng: np.random.Generator, male: float, tone: float) -> Skin:
    light, mid, deep = (0.72, 0.47, 0.36), (0.50, 0.285, 0.19), (0.21, 0.105, 0.066)
    base = _mix(light, mid, 2 * tone) if tone < 0.5 else _mix(mid, deep, 2 * tone - 1)
    red = (0.52, 0.16, 0.145) if tone < 0.6 else (0.26, 0.085, 0.075)
    irises = [(0.085, 0.12, 0.155), (0.08, 0.09, 0.05), (0.10, 0.052, 0.022), (0.05, 0.026, 0.014)]
    iris = irises[int(rng.integers(0, 4) if tone < 0.35 else rng.integers(2, 4))]
    return Skin(
        base=base,
        blush=_around(rng, 0.5, 0.12),
        freckles=float(rng.uniform(0.4, 1) * (rng.uniform() < 0.4) * (tone < 0.4)),
        stubble=float(rng.uniform(0.2, 1) * (male > 0.5)),
        roughness=_around(rng, 1.0, 0.25),
        gloss=_around(rng, 1.0, 0.2),
        lip=_mix(base, red, _around(rng, 0.78 - 0.25 * male, 0.06)),
        iris=iris,
        teeth=_mix((0.88, 0.76, 0.62), (0.92, 0.84, 0.74), float(rng.uniform())),
    )


def _draw_hair(rng: np.random.Generator, male: float, tone: float) -> Hair:
    black, brown, light = (0.012, 0.009, 0.008), (0.060, 0.030, 0.015), (0.30, 0.18, 0.075)
    red, grey = (0.20, 0.065, 0.022), (0.22, 0.21, 0.20)
    choice = [black, brown] if tone > 0.4 else [brown, light, red, brown, grey, black]
    colour = _mix(choice[int(rng.integers(len(choice)))], brown, float(rng.uniform(0, 0.35)))
    shirts = [(0.06, 0.09, 0.16), (0.17, 0.17, 0.18), (0.20, 0.05, 0.05), (0.05, 0.12, 0.10)]
    walls = [(0.20, 0.24, 0.28), (0.28, 0.27, 0.25), (0.17, 0.22, 0.21), (0.24, 0.21, 0.25)]
    styles = ["short", "side"] if male > 0.5 else ["long", "tied", "side"]
    return Hair(
        style=str(rng.choice(styles)),
        colour=colour,
        hairline=_around(rng, -0.455, 0.02),
        recess=_around(rng, 0.02 + 0.03 * male, 0.01),
        volume=_around(rng, 0.055 if male > 0.5 else 0.075, 0.01),
        parting=float(rng.choice([-1, 1])) * _around(rng, 0.16, 0.03),
        shirt=shirts[int(rng.integers(len(shirts)))],
        neckline=str(rng.choice(["crew", "vee"])),
        background=walls[int(rng.integers(len(walls)))],
    )


def _unit(x: float, y: float, z: float) -> tuple[float, float, float]:
    n = (x * x + y * y + z * z) ** 0.5
    return x / n, y / n, z / n


def _draw_light(rng: np.random.Generator) -> Light:
    side = float(rng.choice([-1, 1]))
    return Light(
        key_direction=_unit(side * _around(rng, 0.48, 0.08), _around(rng, -0.52, 0.08), 0.75),
        fill_direction=_unit(-side * 0.75, -0.05, 0.65),
        key=_around(rng, 0.86, 0.05),
        fill=_around(rng, 0.26, 0.04),
        ambient=_around(rng, 0.20, 0.02),
        warmth=_around(rng, 0.0, 0.03),
    )


def _draw_style(rng: np.random.Generator) -> Style:
    return Style(
        amplitude=_around(rng, 1.0, 0.10),
        anticipation=_around(rng, 0.055, 0.010),
        smoothness=_around(rng, 0.032, 0.005),
        spread=_around(rng, 0.0, 0.04),
        rounding=_around(rng, 1.0, 0.08),
        head_motion=_around(rng, 1.0, 0.25),
        blink_interval=_around(rng, 3.2, 0.6),
        targets_seed=int(rng.integers(2**31)),
    )
