"""The numbers of a report as HTML tables, from what `mmmgpu.evaluation` found."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

PARTS = {"all": "all frames", "speech": "speech only"}
KINDS = {
    "real": "real",
    "analysed": "real, as the model sees it",
    "pooled": "before training",
    "trained": "after training",
}


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """An HTML table whose first column is text, the others numbers; cells are escaped."""

    def row(cells: Sequence[str], tag: str) -> str:
        inner = (
            f"<{tag}{' class=n' * (i > 0)}>{escape(cell)}</{tag}>" for i, cell in enumerate(cells)
        )
        return f"<tr>{''.join(inner)}</tr>"

    body = "".join(row(cells, "td") for cells in rows)
    return f'<div class="scroll"><table>{row(head, "th")}{body}</table></div>'


def fact_table(facts: Mapping[str, str]) -> str:
    """A table of two columns."""
    rows = "".join(
        f"<tr><th>{escape(name)}</th><td>{escape(fact)}</td></tr>" for name, fact in facts.items()
    )
    return f"<table>{rows}</table>"


def error_table(evaluation: Mapping[str, Any]) -> str:
    """Errors of alpha and beta before and after training."""
    rows = []
    for stream, name in (("alpha", "movement (alpha)"), ("beta", "texture (beta)")):
        for part, where in PARTS.items():
            found = evaluation[stream][part]
            rows.append(
                [
                    f"{name}, {where}",
                    _interval(found["rms"]["pooled"], 4),
                    _interval(found["rms"]["trained"], 4),
                    _interval(found["rms_gain"], 4),
                    f"{found['correlation_trained']:.2f}",
                    f"{found['variance_ratio_pooled']:.2f}",
                    f"{found['variance_ratio_trained']:.2f}",
                ]
            )
    head = (
        "RMS error in model coordinates",
        *("before training", "after training", "gain"),
        *("correlation after", "liveliness before", "liveliness after"),
    )
    return table(head, rows) + (
        "<p>The gain is the error before less the error after training, clip by clip: above zero "
        "training has helped, and surely so where it is larger than its interval. Liveliness is "
        "the variance of the synthetic movement over that of the real one: 1 moves as much as the "
        "person, less mumbles.</p>"
    )


def lip_table(lips: Mapping[str, Any]) -> str:
    """Distances, opening and jitter of the lips, from landmarks."""
    jitter, silent = lips["jitter_px_silence"], lips["opening_px_silence"]
    rows = []
    for kind, name in KINDS.items():
        distance = lips["distance_px_speech"].get(kind)
        opening = lips["opening_speech"].get(kind)
        rows.append(
            [
                name,
                _interval(distance, 2) if distance else "",
                f"{opening['correlation']:.2f}" if opening else "",
                f"{opening['variance_ratio']:.2f}" if opening else "",
                f"{jitter[kind]:.3f}",
                f"{silent[kind]:.1f}",
            ]
        )
    head = (
        "lips",
        *("distance from real [px]", "correlation of opening", "liveliness of opening"),
        *("jitter in silence [px]", "height of the lips in silence [px]"),
    )
    return table(head, rows) + (
        "<p>Landmarks on the lips of the real clips against those of the reference moved by the "
        "model, in speech where not said otherwise. The second row is the best that the model's "
        "own coordinates could do.</p>"
    )


def picture_table(measured: Sequence[Mapping[str, Any]]) -> str:
    """PSNR and SSIM of reconstructions."""
    rows = [
        [
            f"{found['clip']}, {where}",
            f"{found[part]['psnr_db']:.1f}",
            f"{found[part]['worst_frame_db']:.1f}",
            f"{found[part]['ssim']:.3f}",
        ]
        for found in measured
        for part, where in (("speech", "speech"), ("silence", "silence"))
        if part in found
    ]
    return table(("reconstruction", "PSNR [dB]", "worst frame [dB]", "SSIM"), rows) + (
        "<p>Real clips drawn again from their model coordinates, compared with the original inside "
        "the outline of the lips scaled by 1.5. Above 35 dB the eye finds it hard to see a "
        "difference.</p>"
    )


def _interval(found: Mapping[str, Any], digits: int) -> str:
    half = found["half_width_95"]
    text = f"{found['mean']:.{digits}f}"
    return text if half is None else f"{text} ± {half:.{digits}f}"
