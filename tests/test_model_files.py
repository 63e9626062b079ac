import json
import pickle
import struct
from dataclasses import fields, is_dataclass

import numpy as np
import pytest
from rewriting import rewritten
from safetensors.numpy import save_file
from worlds import make_model

from mmmgpu.errors import InputError
from mmmgpu.model_files import FORMAT, VERSION, load, save_model


@pytest.fixture(scope="module")
def model(basis):
    return make_model(basis)


@pytest.fixture(scope="module")
def data(model, tmp_path_factory):
    """The bytes of a good file."""
    path = tmp_path_factory.mktemp("model") / "good.mmm"
    save_model(model, path)
    return path.read_bytes()


def assert_same(a, b, where=""):
    """Equal in every field, arrays bit for bit and of one type."""
    if is_dataclass(a):
        assert type(a) is type(b)
        for field in fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name), f"{where}.{field.name}")
    elif isinstance(a, dict) and where == ".dynamics":
        assert list(a) == list(b)
        for name in a:
            for one, other in zip(a[name], b[name], strict=True):
                assert_same(one, other, f".{name}")
    elif isinstance(a, dict) and where == ".tracked":
        assert list(a) == list(b)
        for name in a:
            assert_same(a[name], b[name], f".{name}")
    elif isinstance(a, np.ndarray):
        assert (a.shape, a.dtype) == (b.shape, b.dtype), where
        np.testing.assert_array_equal(a, b, err_msg=where)
    else:
        assert a == b, where
        assert type(a) is type(b), where


def test_a_model_comes_back_bit_for_bit(model, tmp_path):
    path = tmp_path / "a model ü.mmm"
    save_model(model, path)
    assert_same(load(path), model)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_the_same_model_is_the_same_file(model, data, tmp_path):
    for i in range(8):
        save_model(model, tmp_path / f"{i}.mmm")
        assert (tmp_path / f"{i}.mmm").read_bytes() == data


def test_the_header_is_json_that_names_format_and_version(data):
    (length,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + length])
    assert json.loads(header["__metadata__"]["mmmgpu"])["format"] == FORMAT
    assert json.loads(header["__metadata__"]["mmmgpu"])["version"] == VERSION


def test_tensors_need_not_lie_in_one_piece(model, tmp_path):
    from dataclasses import replace

    frames = np.asfortranarray(model.prototype_frames)
    save_model(replace(model, prototype_frames=frames), tmp_path / "a.mmm")
    assert_same(load(tmp_path / "a.mmm"), model)


