import pickle
from dataclasses import fields, replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from rewriting import rewritten

from mmmgpu.aam_files import KIND, load_aam, save_aam
from mmmgpu.errors import InputError
from mmmgpu.meshes import Mesh


@pytest.fixture(scope="module")
def data(drawn, tmp_path_factory):
    path = tmp_path_factory.mktemp("aam") / "a.aam"
    save_aam(drawn.aam, path)
    return path.read_bytes()


def assert_same(a, b):
    for f in fields(a):
        x, y = getattr(a, f.name), getattr(b, f.name)
        if isinstance(x, Mesh) or hasattr(x, "place"):
            assert_same(x, y)
        else:
            assert_array_equal(x, y)
            assert np.asarray(x).dtype == np.asarray(y).dtype, f.name
            assert type(x) is type(y), f.name


def test_a_model_comes_back_bit_for_bit(drawn, tmp_path):
    path = tmp_path / "a ü.aam"
    save_aam(drawn.aam, path)
    assert_same(load_aam(path), drawn.aam)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_rows_may_be_all(drawn, tmp_path):
    save_aam(replace(drawn.aam, rows=None), tmp_path / "a.aam")
    assert load_aam(tmp_path / "a.aam").rows is None


def test_the_same_model_is_the_same_file(drawn, data, tmp_path):
    for i in range(4):
        save_aam(drawn.aam, tmp_path / f"{i}.aam")
        assert (tmp_path / f"{i}.aam").read_bytes() == data


NOTHING = {
    "empty": lambda data: b"",
    "half": lambda data: data[: len(data) // 2],
    "one byte short": lambda data: data[:-1],
    "text": lambda data: b"I am a model, believe me.\n" * 50,
    "pickle": lambda data: pickle.dumps([1, 2, 3]),
}


@pytest.mark.parametrize("fault", NOTHING)
def test_what_is_no_whole_file_is_said_on_one_line(data, tmp_path, fault):
    path = tmp_path / "bad.aam"
    path.write_bytes(NOTHING[fault](data))
    with pytest.raises(InputError, match=r"bad\.aam: ") as error:
        load_aam(path)
    assert "\n" not in str(error.value)


TENSORS = {
    "missing": (lambda t: {"texture_mean": None}, "texture_mean"),
    "misshapen": (lambda t: {"texture_modes": t["texture_modes"][:, 1:]}, "texture_modes must be"),
    "another type": (lambda t: {"variance": t["variance"].astype("f4")}, "variance must be"),
    "NaN": (lambda t: {"modes_of_shape": t["modes_of_shape"] * np.nan}, "modes_of_shape holds NaN"),
    "no variance": (lambda t: {"shape_variance": 0 * t["shape_variance"]}, "must be above zero"),
    "one way less": (lambda t: {"variance": t["variance"][1:]}, "modes_of_shape must be"),
    "vertices outside": (lambda t: {"vertices": t["vertices"] + 900}, "make no mesh"),
    "a triangle beyond": (lambda t: {"triangles": t["triangles"] + 1}, "make no mesh"),
    "triangles turned": (lambda t: {"triangles": t["triangles"][:, ::-1]}, "make no mesh"),
    "no triangles": (lambda t: {"triangles": t["triangles"][:0]}, "make no mesh"),
    "flat vertices": (lambda t: {"vertices": t["vertices"][:, :1]}, "vertices must be"),
}


@pytest.mark.parametrize("fault", TENSORS)
def test_a_bad_tensor_is_named(data, tmp_path, fault):
    change, message = TENSORS[fault]
    rewritten(tmp_path / "bad.aam", data, tensors=change)
    with pytest.raises(InputError, match=rf"bad\.aam: .*{message}") as error:
        load_aam(tmp_path / "bad.aam")
    assert "\n" not in str(error.value)


FACTS = {
    "newer": ({"version": KIND.version + 1}, "format version 2.*update"),
    "another format": ({"format": "mmmgpu-model"}, "not a mmmgpu appearance model"),
    "rows too few": ({"rows": [1, 2]}, "misstates rows"),
    "rows of text": ({"rows": "abc"}, "misstates"),
    "reduction of 0": ({"reduction": 0}, "misstates reduction"),
    "size of one": ({"size": [3]}, "misstates size"),
    "a size without end": ({"size": [10**9, 10**9]}, "misstates size"),
    "no weight": ({"weight": "gone"}, "weight"),
    "weight below zero": ({"weight": -1.0}, "misstates weight"),
    "notes no table": ({"notes": [1]}, "misstates notes"),
}


@pytest.mark.parametrize("fault", FACTS)
def test_a_bad_header_is_said_on_one_line(data, tmp_path, fault):
    change, message = FACTS[fault]
    rewritten(tmp_path / "bad.aam", data, facts=lambda facts: change)
    with pytest.raises(InputError, match=rf"bad\.aam: .*{message}") as error:
        load_aam(tmp_path / "bad.aam")
    assert "\n" not in str(error.value)


def test_a_missing_file_says_how_to_make_one(tmp_path):
    with pytest.raises(
        InputError, match=r"no such appearance model file; make one with: mmmgpu aam"
    ):
        load_aam(tmp_path / "nothing.aam")
