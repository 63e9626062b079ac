"""``mmmgpu mark``: corresponding points of two persons, in the browser -> POINTS."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mmmgpu.commands.endings import say
from mmmgpu.commands.options import Clips, Json, ModelFile, RegionBox, Sync, parse_box
from mmmgpu.commands.places import require_output, videos_in, write_results

if TYPE_CHECKING:
    from mmmgpu.marking import Session

EXAMPLE = "Example: mmmgpu mark ann.mmm ben/*.mp4 --out ann-ben.json"


def mark(
    model: ModelFile,
    clips: Clips,
    *,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            metavar="POINTS",
            help="Points to write, as JSON. A file of that name is opened again, if it was marked "
            "in the same frames.",
        ),
    ],
    port: Annotated[
        int,
        typer.Option(
            min=0, max=65535, help="Port of the page's address on this computer; 0: any free one."
        ),
    ] = 0,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")
    ] = True,
    region: RegionBox = None,
    closed: Annotated[
        str | None,
        typer.Option(
            "--closed", metavar="CLIP:FRAME", help="Frame of CLIPs with the mouth closed."
        ),
    ] = None,
    opened: Annotated[
        str | None,
        typer.Option("--open", metavar="CLIP:FRAME", help="Frame of CLIPs with the mouth open."),
    ] = None,
    landmarks: Annotated[
        tuple[Path, Path] | None,
        typer.Option(
            "--landmarks",
            metavar="DIR DIR",
            help="Folders with NAME.npz of tracked points, of MODEL's clips and of CLIPs: these "
            "are written, and no page is shown.",
        ),
    ] = None,
    sync: Sync,
    json: Json = None,
) -> None:
    """Mark which points of two faces correspond.

    A page in the browser shows a frame of each person (MODEL's, and the one in CLIPs) with the
    mouth closed, and one with it open, and proposes 38 points about the mouth; they are dragged to
    their places. The frames of CLIPs are chosen, or given. The page is served by
    this command to this computer alone, until "Save & finish" is pressed on it. Its address is said
    on the standard error.
    """
    box = None if region is None else parse_box(region)
    wanted = {"closed": closed, "open": opened}
    given = {kind: _parse_frame(text, kind) for kind, text in wanted.items() if text is not None}
    found = videos_in(clips)
    require_output(out, [model, *found])
    require_output(json, [model, out, *found])
    from mmmgpu.landmark_points import points_from_landmarks
    from mmmgpu.marking import Session
    from mmmgpu.model_files import load
    from mmmgpu.points import read_points, write_points
    from mmmgpu.reference_pairs import choose_references, source_references

    if out.exists():
        read_points(out)  # whatever is wrong with it, before the long search for frames
    a = source_references(load(model))
    b = choose_references(found, region=box, sync=sync, given=given)
    if landmarks is not None:
        write_points(out, points_from_landmarks(a, b, *landmarks))
        print(out)
        return
    session = Session(out, {kind: (a[kind], b[kind]) for kind in a if kind in b})
    wait_for_person(session, port=port, browser=browser)
    print(out)
    write_results(session_facts(session), json)


def _parse_frame(text: str, kind: str) -> tuple[str, int]:
    """CLIP:FRAME as a name and a number; a usage error, if it is something else."""
    clip, _, frame = text.rpartition(":")
    if not clip or not frame.isdecimal():
        message = f"{text!r} must be the name of a clip and a frame, as in ben-1.mp4:12"
        raise typer.BadParameter(message, param_hint=f"--{kind}")
    return Path(clip).name, int(frame)


def wait_for_person(session: "Session", *, port: int, browser: bool) -> None:
    """Serve the page until the person has finished; Ctrl-C is a KeyboardInterrupt."""
    import webbrowser

    from mmmgpu.marking_server import serving

    with serving(session, port=port) as server:
        try:
            opened = browser and webbrowser.open(server.address)
            say(f"the page is at {server.address}{'' if opened else ' (open it in a browser)'}")
            say('mark the points there, then press "Save & finish" (Ctrl-C ends without saving)')
            server.finished.wait()
        except KeyboardInterrupt:
            if not session.saved:
                say(f"{session.out}: is not saved; changes come back with the same command")
            raise


def session_facts(session: "Session") -> dict[str, Any]:
    """What was marked: JSON values."""
    description = session.describe()
    pairs = [
        {"kind": p["kind"], "points": len(p["points"]), "a": p["a"], "b": p["b"]}
        for p in description["pairs"]
        if p["points"]
    ]
    return {"points": str(session.out), "pairs": pairs}
