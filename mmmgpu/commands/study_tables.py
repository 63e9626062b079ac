"""The results of a study, as `mmmgpu study results` shows them and writes them as CSV."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mmmgpu.commands.summaries import show_table
from mmmgpu.files import require_folder, write_text

Value = Mapping[str, Any]
TABLE = ("a", "prefer_a", "undecided", "prefer_b", "b")
TABLE_TITLES = ("A", "prefer A", "undecided", "prefer B", "B")
TEST_TITLES = ("A", "B", "A of decided", "p", "p (Holm)", "p (people)")


def show_results(found: Value) -> None:
    """Print what `mmmgpu.study_results.study_results` found, as tables."""
    counts = [[row[name] for name in TABLE] for row in found["table"]]
    show_table("Which one was taken for real", counts, TABLE_TITLES)
    show_table("Exact tests", map(_tests, found["table"]), TEST_TITLES)
    _show_scale(found["scale"])
    for metric, about in found.get("errors", {}).items():
        _show_errors(metric, about)
    sides = found["sides"]
    print(f"left {sides['left']}, right {sides['right']} times (p {sides['p']:.2g})")
    people = found["participants"]
    print("participants: {invited} invited, {begun} begun, {finished} finished".format(**people))
    failed = ", ".join(map(str, people["failed_checks"])) or "nobody"
    print(f"failed attention checks: {failed}{'; left out' if people['excluded'] else ''}")


def _tests(row: Value) -> list[str]:
    share = "-"
    if row["share_a"] is not None:
        share = f"{row['share_a']:.0%} ({row['low']:.0%} .. {row['high']:.0%})"
    p = [f"{row[name]:.2g}" for name in ("p", "p_holm", "p_people")]
    return [row["a"], row["b"], share, *p]


def _show_scale(scale: Value) -> None:
    if scale["conditions"] is None:
        print(f"no ranking: {scale['reason']}")
        return
    rows = [
        (value["condition"], f"{value['theta']:.2f}", f"{value['low']:.2f} .. {value['high']:.2f}")
        for value in scale["conditions"]
    ]
    show_table("Bradley-Terry scale", rows, ("condition", "theta", "95 %"))
    print(scale["order"])


def _show_errors(metric: str, about: Value) -> None:
    means, chosen = about["means"], about["chosen"]
    rows = [(condition, "-" if mean is None else mean) for condition, mean in means.items()]
    show_table(metric, rows, ("condition", "mean"))
    lower, higher, p = (chosen[name] for name in ("lower", "higher", "p"))
    print(f"the clip of lower {metric} was chosen {lower} times, the other {higher} (p {p:.2g})")


def write_tables(found: Value, folder: Path) -> None:
    """Write table.csv, scale.csv, participants.csv, answers.csv and errors.csv, those with rows.

    Raises:
        InputError: They cannot be written.
    """
    require_folder(folder)
    errors = [
        {"metric": metric, "condition": condition, "mean": mean}
        for metric, about in found.get("errors", {}).items()
        for condition, mean in about["means"].items()
    ]
    for name, rows in (
        ("table", found["table"]),
        ("scale", found["scale"]["conditions"] or []),
        ("participants", found["participants"]["each"]),
        ("answers", found["answers"]),
        ("errors", errors),
    ):
        if rows:
            write_text(folder / f"{name}.csv", _csv(rows))


def _csv(rows: Sequence[Mapping[str, object]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
