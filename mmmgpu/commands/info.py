"""``mmmgpu info``: what is installed and loads; what a model holds."""

import platform
import re
from collections import defaultdict
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import typer

from mmmgpu import __version__
from mmmgpu.commands.options import Json
from mmmgpu.commands.places import require_output, write_results
from mmmgpu.commands.summaries import (
    aam_facts,
    model_facts,
    show_aam,
    show_model,
    show_table,
)

EXAMPLE = "Examples: mmmgpu info; mmmgpu info ann.mmm --json ann.json"
REQUIREMENT = re.compile(r"([\w.-]+)(?:\[[^]]*\])?[^;]*(?:;.*extra == ['\"](\w+)['\"])?")


def info(
    model: Annotated[
        Path | None,
        typer.Argument(metavar="MODEL", help="A model of either kind; without one: this machine."),
    ] = None,
    *,
    json: Json = None,
) -> None:
    """Show what works on this machine, or what a MODEL holds.

    With --json all of it: of a model also the clip and frame of every prototype.
    """
    require_output(json, [model])
    if model is None:
        facts = machine_facts()
        show_machine(facts)
    else:
        facts = show_file(model)
    write_results(facts, json)


def show_file(path: Path) -> dict[str, Any]:
    """Print what a model of either kind holds; the same as JSON values."""
    from mmmgpu import aam_files, model_files
    from mmmgpu.tensor_files import format_of

    if format_of(path) == aam_files.KIND.format:
        appearance = aam_files.load_aam(path)
        show_aam(appearance, path)
        return aam_facts(appearance, path)
    person = model_files.load(path)
    show_model(person, path)
    return model_facts(person, path)


def machine_facts() -> dict[str, Any]:
    """Versions, backends with their devices, and optional parts: JSON values."""
    from mmmgpu.backends import BACKENDS, default_threads

    return {
        "mmmgpu": __version__,
        "python": platform.python_version(),
        "system": platform.platform(),
        "threads": default_threads(),
        "backends": {family: _backend(family) for family in BACKENDS},
        "packages": _packages(),
    }


def _backend(family: str) -> dict[str, Any]:
    """Whether a backend loads, with its devices, or why it does not."""
    from mmmgpu.backends import get_backend, list_devices

    try:
        get_backend(family)
        return {"loads": True, "devices": list_devices(family)}
    except Exception as error:  # drivers raise whatever they like
        return {"loads": False, "reason": " ".join(str(error).split()) or type(error).__name__}


def _packages() -> dict[str, dict[str, str | None]]:
    """Version (None: not installed) of every required package, by extra; "" is the base."""
    found: dict[str, dict[str, str | None]] = defaultdict(dict)
    for requirement in metadata.requires("mmmgpu") or ():
        match = REQUIREMENT.match(requirement)
        if match and match[1] != "mmmgpu":
            found[match[2] or ""][match[1]] = _version(match[1])
    return dict(found)


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def show_machine(facts: dict[str, Any]) -> None:
    """Print `machine_facts`."""
    rows = [(key, facts[key]) for key in ("mmmgpu", "python", "system", "threads")]
    for family, backend in facts["backends"].items():
        if backend["loads"]:
            rows += [(f"backend {name}", what) for name, what in backend["devices"].items()]
        else:
            rows.append((f"backend {family}", f"does not load: {backend['reason']}"))
    for extra, packages in facts["packages"].items():
        missing = [name for name, version in packages.items() if version is None]
        said = ", ".join(f"{n} {v}" for n, v in packages.items() if v is not None)
        if missing:
            remedy = f"pip install 'mmmgpu[{extra}]'" if extra else "pip install mmmgpu"
            said = f"{said}; missing {', '.join(missing)}: {remedy}".removeprefix("; ")
        rows.append((f"extra {extra}" if extra else "packages", said))
    show_table("mmmgpu on this machine", rows)
