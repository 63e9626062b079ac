"""``mmmgpu compare``: the models of movement, judged by cross-validation."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from mmmgpu.commands.options import (
    Alignments,
    Backend,
    Clips,
    Json,
    LibraryDefault,
    RegionBox,
    Sync,
    parse_box,
    split_names,
)
from mmmgpu.commands.places import require_output, videos_in, write_results
from mmmgpu.commands.summaries import show_table
from mmmgpu.errors import InputError

EXAMPLE = "Example: mmmgpu compare clips/ --alignments aligned --landmarks points --out figure4"

ONLY_FOR = {"region": "mmm", "prototypes": "mmm", "parameters": "aam", "all_points": "aam"}


def _standard() -> str:
    from mmmgpu.dynamics import FIVE

    return ",".join(FIVE)


def compare(
    clips: Clips,
    *,
    alignments: Alignments,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the results and figures.")
    ],
    features: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="aam or mmm, learned anew in every fold; or a folder with NAME.npz for every clip "
            "NAME.*, which holds the array 'features' (frames, d).",
        ),
    ] = "aam",
    landmarks: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Landmarks of the clips, for --features aam."),
    ] = None,
    parameters: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="With --features aam: how many a frame has, if not as many as mmmgpu aam gives.",
        ),
    ] = None,
    all_points: Annotated[
        bool,
        typer.Option(
            "--all-points", help="With --features aam: use all landmarks, not the 38 built in."
        ),
    ] = False,
    prototypes: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=2,
            help="With --features mmm: mouth pictures of a model, if not as many as mmmgpu train "
            "keeps.",
        ),
    ] = None,
    models: Annotated[
        str,
        typer.Option(
            metavar="A,B,...",
            help="What to compare: some of hmm, brand, slds, dpds, egp02 and slds-full (slow).",
            default_factory=_standard,
        ),
    ],
    folds: Annotated[
        int,
        typer.Option(
            help="Folds that the clips are dealt into.",
            default_factory=LibraryDefault("mmmgpu.comparison", "CompareOptions", "folds"),
        ),
    ],
    videos: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Also render every clip by every model and by 'reality', its own features: "
            "DIR/CONDITION/CLIP.mp4, as the study takes them.",
        ),
    ] = None,
    sync: Sync,
    region: RegionBox = None,
    seed: Annotated[
        int,
        typer.Option(
            help="Of the folds.",
            default_factory=LibraryDefault("mmmgpu.comparison", "CompareOptions", "seed"),
        ),
    ],
    backend: Backend,
    json: Json = None,
) -> None:
    """Compare models of movement on CLIPs with phones.

    Each clip is generated from its phones by models that were fitted to the other folds' clips, and
    compared with what was seen in it: distances, likelihood, correlation, variance and smoothness,
    with 95 % intervals over the folds and paired tests. A killed comparison goes on where it was.
    """
    chosen = {
        "region": None if region is None else parse_box(region),
        "prototypes": prototypes,
        "parameters": parameters,
        "all_points": all_points or None,
    }
    learned_with = _learning(features, sync, chosen)
    found = videos_in(clips)
    require_output(json, found)
    require_output(out / "compare.json", found)
    from mmmgpu.backends import get_backend
    from mmmgpu.comparison import CompareOptions
    from mmmgpu.comparison import compare as judge
    from mmmgpu.comparison_features import SavedFeatures, features_named
    from mmmgpu.comparison_reports import pair_rows, table_rows, write_comparison
    from mmmgpu.comparison_scores import METRICS, legend
    from mmmgpu.corpora import check_rates, open_corpus

    get_backend(backend)
    source = features_named(
        features,
        alignments=alignments,
        landmarks=landmarks,
        options=learned_with,
        backend=backend,
    )
    if videos is not None and isinstance(source, SavedFeatures):
        raise InputError("--videos: saved features have no pictures; give --features aam or mmm")
    corpus = open_corpus(found, alignments, sync=sync)
    check_rates(corpus)
    options = CompareOptions(folds=folds, seed=seed, models=split_names(models))
    results = judge(corpus, source, out / "work", videos=videos, options=options)
    write_comparison(results, out)
    title = f"{len(corpus)} sentences, {folds} folds: mean and 95 % interval over folds"
    note = legend(results["not_comparable"])
    show_table(title, table_rows(results), ["model", *METRICS], note)
    header = ["metric", "models", "difference", "p (t)", "p (Wilcoxon)"]
    show_table("paired over folds", pair_rows(results), header)
    write_results(results, json)


def _learning(features: str, sync: float, chosen: Mapping[str, Any]) -> dict[str, Any]:
    """What the features are learned with, of the options that were `chosen` (not None)."""
    given = {name: value for name, value in chosen.items() if value is not None}
    for name in given:
        if ONLY_FOR[name] != features:
            option = f"--{name.replace('_', '-')}"
            raise typer.BadParameter(f"is for --features {ONLY_FOR[name]}", param_hint=option)
    if given.pop("all_points", False):
        given["rows"] = None
    return {"sync": sync, **given} if features == "mmm" else given
