"""``mmmgpu study``: the blind forced-choice study: create, serve, results."""

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mmmgpu.commands.endings import guarded, say
from mmmgpu.commands.options import Json, LibraryDefault, split_names
from mmmgpu.commands.places import require_output, write_results
from mmmgpu.commands.study_tables import show_results, write_tables
from mmmgpu.web_pages import LOOPBACK

if TYPE_CHECKING:
    from mmmgpu.studies import Study

HELP = "Let people choose which of two clips is real."
EXAMPLES = {
    "create": "Example: mmmgpu study create videos --out lips.study",
    "serve": "Example: mmmgpu study serve lips.study > links.txt",
    "results": "Example: mmmgpu study results lips.study --csv results",
}
_WEB = ("sqlalchemy", "starlette", "uvicorn")
_OPTIONS = ("mmmgpu.study_creation", "StudyOptions")

StudyFolder = Annotated[
    Path, typer.Argument(metavar="STUDY", help="A folder written by: mmmgpu study create.")
]
Database = Annotated[
    str | None,
    typer.Option(
        "--database",
        metavar="URL",
        help="PostgreSQL database for the answers, as in postgresql://user@host/name; by default "
        "they are kept in STUDY, in SQLite.",
    ),
]


def create(
    clips: Annotated[
        Path,
        typer.Argument(
            metavar="DIR", help="Folder with DIR/CONDITION/SENTENCE.mp4 (or another video)."
        ),
    ],
    *,
    out: Annotated[Path, typer.Option("--out", metavar="STUDY", help="Study folder to make.")],
    conditions: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,...", help="Folders of DIR that are taken; without it all of them."
        ),
    ] = None,
    real: Annotated[
        str,
        typer.Option(
            metavar="CONDITION",
            help="Condition whose sound all clips of a sentence get, and that attention checks "
            "are made from.",
            default_factory=LibraryDefault(*_OPTIONS, "real"),
        ),
    ],
    participants: Annotated[
        int,
        typer.Option(
            metavar="N",
            help="How many links to make; unused ones do no harm.",
            default_factory=LibraryDefault(*_OPTIONS, "participants"),
        ),
    ],
    pairs: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Pairs for each participant. By default each ordered pair of conditions once: 12 "
            "for four conditions.",
        ),
    ] = None,
    checks: Annotated[
        int,
        typer.Option(
            metavar="N",
            help="Attention checks for each participant, beside the pairs: a clip against itself "
            "with the picture frozen.",
            default_factory=LibraryDefault(*_OPTIONS, "checks"),
        ),
    ],
    introduction: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Text that participants read first, UTF-8."),
    ] = None,
    cut: Annotated[
        bool, typer.Option("--cut", help="Cut the clips of a sentence to the shortest.")
    ] = False,
    mute: Annotated[bool, typer.Option("--mute", help="Show all clips without sound.")] = False,
    seed: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Start of the random numbers of the plan; by default nobody knows it before.",
        ),
    ] = None,
    json: Json = None,
) -> None:
    """Make a study from clips of the same sentences.

    DIR holds a folder of clips for each condition. Every clip is written again with the same
    encoder, under a name that means nothing, with the sound of the real one; the files of one
    sentence have the same length. The study also holds the plan of who sees what: keep it from
    participants.
    """
    require_output(json)
    from dataclasses import replace

    from mmmgpu.study_creation import StudyOptions, create_study

    options = StudyOptions(
        conditions=None if conditions is None else split_names(conditions),
        real=real,
        participants=participants,
        pairs=pairs,
        checks=checks,
        cut=cut,
        mute=mute,
        seed=seed,
    )
    if introduction is not None:
        options = replace(options, introduction=_text(introduction))
    study = create_study(clips, out, options=options)
    print(out)
    write_results(study_facts(study, out), json)


def _text(path: Path) -> str:
    from mmmgpu.errors import InputError

    try:
        text = path.read_text("utf-8-sig").strip()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8; save it as that") from error
    if not text:
        raise InputError(f"{path}: is empty; write what participants should know")
    return text


