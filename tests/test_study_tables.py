import csv

import pytest
from studied import planned
from test_study_results import answer_everything

from mmmgpu.commands.study_tables import show_results, write_tables
from mmmgpu.errors import InputError
from mmmgpu.study_results import study_results


@pytest.fixture(scope="module")
def found():
    study = planned(conditions=("brand", "dpds", "slds", "reality"), participants=33)
    errors = {"L1": {("dpds", "set red"): 1.5}}
    return study_results(study, answer_everything(study), errors=errors)


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_tables_hold_what_was_found(found, tmp_path):
    write_tables(found, tmp_path / "new" / "tables")
    folder = tmp_path / "new" / "tables"
    names = {"table", "scale", "participants", "answers", "errors"}
    assert {p.stem for p in folder.iterdir()} == names
    for name, values in (
        ("table", found["table"]),
        ("scale", found["scale"]["conditions"]),
        ("participants", found["participants"]["each"]),
        ("answers", found["answers"]),
    ):
        told = [{k: "" if v is None else str(v) for k, v in row.items()} for row in values]
        assert rows_of(folder / f"{name}.csv") == told
    assert {"metric": "L1", "condition": "dpds", "mean": "1.5"} in rows_of(folder / "errors.csv")


def test_tables_without_rows_are_left_out(tmp_path):
    write_tables(study_results(planned(), []), tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["table.csv"]


def test_a_folder_that_cannot_be_written_is_refused(found, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot create the folder"):
        write_tables(found, tmp_path / "file")


def rows_shown(text):
    """The cells of each line of the tables."""
    lines = [line for line in text.splitlines() if line.startswith("│")]
    return [[cell.strip() for cell in line.strip("│").split("│")] for line in lines]


def test_every_number_is_shown_in_its_place(found, capsys):
    first = found["table"][0] | {"p": 0.011, "p_holm": 0.022, "p_people": 0.033}
    best = {"condition": "dpds", "theta": 1.25, "low": 0.5, "high": 2.0}
    people = found["participants"] | {"failed_checks": [3, 5], "excluded": [3, 5]}
    chosen = {"lower": 7, "higher": 2, "p": 0.18}
    changed = {
        "table": [first | {"share_a": 0.25, "low": 0.1, "high": 0.6}],
        "scale": {"conditions": [best], "order": "dpds", "reason": None},
        "sides": {"left": 7, "undecided": 1, "right": 4, "p": 0.55},
        "participants": people,
        "errors": {"L1": {"means": {"brand": None, "dpds": 1.5}, "chosen": chosen}},
    }
    show_results(found | changed)
    out = capsys.readouterr().out
    rows = rows_shown(out)
    counts = [str(first[name]) for name in ("a", "prefer_a", "undecided", "prefer_b", "b")]
    tests = [first["a"], first["b"], "25% (10% .. 60%)", "0.011", "0.022", "0.033"]
    assert rows[:2] == [counts, tests]
    assert rows[2:] == [["dpds", "1.25", "0.50 .. 2.00"], ["brand", "-"], ["dpds", "1.5"]]
    assert "left 7, right 4 times (p 0.55)" in out
    assert "failed attention checks: 3, 5; left out" in out
    assert "the clip of lower L1 was chosen 7 times, the other 2 (p 0.18)" in out


def test_that_there_is_no_ranking_is_said_with_the_reason(found, capsys):
    none = {"conditions": None, "order": None, "reason": "dpds always won"}
    show_results(found | {"scale": none})
    out = capsys.readouterr().out
    assert "no ranking: dpds always won" in out
    assert "failed attention checks: nobody\n" in out
    assert "Bradley-Terry" not in out


def test_results_are_shown(found, capsys):
    show_results(found)
    shown = capsys.readouterr().out
    first = found["table"][0]
    cells = [str(first[name]) for name in ("a", "prefer_a", "undecided", "prefer_b", "b")]
    assert any(all(cell in line.split() for cell in cells) for line in shown.splitlines())
    assert f"{first['share_a']:.0%}" in shown
    assert found["scale"]["order"] in shown
    assert "the clip of lower L1 was chosen 0 times, the other 0" in shown
    assert "33 invited, 33 begun, 33 finished" in shown
