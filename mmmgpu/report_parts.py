"""The parts that a report is put together from: the page, pictures with captions, videos."""

import base64
import os
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmmgpu.figures import enlarged, jpeg_uri, to_bytes
from mmmgpu.tracks import frame_at
from mmmgpu.videos import probe

LARGEST_VIDEO = 4_000_000  # bytes of a video that is put into the page; larger ones are linked
LARGEST_TILE = 150  # [px] height of a small picture

PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
:root {{ color-scheme: light dark; --line: #8885; --back: #8881; }}
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 0 auto; padding: 1rem; }}
h1 {{ font-size: 1.6rem; }} h2 {{ font-size: 1.25rem; margin-top: 2.5rem; }}
figure {{ margin: 1rem 0; }} figcaption {{ font-size: .85rem; opacity: .85; }}
img, video {{ max-width: 100%; height: auto; border-radius: 4px; display: block; }}
.tiles {{ display: grid; gap: .6rem; grid-template-columns: repeat(auto-fill, minmax(92px, 1fr)); }}
.tiles.wide {{ grid-template-columns: repeat(auto-fill, minmax(240px, 1fr)); }}
.tiles.middle {{ grid-template-columns: repeat(auto-fit, minmax(110px, 14rem)); }}
.tiles figure {{ margin: 0; }} .tiles img {{ width: 100%; }}
.tiles figcaption {{ text-align: center; font-size: .75rem; }}
.pair {{ display: flex; gap: 2px; }} .pair img {{ width: 50%; }}
.chosen img {{ outline: 3px solid #d9730d; }}
.scroll {{ overflow-x: auto; }} .scroll svg {{ min-width: 680px; width: 100%; height: auto; }}
.small svg {{ max-width: 34rem; width: 100%; height: auto; }}
table {{ border-collapse: collapse; font-size: .9rem; }}
th, td {{ padding: .3rem .7rem; border-bottom: 1px solid var(--line); text-align: left; }}
td.n, th.n {{ text-align: right; font-variant-numeric: tabular-nums; }}
.better {{ font-weight: 600; }}
</style>
</head>
<body>
{body}
</body>
</html>
"""


def video(caption: str, path: Path, page: Path) -> str:
    """A player of the video at `path`, and a link to it from the file `page`."""
    link = escape(Path(os.path.relpath(path, page.parent)).as_posix())
    text = f'<figcaption>{escape(caption)} (<a href="{link}">{escape(path.name)}</a>)</figcaption>'
    data = path.read_bytes()
    if len(data) > LARGEST_VIDEO or path.suffix.lower() != ".mp4":
        return f"<figure>{text}</figure>"
    address = "data:video/mp4;base64," + base64.b64encode(data).decode()
    poster = jpeg_uri(frame_at(path, probe(path).frames // 2))
    label = escape(caption)
    player = (
        f'<video controls playsinline poster="{poster}" src="{address}" aria-label="{label}">'
        "</video>"
    )
    return f"<figure>{player}{text}</figure>"


def videos_section(videos: Mapping[str, Path], page: Path) -> str:
    """Players with captions, where there are videos, for the file `page`."""
    if not videos:
        return ""
    return "<h2>Videos</h2>" + "".join(video(c, v, page) for c, v in videos.items())


def small(image: NDArray[Any]) -> NDArray[np.uint8]:
    """At most `LARGEST_TILE` pixels high."""
    share = LARGEST_TILE / image.shape[0]
    return enlarged(image, share) if share < 1 else to_bytes(image)


def tile(image: NDArray[Any], caption: str, *, alt: str = "", marked: bool = False) -> str:
    """A small picture with its caption, which also describes it unless `alt` does."""
    kind = ' class="chosen"' if marked else ""
    shown = picture(small(image), alt or caption)
    return f"<figure{kind}>{shown}<figcaption>{escape(caption)}</figcaption></figure>"


def pair(left: NDArray[Any], right: NDArray[Any], alts: tuple[str, str], caption: str) -> str:
    """Two pictures beside each other with one caption."""
    shown = picture(left, alts[0]) + picture(right, alts[1])
    text = f"<figcaption>{escape(caption)}</figcaption>"
    return f'<figure><div class="pair">{shown}</div>{text}</figure>'


def figure(image: NDArray[Any], caption: str) -> str:
    """A picture with its caption."""
    return f"<figure>{picture(image, caption)}<figcaption>{escape(caption)}</figcaption></figure>"


def picture(image: NDArray[Any], alt: str) -> str:
    """A picture inside the page, described by `alt` for those who cannot see it."""
    return f'<img src="{jpeg_uri(image)}" alt="{escape(alt)}">'