NOTHING = {
    "empty": lambda data: b"",
    "three bytes": lambda data: data[:3],
    "half a header": lambda data: data[:700],
    "header only": lambda data: data[: 8 + struct.unpack("<Q", data[:8])[0]],
    "half": lambda data: data[: len(data) // 2],
    "one byte short": lambda data: data[:-1],
    "one byte more": lambda data: data + b"\0",
    "text": lambda data: b"I am a model, believe me.\n" * 50,
    "pickle": lambda data: pickle.dumps({"images": [1, 2, 3]}),
    "zip": lambda data: b"PK\x03\x04" + bytes(500),
    "huge header": lambda data: struct.pack("<Q", 2**62) + data[8:],
    "header no json": lambda data: data[:8] + b"x" * 300 + data[308:],
}


@pytest.mark.parametrize("fault", NOTHING)
def test_what_is_no_whole_model_file_is_said_on_one_line(data, tmp_path, fault):
    path = tmp_path / "bad ü.mmm"
    path.write_bytes(NOTHING[fault](data))
    with pytest.raises(InputError, match=r"bad ü\.mmm: ") as error:
        load(path)
    assert "\n" not in str(error.value)


class Bomb:
    def __reduce__(self):
        return (pytest.fail, ("the pickle was opened",))


def test_a_pickle_in_disguise_is_never_opened(tmp_path):
    path = tmp_path / "bomb.mmm"
    path.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(InputError, match=r"bomb\.mmm: "):
        load(path)


TENSORS = {
    "missing": (lambda t: {"flows": None}, "flows"),
    "wrong shape": (lambda t: {"flows": t["flows"][:, :-1]}, "flows must be"),
    "one prototype less": (lambda t: {"images": t["images"][1:]}, "images must be"),
    "wrong type": (lambda t: {"images": t["images"].astype(np.float16)}, "images must be"),
    "NaN": (lambda t: {"w_t": np.full_like(t["w_t"], np.nan)}, "w_t holds NaN"),
    "infinite": (lambda t: {"alpha.trained.mean": t["alpha.trained.mean"] * np.inf}, "mean holds"),
    "a variance of zero": (
        lambda t: {"beta.trained.variance": t["beta.trained.variance"] * 0},
        "trained.variance must be above",
    ),
    "singular pose": (lambda t: {"calm.poses": t["calm.poses"] * 0}, "calm.poses"),
    "no background": (
        lambda t: {n: t[n][:0] for n in ("calm.poses", "calm.registered", "calm.correlation")},
        "calm.poses has no frames",
    ),
    "a track missing": (lambda t: {"tracked.1.poses": None}, "tracked.1.poses"),
    "a track cut": (lambda t: {"tracked.1.registered": t["calm.registered"][:1]}, "must be bool"),
    "a singular track": (lambda t: {"tracked.0.poses": t["calm.poses"] * 0}, "tracked.0.poses"),
    "history of another size": (lambda t: {"beta.training": t["beta.training"][:, 1:]}, "training"),
    "scalar": (lambda t: {"calm.poses": np.float64(3.0)}, ""),
}  # fmt: skip


@pytest.mark.parametrize("fault", TENSORS)
def test_a_bad_tensor_is_named(data, tmp_path, fault):
    change, message = TENSORS[fault]
    path = tmp_path / "bad.mmm"
    rewritten(path, data, tensors=change)
    with pytest.raises(InputError, match=rf"bad\.mmm: .*{message}") as error:
        load(path)
    assert "\n" not in str(error.value)


def region(box, mouth=(50.0, 60.0, 20.0)):
    return lambda facts: {"region": {"box": box, "mouth": mouth}}


FACTS = {
    "newer": (lambda f: {"version": VERSION + 1}, f"format version {VERSION + 1}.*update"),
    "no version": (lambda f: {"version": "gone"}, "version"),
    "version no number": (lambda f: {"version": "one"}, "version"),
    "another format": (lambda f: {"format": "other"}, "not a mmmgpu model"),
    "reference beyond": (lambda f: {"reference": 5}, "reference"),
    "reference negative": (lambda f: {"reference": -1}, "reference"),
    "reference no number": (lambda f: {"reference": "first"}, ""),
    "box of three": (region([1, 2, 3]), ""),
    "box of text": (region(["a", "b", "c", "d"]), ""),
    "box of null": (region([None] * 4), ""),
    "no region": (lambda f: {"region": "gone"}, "region"),
    "region a list": (lambda f: {"region": [1, 2]}, ""),
    "rate of zero": (lambda f: {"fps": [25, 0]}, ""),
    "rate below zero": (lambda f: {"fps": [-25, 1]}, ""),
    "rate no list": (lambda f: {"fps": "fast"}, ""),
    "sources of one": (lambda f: {"sources": [["a"]] * 5}, ""),
    "sources a number": (lambda f: {"sources": 3}, ""),
    "labels missing": (lambda f: {"alpha": {"constants": f["alpha"]["constants"]}}, "labels"),
    "labels less": (lambda f: {"alpha": f["alpha"] | {"labels": ["AA"]}}, "alpha"),
    "constants unknown": (lambda f: {"beta": f["beta"] | {"constants": {"x": 1}}}, ""),
    "calm a number": (lambda f: {"calm": 3}, ""),
    "tracked a number": (lambda f: {"tracked": 3}, ""),
    "tracked of a name": (lambda f: {"tracked": [{"clip": "a"}]}, "tracked"),
    "tracked more": (lambda f: {"tracked": f["tracked"] * 2}, "tracked"),
    "tracked a residual of text": (
        lambda f: {"tracked": [one | {"residual": "small"} for one in f["tracked"]]},
        "tracked",
    ),
    "tracked a residual that is none": (
        lambda f: {"tracked": [one | {"residual": np.nan} for one in f["tracked"]]},
        "tracked",
    ),
    "suffix a path": (lambda f: {"calm": f["calm"] | {"suffix": "/../../x.mkv"}}, "suffix"),
}


def other_dynamics(**changes):
    return lambda f: {"dynamics": f["dynamics"] | changes}


MOVEMENTS = {
    "of another model": (
        lambda t: {},
        other_dynamics(hmm=[{"model": "brand", "labels": ["AA", "M", "SIL"]}] * 2),
        "tensor step_mean is missing",
    ),
    "unknown": (lambda t: {}, other_dynamics(x=[{"model": "x", "labels": ["AA"]}] * 2), "'x'"),
    "one stream": (lambda t: {}, lambda f: {"dynamics": {"hmm": f["dynamics"]["hmm"][:1]}}, ""),
    "no table": (lambda t: {}, lambda f: {"dynamics": 3}, ""),
    "NaN": (
        lambda t: {"dynamics.hmm.beta.mean": t["dynamics.hmm.beta.mean"] * np.nan},
        lambda f: {},
        "tensor mean holds NaN",
    ),
    "unstable": (
        lambda t: {"dynamics.dpds.alpha.A": t["dynamics.dpds.alpha.A"] + 1},
        lambda f: {},
        "tensor A must be below 1",
    ),
    "of other dimensions": (
        lambda t: {name: t[name][..., :-1] for name in t if name.startswith("dynamics.slds.alpha")},
        lambda f: {},
        "misstates dynamics.slds.alpha",
    ),
}


@pytest.mark.parametrize("fault", MOVEMENTS)
def test_bad_movements_are_said_on_one_line(data, tmp_path, fault):
    tensors, facts, message = MOVEMENTS[fault]
    path = tmp_path / "bad.mmm"
    rewritten(path, data, tensors=tensors, facts=facts)
    with pytest.raises(InputError, match=rf"bad\.mmm: .*{message}") as error:
        load(path)
    assert "\n" not in str(error.value)
    assert str(error.value).count("bad.mmm") == 1


def test_a_file_from_before_there_were_movements_still_loads(model, data, tmp_path):
    path = tmp_path / "old.mmm"
    rewritten(
        path,
        data,
        tensors=lambda t: {name: None for name in t if name.startswith("dynamics")},
        facts=lambda f: {"dynamics": "gone"},
    )
    old = load(path)
    assert old.dynamics == {}
    assert_same(old.alpha, model.alpha)


@pytest.mark.parametrize("fault", FACTS)
def test_a_bad_header_is_said_on_one_line(data, tmp_path, fault):
    change, message = FACTS[fault]
    path = tmp_path / "bad.mmm"
    rewritten(path, data, facts=change)
    with pytest.raises(InputError, match=rf"bad\.mmm: .*{message}") as error:
        load(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("said", ["", "[]", "3", "null", "{}", '{"format"'])
def test_another_safetensors_file_is_no_model(data, tmp_path, said):
    path = tmp_path / "other.safetensors"
    rewritten(path, data, metadata={"mmmgpu": said})
    with pytest.raises(InputError, match=r"other\.safetensors: not a mmmgpu model"):
        load(path)
    save_file({"weights": np.zeros(3)}, str(path))
    with pytest.raises(InputError, match=r"other\.safetensors: not a mmmgpu model"):
        load(path)


def test_missing_files_and_folders_are_said(tmp_path):
    for name in ("nothing.mmm", ""):
        with pytest.raises(InputError, match=r"no such model file; .*mmmgpu train"):
            load(tmp_path / name)


def test_a_failed_write_leaves_the_old_model(model, data, tmp_path, monkeypatch):
    path = tmp_path / "a.mmm"
    path.write_bytes(data)

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(InputError, match=r"a\.mmm: the disk is full"):
        save_model(model, path)
    assert path.read_bytes() == data
    assert [p.name for p in tmp_path.iterdir()] == ["a.mmm"]
