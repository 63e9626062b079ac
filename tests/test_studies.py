import json
import shutil

import pytest

from mmmgpu.errors import InputError
from mmmgpu.studies import CHOICES, clip_path, read_study, write_study


@pytest.fixture
def folder(study_folder, tmp_path):
    """A copy of the study that may be damaged."""
    return shutil.copytree(study_folder, tmp_path / "copy.study")


def change(folder, edit):
    plan = json.loads((folder / "study.json").read_text())
    edit(plan)
    (folder / "study.json").write_text(json.dumps(plan))


def test_what_is_written_is_read(folder, tmp_path):
    study = read_study(folder)
    assert len(study.participants) == 50
    assert len(study.clips) == 15
    write_study(folder, study)
    assert read_study(folder) == study
    assert clip_path(folder, study.clips[0]).parent == folder / "clips"


def test_choices_are_sides(study_folder):
    pair = read_study(study_folder).participants[0].pairs[0]
    assert [pair.chosen(choice) for choice in CHOICES] == [pair.left, None, pair.right]


def test_checks_are_told_from_pairs(study_folder):
    pairs = read_study(study_folder).participants[0].pairs
    assert [p.is_check for p in pairs].count(True) == 2
    assert all((None in (p.left.condition, p.right.condition)) is p.is_check for p in pairs)


def drop(key):
    return lambda plan: plan.pop(key)


def put(**values):
    return lambda plan: plan.update(values)


def in_first_clip(**values):
    return lambda plan: next(iter(plan["clips"].values())).update(values)


def same_token(plan):
    plan["participants"][1]["token"] = plan["participants"][0]["token"]


def one_clip_twice(plan):
    plan["participants"][0]["pairs"][0] = [next(iter(plan["clips"]))] * 2


def two_sentences(plan):
    (left, a), (right, b) = next(
        ((m, x), (n, y))
        for m, x in plan["clips"].items()
        for n, y in plan["clips"].items()
        if x["sentence"] != y["sentence"] and x["condition"] != y["condition"]
    )
    assert a != b
    plan["participants"][0]["pairs"][0] = [left, right]


def outside(plan):
    plan["clips"]["../study"] = {"condition": None, "sentence": "x"}


DAMAGES = {
    "other": (put(format="mmmgpu-points"), "is no plan of a study"),
    "newer": (put(version=2), "newer than this mmmgpu"),
    "version": (put(version="1"), "version must be 1"),
    "no clips": (drop("clips"), "does not hold a whole study"),
    "clips": (put(clips=[1]), "does not hold a whole study"),
    "participants": (put(participants=[{"token": "x", "pairs": [["a", "b"]]}]), "KeyError"),
    "pairs": (put(participants=[{"token": "x", "pairs": [["a"]]}]), "does not hold"),
    "real": (put(real="nobody"), "not among conditions"),
    "condition": (in_first_clip(condition="nobody"), "not among conditions"),
    "token": (same_token, "one token"),
    "token path": (put(participants=[{"token": "../x", "pairs": []}]), "is no name"),
    "one clip": (one_clip_twice, "one condition on both sides"),
    "sentences": (two_sentences, "two sentences"),
    "path": (outside, "is no name"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_plan_is_refused(folder, damage):
    edit, words = DAMAGES[damage]
    change(folder, edit)
    with pytest.raises(InputError, match=r"study\.json: ") as refusal:
        read_study(folder)
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("text", ["", "{", "[1]", "[" * 100_000])
def test_what_is_no_json_is_refused(folder, text):
    (folder / "study.json").write_text(text)
    with pytest.raises(InputError, match="create the study again"):
        read_study(folder)


def test_other_folders_are_refused(tmp_path):
    with pytest.raises(InputError, match="give a folder of mmmgpu study create"):
        read_study(tmp_path)


def test_a_missing_clip_is_named(folder):
    missing = clip_path(folder, read_study(folder).clips[4])
    missing.unlink()
    with pytest.raises(InputError, match=f"{missing.name}: the clip is missing"):
        read_study(folder)
