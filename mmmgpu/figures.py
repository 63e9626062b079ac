"""Pictures of a report: as data URIs, as inline SVG, and the drawing on top of video frames.

Everything is drawn through Matplotlib's objects, never through pyplot: there is no global state,
and no window system is asked for. It is imported when something is drawn: a command that may write
a report need not wait for it.
"""

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mmmgpu.phones import SIL

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Bytes = NDArray[np.uint8]
Floats = NDArray[np.floating[Any]]

INK = "#010203"  # of text and frames: replaced by the colour of the page's text, light or dark
_BEFORE = {"color": "#d9730d", "linewidth": 1.4, "linestyle": (0, (4, 2))}
_AFTER = {"color": "#1d7fd6", "linewidth": 1.8}
STYLES: Mapping[str, Mapping[str, Any]] = {
    "real": {"color": INK, "linewidth": 2.6, "alpha": 0.45},
    "before training": _BEFORE,
    "after training": _AFTER,
    "before adaptation": _BEFORE,
    "after adaptation": _AFTER,
}
QUALITY = 90  # of JPEG
CAPTION_HEIGHT = 28  # [px]


@dataclass(frozen=True)
class Panel:
    """One row of a chart: curves by name, each (T,), and what they measure."""

    ylabel: str
    curves: Mapping[str, Floats]


def to_bytes(image: NDArray[Any]) -> Bytes:
    """An RGB picture, uint8 or float in [0, 1], as uint8."""
    if image.dtype == np.uint8:
        return image
    return np.asarray(np.rint(np.clip(image, 0, 1) * 255), np.uint8)


def enlarged(image: NDArray[Any], scale: float) -> Bytes:
    """A picture `scale` times as large."""
    flags = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    larger = cv2.resize(to_bytes(image), None, fx=scale, fy=scale, interpolation=flags)
    return np.asarray(larger, np.uint8)


