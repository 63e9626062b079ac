"""What all such files have in common; more of it is tested where they are used."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from safetensors.numpy import save_file

from mmmgpu.errors import InputError
from mmmgpu.tensor_files import (
    HEADER,
    FileKind,
    check_tensors,
    format_of,
    read_tensors,
    write_tensors,
)

KIND = FileKind("a-format", 3, "thing", "make thing", "make it anew")


def together(path, tensors, facts):
    return path, tensors, facts


def test_arrays_and_facts_come_back(tmp_path):
    path = tmp_path / "a"
    given = {"x": np.arange(6.0).reshape(2, 3).T, "y": np.zeros((0, 2), np.int32)}
    write_tensors(path, KIND, {"said": ["ü", None]}, given)
    found, tensors, facts = read_tensors(path, KIND, together)
    assert found == path
    assert facts == {"format": "a-format", "version": 3, "said": ["ü", None]}
    for name, value in given.items():
        assert_array_equal(tensors[name], value)
        assert tensors[name].dtype == value.dtype


def test_numbers_that_are_not_finite_are_no_facts(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        write_tensors(tmp_path / "a", KIND, {"x": float("nan")}, {})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("failure", [KeyError("x"), TypeError("x"), ValueError("x")])
def test_what_assembly_stumbles_over_is_one_line_for_a_person(tmp_path, failure):
    write_tensors(tmp_path / "a", KIND, {}, {"x": np.zeros(1)})

    def stumble(path, tensors, facts):
        raise failure

    with pytest.raises(InputError, match=r"a: the thing lacks or misstates .*x.*; make it anew"):
        read_tensors(tmp_path / "a", KIND, stumble)


@pytest.mark.parametrize("version", [0, 4, "3", None, True])
def test_other_versions_are_refused(tmp_path, version):
    other = FileKind("a-format", version, "thing", "make thing", "")
    write_tensors(tmp_path / "a", other, {}, {})
    with pytest.raises(InputError, match=r"a: has format version .*, this mmmgpu reads up to 3"):
        read_tensors(tmp_path / "a", KIND, together)


def test_the_format_of_a_file_is_told_without_reading_it(tmp_path):
    write_tensors(tmp_path / "a", KIND, {}, {"x": np.zeros(1)})
    save_file({"x": np.zeros(1)}, str(tmp_path / "foreign"))
    save_file({"x": np.zeros(1)}, str(tmp_path / "list"), metadata={HEADER: "[1]"})
    (tmp_path / "text").write_text("nothing")
    assert format_of(tmp_path / "a") == "a-format"
    assert [format_of(tmp_path / n) for n in ("foreign", "list", "text", "none")] == [None] * 4


def test_a_tensor_is_checked_for_all_that_can_be_wrong(tmp_path):
    good = {"x": np.zeros((2, 3))}
    check_tensors(tmp_path, KIND, good, {"x": ((2, 3), "f8")})
    for wanted, says in ((((2, 4), "f8"), "must be float64"), (((2, 3), "f4"), "must be float32")):
        with pytest.raises(InputError, match=f"tensor x {says}.*make it anew"):
            check_tensors(tmp_path, KIND, good, {"x": wanted})
    with pytest.raises(InputError, match="tensor x holds NaN or infinity; make it anew"):
        check_tensors(tmp_path, KIND, {"x": np.full(2, np.inf)}, {"x": ((2,), "f8")})
