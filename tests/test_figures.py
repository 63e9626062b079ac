import base64
import subprocess
import sys
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from worlds import texture

from mmmgpu.figures import (
    CAPTION_HEIGHT,
    INK,
    Panel,
    captions,
    curves,
    enlarged,
    flow_arrows,
    jpeg_uri,
    learning_curve,
    outlined,
    seen_through,
    to_bytes,
)

YELLOW = (255, 230, 60)
LABELS = ("SIL", "SIL", "M", "AA", "AA", "SIL")


@pytest.fixture
def picture():
    return texture(20, 30)


def colour_places(image, colour):
    """(x, y) of the pixels of `image` within 40 of `colour`, (n, 2)."""
    near = np.abs(image.astype(int) - colour).max(axis=-1) <= 40
    return np.argwhere(near)[:, ::-1]


def texts(svg):
    return [e.text for e in ElementTree.fromstring(svg).iter() if e.tag.endswith("}text")]


def test_bytes_round_and_clip():
    values = np.array([[[-0.1, 0.5, 1.2]]])
    assert to_bytes(values).tolist() == [[[0, 128, 255]]]


def test_a_data_address_is_the_picture_in_its_own_colours():
    image = np.full((16, 24, 3), (200, 60, 20), np.uint8)
    kind, data = jpeg_uri(image).split(",")
    decoded = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    assert kind == "data:image/jpeg;base64"
    np.testing.assert_allclose(decoded[..., ::-1], image, rtol=0, atol=4)


def test_no_flow_draws_nothing(picture):
    drawn = flow_arrows(picture, np.zeros((20, 30, 2)), scale=4)
    np.testing.assert_array_equal(drawn, enlarged(picture, 4))


def test_an_arrow_goes_from_the_pixel_to_where_it_has_gone():
    flow = np.zeros((21, 21, 2))
    flow[10, 10] = (8, 4)
    black = np.zeros((21, 21, 3), np.uint8)
    places = colour_places(flow_arrows(black, flow, scale=4, across=1), YELLOW)
    assert np.abs(places - [42, 42]).sum(axis=1).min() <= 1
    assert np.abs(places - [74, 58]).sum(axis=1).min() <= 1
    assert places.min() >= 40
    assert places.max() <= 76


def test_drawing_leaves_the_picture_alone(picture):
    before = picture.copy()
    flow_arrows(picture, np.full((20, 30, 2), 3.0), scale=1)
    outlined(picture, [(np.pad(np.ones((4, 4)), 3), (255, 0, 0))], (2, 2), scale=1)
    np.testing.assert_array_equal(picture, before)


def test_outlines_follow_the_mask_at_its_corner():
    mask = np.pad(np.ones((6, 8)), 2)
    black = np.zeros((40, 40, 3), np.uint8)
    places = colour_places(outlined(black, [(mask, YELLOW)], (10, 20), scale=2), YELLOW)
    first, last = places.min(axis=0), places.max(axis=0)
    np.testing.assert_allclose(first, (24, 44), rtol=0, atol=2)
    np.testing.assert_allclose(last, (39, 55), rtol=0, atol=2)


def test_a_mask_shows_the_picture_or_grey(picture):
    mask = np.zeros((20, 30))
    mask[:, 15:] = 1
    shown = seen_through(picture, mask)
    assert (shown[:, :15] == 128).all()
    np.testing.assert_array_equal(shown[:, 15:], to_bytes(picture)[:, 15:])


def test_each_caption_stands_in_the_middle_of_its_part():
    strip = captions(["left", "", "right"], 100)
    assert strip.shape == (CAPTION_HEIGHT, 300, 3)
    columns = np.flatnonzero((strip.max(axis=-1) > 150).any(axis=0))
    parts = [columns[columns // 100 == i] % 100 for i in range(3)]
    assert len(parts[1]) == 0
    for part in (parts[0], parts[2]):
        assert abs((part.min() + part.max()) / 2 - 50) < 3


def test_curves_name_every_phone_once_a_run_and_every_curve():
    panel = Panel("lips apart [px]", {"real": np.arange(6.0), "after training": np.ones(6)})
    svg = curves([panel, Panel("alpha", {"real": np.zeros(6)})], LABELS, 25.0)
    assert [t for t in texts(svg) if t in LABELS] == ["SIL", "M", "AA", "SIL"]
    assert {"lips apart [px]", "alpha", "real", "after training", "time [s]"} <= set(texts(svg))


def test_drawings_take_the_colour_of_the_page():
    for svg in (
        curves([Panel("y", {"real": np.arange(6.0)})], LABELS, 25.0),
        learning_curve({"alpha": np.array([2.0, 1.0])}),
    ):
        assert "currentColor" in svg
        assert INK not in svg
        ElementTree.fromstring(svg)  # or it is no XML


def test_a_drawing_is_always_the_same_text():
    first, second = (learning_curve({"alpha": np.array([2.0, 1.0])}) for _ in range(2))
    assert first == second


def test_the_learning_curve_is_in_percent_of_its_beginning():
    marks = [t for t in texts(learning_curve({"alpha": np.array([0.4, 0.2])})) if t]
    numbers = [float(t) for t in marks if t.replace(".", "").isdecimal()]
    assert max(numbers) == 100
    assert 50 in numbers


def test_pyplot_is_never_loaded():
    code = (
        "import sys; from mmmgpu.figures import captions; captions(['x'], 40);"
        "sys.exit('matplotlib.pyplot' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
