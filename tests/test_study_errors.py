import json

import pytest

from mmmgpu.errors import InputError
from mmmgpu.studies import StudyClip
from mmmgpu.study_errors import agreement, mean_errors, read_errors, require_errors

TABLE = """condition,sentence,metric,value,fold
dpds,set red,L1,0.5,1
dpds,lay blue,L1,0.25,1
slds,set red,L1,2,1
dpds,set red,RMS,1e-3,2
"""


@pytest.fixture
def errors(tmp_path):
    (tmp_path / "e.csv").write_text(TABLE)
    return read_errors(tmp_path / "e.csv")


def test_a_table_is_read_by_metric_and_clip(errors):
    assert errors == {
        "L1": {("dpds", "set red"): 0.5, ("dpds", "lay blue"): 0.25, ("slds", "set red"): 2.0},
        "RMS": {("dpds", "set red"): 0.001},
    }


def test_what_compare_writes_is_read(tmp_path, errors):
    found = {
        "models": {"dpds": {}},
        "sentences": {
            "set red": {
                "dpds": {"L1": 0.5, "RMS": 1e-3, "log_likelihood": None},
                "slds": {"L1": 2},
            },
            "lay blue": {"dpds": {"L1": 0.25}},
        },
    }
    (tmp_path / "compare.json").write_text(json.dumps(found))
    assert read_errors(tmp_path / "compare.json") == errors


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("e.csv", "condition,sentence,value\na,b,1\n", "row 1: must have condition"),
        ("e.csv", "condition,sentence,metric,value\na,b,L1\n", "row 1: must have"),
        ("e.csv", f"{TABLE}dpds,set red,L1,3,3\n", "row 5: a second L1 of 'set red' by 'dpds'"),
        ("e.csv", "condition,sentence,metric,value\na,b,L1,x\n", "must be a finite number, is 'x'"),
        ("e.csv", "condition,sentence,metric,value\na,b,L1,nan\n", "finite number, is 'nan'"),
        ("e.json", '{"a": 1}', "has no values by sentence"),
        ("e.json", "[1]", "has no values by sentence"),
        ("e.json", '{"sentences": {"s": {"c": 1}}}', "has no values by sentence"),
        ("e.json", '{"sentences": {"s": {"c": {"L1": "x"}}}}', "must be a finite number, is 'x'"),
        ("e.json", "[", "is no table of errors"),
        ("e.json", "[" * 100_000, "is no table of errors"),
    ],
)
def test_a_bad_table_is_one_line(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=words) as refusal:
        read_errors(tmp_path / name)
    assert str(tmp_path / name) in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_table_that_is_not_text_or_not_there(tmp_path):
    (tmp_path / "e.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="is no table of errors"):
        read_errors(tmp_path / "e.csv")
    with pytest.raises(InputError, match="cannot be read"):
        read_errors(tmp_path / "nowhere.csv")
    (tmp_path / "e.csv").write_text(TABLE + "a" * 200_000 + "\n")
    with pytest.raises(InputError, match=r"e\.csv: is no table of errors \(field larger"):
        read_errors(tmp_path / "e.csv")


def test_a_table_of_something_else_is_refused(errors):
    require_errors(errors, [StudyClip("x", "set red", "dpds")], "e.csv")
    others = [StudyClip("x", "set red", "brand"), StudyClip("y", "set red", None)]
    with pytest.raises(InputError, match=r"e\.csv: has none of the study's"):
        require_errors(errors, others, "e.csv")


def test_means_are_over_the_sentences_of_the_study(errors):
    assert mean_errors(errors, ("dpds", "slds", "reality"), ("set red", "lay blue")) == {
        "L1": {"dpds": 0.375, "slds": 2.0, "reality": None},
        "RMS": {"dpds": 0.001, "slds": None, "reality": None},
    }
    assert mean_errors(errors, ("dpds",), ("set red",))["L1"] == {"dpds": 0.5}


def test_agreement_counts_the_lower_one():
    errors = {"L1": {("a", "s"): 1.0, ("b", "s"): 2.0, ("c", "s"): 2.0}}
    a, b, c, d = (StudyClip(x, "s", x) for x in "abcd")
    shares = agreement(errors, [(a, b), (a, c), (b, a), (b, c), (a, d), (d, a)])["L1"]
    assert (shares.first, shares.second) == (2, 1)
