"""Files and folders that commands are given: looked at before any long work begins."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from mmmgpu.errors import InputError
from mmmgpu.files import require_writable, write_json


def videos_in(places: Iterable[Path]) -> list[Path]:
    """The clips at `places`: files as they are, of folders the videos in them, by name.

    Raises:
        InputError: A folder has no video in it.
    """
    from mmmgpu.videos import VIDEO_SUFFIXES

    clips: list[Path] = []
    for place in places:
        found = [place]
        if place.is_dir():
            files = sorted(place.iterdir())
            found = [f for f in files if f.suffix.lower() in VIDEO_SUFFIXES and f.is_file()]
        if not found:
            raise InputError(f"{place}: no video in this folder; name the clips")
        clips += found
    return clips


def require_output(out: Path | None, inputs: Sequence[Path | None] = ()) -> None:
    """Make sure that the file `out`, where one is wanted, can be written and is none of `inputs`.

    Raises:
        InputError: It cannot, or is.
    """
    if out is None:
        return
    for given in inputs:
        if given is not None and out.exists() and given.exists() and out.samefile(given):
            raise InputError(f"{out}: would replace what is read; choose another name")
    require_writable(out)


def require_video_output(out: Path, inputs: Sequence[Path | None] = ()) -> None:
    """As `require_output`, for a video."""
    from mmmgpu.video_writing import require_video_name

    require_video_name(out)
    require_output(out, inputs)


def write_results(results: object, path: Path | None) -> None:
    """Write the JSON values `results` to `path`, where one was given."""
    if path is not None:
        write_json(path, results)