def jpeg_uri(image: NDArray[Any]) -> str:
    """A picture (H, W, 3), RGB, as a ``data:`` address."""
    settings = [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
    _, data = cv2.imencode(".jpg", to_bytes(image)[..., ::-1], settings)
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def flow_arrows(image: NDArray[Any], flow: Floats, *, scale: int = 4, across: int = 12) -> Bytes:
    """`image` (h, w, 3), `scale` times as large, with `across` arrows of `flow` from side to side.

    Arrows shorter than a pixel are left out.
    """
    picture = np.ascontiguousarray(enlarged(image, scale))
    step = max(1, round(flow.shape[1] / across))
    for y in range(step // 2, flow.shape[0], step):
        for x in range(step // 2, flow.shape[1], step):
            moved = np.asarray(flow[y, x], float)
            if np.hypot(*moved) < 1:
                continue
            start, end = (
                tuple(int(v) for v in np.rint((at + 0.5) * scale))
                for at in (np.array([x, y]), np.array([x, y]) + moved)
            )
            for colour, thickness in (((0, 0, 0), 4), ((255, 230, 60), 2)):
                cv2.arrowedLine(picture, start, end, colour, thickness, cv2.LINE_AA, tipLength=0.25)
    return picture


def outlined(
    image: NDArray[Any],
    masks: Sequence[tuple[Floats, tuple[int, int, int]]],
    corner: tuple[int, int],
    *,
    scale: int = 2,
) -> Bytes:
    """`image`, `scale` times as large, with the half-way line of each (mask, colour).

    corner: (x, y) [px] of the masks in the picture.
    """
    picture = np.ascontiguousarray(enlarged(image, scale))
    for mask, colour in masks:
        large = cv2.resize(np.asarray(mask, np.float32), None, fx=scale, fy=scale)
        inside = np.asarray(large > 0.5, np.uint8)
        at = (corner[0] * scale, corner[1] * scale)
        lines, _ = cv2.findContours(inside, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=at)
        cv2.drawContours(picture, lines, -1, colour, 2, cv2.LINE_AA)
    return picture


def seen_through(image: NDArray[Any], mask: Floats) -> Bytes:
    """`image` (h, w, 3) where `mask` (h, w) is 1, grey where it is 0."""
    share = np.asarray(mask)[..., None]
    return np.asarray(np.rint(to_bytes(image) * share + 128 * (1 - share)), np.uint8)


def _figure(**settings: Any) -> "Figure":
    from matplotlib.figure import Figure

    return Figure(**settings)


def captions(texts: Sequence[str], width: int) -> Bytes:
    """A dark strip with a text in the middle of each of its parts, `width` [px] each.

    Shape (CAPTION_HEIGHT, len(texts) * width, 3) uint8.
    """
    size = len(texts) * width, CAPTION_HEIGHT
    figure = _figure(figsize=(size[0] / 100, size[1] / 100), dpi=100, facecolor="#1c1e22")
    for i, text in enumerate(texts):
        middle = (i + 0.5) / len(texts)
        figure.text(middle, 0.48, text, color="white", fontsize=9.5, ha="center", va="center")
    pixels = io.BytesIO()
    figure.savefig(pixels, format="rgba", dpi=100)
    strip = np.frombuffer(pixels.getvalue(), np.uint8).reshape(size[1], size[0], 4)
    return np.ascontiguousarray(strip[..., :3])


def curves(panels: Sequence[Panel], labels: Sequence[str], fps: float) -> str:
    """Curves over time, one panel below the other, with the phones along the top: inline SVG.

    labels: phone of every frame, length T. fps: frames a second.
    """
    times = np.arange(len(labels)) / fps
    figure = _figure(figsize=(10, 0.8 + 1.5 * len(panels)), layout="constrained")
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axis, panel in zip(axes, panels, strict=True):
        for name, values in panel.curves.items():
            axis.plot(times, values, label=name, **STYLES[name])
        axis.set_ylabel(panel.ylabel, fontsize=9)
        axis.margins(x=0)
        _draw_phones(axis, labels, fps, named=axis is axes[0])
    axes[-1].set_xlabel("time [s]")
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper left", ncols=3, frameon=False, fontsize=9)
    return to_svg(figure)


def _draw_phones(axis: Any, labels: Sequence[str], fps: float, *, named: bool) -> None:
    """Silences shaded, a hairline between phones, and their names above, where wanted."""
    start = 0
    for label, run in groupby(labels):
        end = start + len(list(run))
        if label == SIL:
            axis.axvspan(start / fps, end / fps, color="#8888", alpha=0.15, linewidth=0)
        axis.axvline(start / fps, color=INK, linewidth=0.4, alpha=0.3)
        if named:
            middle = (start + end) / 2 / fps
            above = axis.get_xaxis_transform()
            axis.text(middle, 1.02, label, transform=above, ha="center", va="bottom", fontsize=7)
        start = end


def learning_curve(errors: Mapping[str, Floats]) -> str:
    """Mean squared errors (I + 1,) by name, each as a share of its first: inline SVG."""
    figure = _figure(figsize=(5.5, 2.6), layout="constrained")
    axis = figure.subplots()
    for (name, values), colour in zip(errors.items(), ("#1d7fd6", "#d9730d"), strict=False):
        axis.plot(np.arange(len(values)), 100 * values / values[0], label=name, color=colour)
    axis.set_xlabel("iteration")
    axis.set_ylabel("error [% of pooled]")
    axis.legend(frameon=False, fontsize=9)
    return to_svg(figure)


def to_svg(figure: "Figure") -> str:
    """A figure as inline SVG: text stays text, ink takes the page's colour, no background."""
    from matplotlib import rc_context

    for axis in figure.axes:
        axis.patch.set_alpha(0)
        axis.tick_params(colors=INK, labelsize=8)
        axis.spines[["top", "right"]].set_visible(False)
        axis.spines[["left", "bottom"]].set_edgecolor(INK)
        for text in (axis.xaxis.label, axis.yaxis.label, *axis.texts):
            text.set_color(INK)
    for legend in (*figure.legends, *(axis.get_legend() for axis in figure.axes)):
        for text in legend.get_texts() if legend else ():
            text.set_color(INK)
    page = io.StringIO()
    # ids from the drawing itself: the same figure is the same text
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "mmmgpu"}):
        figure.savefig(page, format="svg", metadata={"Date": None}, transparent=True)
    drawing = page.getvalue()
    return drawing[drawing.index("<svg") :].replace(INK, "currentColor")