def study_facts(study: "Study", folder: Path) -> dict[str, Any]:
    """What a study consists of: JSON values, without the key to it."""
    pairs = [pair for p in study.participants for pair in p.pairs]
    return {
        "study": str(folder),
        "id": study.id,
        "seed": study.seed,
        "conditions": list(study.conditions),
        "real": study.real,
        "sentences": sorted({clip.sentence for clip in study.clips}),
        "participants": len(study.participants),
        "pairs": sum(not pair.is_check for pair in pairs),
        "checks": sum(pair.is_check for pair in pairs),
    }


def serve(
    study: StudyFolder,
    *,
    host: Annotated[
        str,
        typer.Option(
            metavar="HOST",
            help="Address of this computer to listen at; the default is for this computer alone.",
        ),
    ] = LOOPBACK,
    port: Annotated[
        int,
        typer.Option(
            min=0,
            max=65535,
            help="Port to listen at; 0: any free one.",
        ),
    ] = 8000,
    address: Annotated[
        str | None,
        typer.Option(
            metavar="URL",
            help="How participants reach the server, as in https://example.org/lips; by default "
            "by HOST and PORT.",
        ),
    ] = None,
    database: Database = None,
    json: Json = None,
) -> None:
    """Show a study to its participants, in the browser.

    It runs until Ctrl-C. The links, one a participant, go to the standard output. Whoever opens one
    again goes on where they were. Answers are stored at once: the server may be stopped, or killed,
    and started again at any time.
    """
    require_output(json)
    _require_web()
    import threading

    from mmmgpu.studies import read_study
    from mmmgpu.study_server import StudyPage, serving
    from mmmgpu.study_store import open_store

    plan = read_study(study)
    with open_store(study, plan, url=database) as store:
        application = StudyPage(study, plan, store).application()
        with serving(application, host=host, port=port) as actual:
            shown = f"[{host}]" if ":" in host else host
            base = (address or f"http://{shown}:{actual}").rstrip("/")
            links = [f"{base}/{participant.token}/" for participant in plan.participants]
            write_results({"address": base, "links": links}, json)
            print(*links, sep="\n", flush=True)
            say(f"the study is at {base}/ (Ctrl-C ends; the same command goes on with it)")
            threading.Event().wait()


def _require_web() -> None:
    """Make sure that the `web` extra is installed, before anything is imported that needs it."""
    from mmmgpu.errors import InputError

    missing = [name for name in _WEB if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(f"studies need {missing[0]}; run pip install 'mmmgpu[web]'")


def results(
    study: StudyFolder,
    *,
    exclude_failed: Annotated[
        bool,
        typer.Option(
            "--exclude-failed", help="Leave out participants who failed an attention check."
        ),
    ] = False,
    errors: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Error measures of the clips, to be put beside the votes: compare.json of mmmgpu "
            "compare, or CSV with the columns condition, sentence, metric and value.",
        ),
    ] = None,
    database: Database = None,
    tables: Annotated[
        Path | None,
        typer.Option("--csv", metavar="DIR", help="Also write the tables and answers as CSV."),
    ] = None,
    json: Json = None,
) -> None:
    """Count what was chosen, with tests and a ranking.

    Each condition is counted against each other one. May be called while the study is served.
    Intervals are 95 %; undecided answers are counted
    apart.
    """
    require_output(json)
    _require_web()
    from mmmgpu.studies import read_study
    from mmmgpu.study_errors import read_errors, require_errors
    from mmmgpu.study_results import study_results
    from mmmgpu.study_store import open_store

    plan = read_study(study)
    measured = None if errors is None else read_errors(errors)
    if measured is not None:
        require_errors(measured, plan.clips, str(errors))
    with open_store(study, plan, url=database) as store:
        answers = store.answers()
    found = study_results(plan, answers, exclude_failed=exclude_failed, errors=measured)
    show_results(found)
    if tables is not None:
        write_tables(found, tables)
    write_results(found, json)


app = typer.Typer(help=HELP, no_args_is_help=True, rich_markup_mode=None)
for _command in (create, serve, results):
    app.command(epilog=EXAMPLES[_command.__name__])(guarded(_command))
