import csv
import xml.etree.ElementTree as ET

import cv2
import pytest
from test_comparison_scores import folds

from mmmgpu.comparison_reports import TITLES, pair_rows, table_rows, write_comparison
from mmmgpu.comparison_scores import METRICS, not_comparable, paired_tests, summarise


@pytest.fixture
def results():
    scores = {"models": summarise(folds()), "tests": paired_tests(folds()), "folds": folds()}
    return scores | {"not_comparable": not_comparable(["b"])}


def test_the_table_has_a_row_a_model(results):
    rows = list(table_rows(results))
    assert [row[0] for row in rows] == ["a", "b", "c"]
    rms = results["models"]["a"]["rms"]
    assert rows[0][1 + METRICS.index("rms")] == f"{rms['mean']:.4g} +- {rms['half_width_95']:.2g}"
    assert rows[1][1 + METRICS.index("log_likelihood")] == "not comparable"
    assert [row.count("not comparable") for row in rows] == [0, 1, 0]
    pairs = list(pair_rows(results))
    assert len(pairs) == len(results["tests"])
    assert pairs[0][:2] == ["l1", "a - b"]


def test_files_hold_every_number_and_the_same_results_are_the_same_bytes(results, tmp_path):
    paths = write_comparison(results, tmp_path)
    assert [p.name for p in paths] == ["compare.json", "compare.csv", "figure4.svg", "figure4.png"]
    rows = list(csv.DictReader(paths[1].read_text().splitlines()))
    assert len(rows) == 3 * len(METRICS) * 7
    own = [r for r in rows if (r["model"], r["metric"]) == ("c", "l1")]
    assert [float(r["value"]) for r in own[:-1]] == [fold["c"]["l1"] for fold in folds()]
    assert own[-1]["fold"] == "mean"
    assert float(own[-1]["half_width_95"]) == results["models"]["c"]["l1"]["half_width_95"]
    text = "".join(ET.fromstring(paths[2].read_text()).itertext())
    assert [title for title in TITLES.values() if title not in text] == []
    assert text.count("not comparable: b") == 1
    noted = {(r["model"], r["metric"]) for r in rows if r["note"] == "not comparable"}
    assert noted == {("b", "log_likelihood")}
    assert cv2.imread(str(paths[3])).std() > 5
    before = [path.read_bytes() for path in paths]
    assert [p.read_bytes() for p in write_comparison(results, tmp_path)] == before


def test_one_fold_has_no_interval_and_no_test(tmp_path):
    one = folds()[:1]
    results = {"models": summarise(one), "tests": paired_tests(one), "folds": one}
    results["not_comparable"] = {}
    assert "+-" not in next(table_rows(results))[1]
    assert list(pair_rows(results)) == []
    write_comparison(results, tmp_path)
