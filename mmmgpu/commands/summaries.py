"""What commands show on the standard output, and the JSON values that describe a model."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mmmgpu.appearances import Aam
    from mmmgpu.models import Model
    from mmmgpu.trajectory_training import TrainedStream


def show_table(
    title: str, rows: Iterable[Sequence[object]], header: Sequence[str] = (), legend: str = ""
) -> None:
    """Print a table: a title, the names of the columns if there are any, rows, and a legend."""
    from rich.console import Console
    from rich.table import Table

    lines = [[f"{x:.4g}" if isinstance(x, float) else str(x) for x in row] for row in rows]
    table = Table(title=title, title_justify="left", show_header=bool(header))
    table.caption, table.caption_justify = legend or None, "left"
    names = header or [""] * len(lines[0])
    for name in names:
        table.add_column(name, overflow="fold")
    for line in lines:
        table.add_row(*line)
    Console(markup=False, highlight=False, emoji=False).print(table)


def flat(values: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    """Nested results as rows (name, value); an interval becomes "mean +- half width"."""
    for key, value in values.items():
        name = f"{above}{key.replace('_', ' ')}"
        if isinstance(value, Mapping) and {"mean", "half_width_95"} <= value.keys():
            half = value["half_width_95"]
            margin = "" if half is None else f" +- {half:.2g}"
            yield name, f"{value['mean']:.4g}{margin}"
        elif isinstance(value, Mapping):
            yield from flat(value, f"{name}, ")
        else:
            yield name, _said(value)


def model_facts(model: "Model", path: Path) -> dict[str, Any]:
    """All that `model`, read from `path`, holds beside pictures: JSON values."""
    from mmmgpu.model_files import VERSION
    from mmmgpu.models import REGULARISED

    region = model.reference.region
    alpha = model.alpha.trained
    return {
        "model": str(path),
        "format_version": VERSION,
        "frame_size": list(model.frame_size),
        "fps": float(model.fps),
        "region": {"box": list(region.box), "mouth": list(region.mouth)},
        "reference": model.basis.reference,
        "prototypes": [{"clip": clip, "frame": frame} for clip, frame in model.sources],
        "frames_of_phone": dict(zip(alpha.labels, map(int, alpha.count), strict=True)),
        "alpha": _stream_facts(model.alpha),
        "beta": _stream_facts(model.beta),
        "background": {
            "suffix": model.calm.suffix,
            "bytes": int(model.calm.data.size),
            "frames": len(model.calm.track),
        },
        "trajectories": [REGULARISED, *model.dynamics],
        "notes": model.notes,
    }


def _stream_facts(stream: "TrainedStream") -> dict[str, Any]:
    validation = stream.validation
    return {
        "dimensions": len(stream.smoothness),
        "constants": dict(vars(stream.constants)),
        "validation_error": {"pooled": float(validation[0]), "trained": float(validation.min())},
    }


def show_model(model: "Model", path: Path) -> None:
    """Print the main facts about `model`."""
    facts = model_facts(model, path)
    width, height = facts["frame_size"]
    clip, frame = model.sources[model.basis.reference]
    seen = facts["frames_of_phone"]
    rows = [
        ("picture", f"{width} x {height} pixels, {facts['fps']:g} frames/s"),
        ("mouth region", "x {}, y {}, {} x {} pixels".format(*facts["region"]["box"])),
        ("prototypes", f"{len(model.sources)}, reference: {clip}, frame {frame}"),
        ("phones", ", ".join(f"{label} {n}" for label, n in sorted(seen.items()))),
    ]
    for name in ("alpha", "beta"):
        constants = facts[name]["constants"]
        error = facts[name]["validation_error"]
        gain = 1 - error["trained"] / error["pooled"] if error["pooled"] else 0.0
        said = ", ".join(f"{key} {value:g}" for key, value in constants.items())
        rows.append((f"{name} training", f"{said}; error {100 * gain:.1f} % below pooled"))
    rows.append(("trajectories", ", ".join(facts["trajectories"])))
    rows += [(key.replace("_", " "), _said(value)) for key, value in model.notes.items()]
    show_table(str(path), rows)


def aam_facts(aam: "Aam", path: Path) -> dict[str, Any]:
    """All that `aam`, read from `path`, holds beside pictures: JSON values."""
    from mmmgpu.aam_files import KIND

    height, width = aam.mesh.shape
    return {
        "aam": str(path),
        "format_version": KIND.version,
        "parameters": len(aam.variance),
        "variance_share": aam.share,
        "points": len(aam.mesh.vertices),
        "landmark_rows": None if aam.rows is None else list(aam.rows),
        "triangles": len(aam.mesh.triangles),
        "pixels": len(aam.mesh.pixels.index),
        "mean_shape_size": [width, height],
        "reduction": aam.reduction,
        "shape_modes": len(aam.shape_variance),
        "texture_modes": len(aam.texture_variance),
        "variance_of_parameters": aam.variance.tolist(),
        "notes": aam.notes,
    }


def show_aam(aam: "Aam", path: Path) -> None:
    """Print the main facts about `aam`."""
    facts = aam_facts(aam, path)
    width, height = facts["mean_shape_size"]
    share = 100 * facts["variance_share"]
    rows = [
        ("parameters", f"{facts['parameters']}, with {share:.1f} % of the variance"),
        ("points", f"{facts['points']}, in {facts['triangles']} triangles"),
        ("mean shape", f"{facts['pixels']} pixels in {width} x {height}"),
        ("frames reduced by", str(facts["reduction"])),
        ("fitted by", f"{facts['shape_modes']} shape modes"),
    ]
    rows += [(key.replace("_", " "), _said(value)) for key, value in aam.notes.items()]
    show_table(str(path), rows)


def _said(value: Any) -> str:
    """A note in a few words."""
    if isinstance(value, list) and len(value) > 3:
        return f"{len(value)}: {value[0]} ... {value[-1]}"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    if isinstance(value, dict):  # tables in it are for reports and --json
        plain = {name: what for name, what in value.items() if not isinstance(what, dict | list)}
        return "; ".join(f"{name}: {_said(what)}" for name, what in plain.items()) or "none"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
