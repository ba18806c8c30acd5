"""A pickle is data: what it asks to be called is not called, and what it claims about sizes is not believed."""

from __future__ import annotations

import collections
import contextlib
import io
import os
import pickle
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from certify.errors import InputError
from certify.loop.files.archives import MAX_BYTES, Archive
from certify.loop.files.arrays import array_of
from certify.loop.files.legacy import BEGINNING
from certify.loop.files.pickles import Call, Name, brief, read_pickle
from certify.loop.policies.importers.tensors import load_tensors

SCALARS = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()


def nested(leaves: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    return st.recursive(
        leaves,
        lambda inner: st.lists(inner) | st.tuples(inner, inner) | st.dictionaries(st.text() | st.integers(), inner),
    )


@given(nested(SCALARS), st.integers(0, 5))
def test_plain_values_are_read_as_python_reads_them(value: Any, protocol: int) -> None:
    assert read_pickle(pickle.dumps(value, protocol), "p") == value


@given(nested(SCALARS | st.binary()), st.integers(3, 5))  # bytes are a call in older protocols
def test_bytes_are_read_as_python_reads_them(value: Any, protocol: int) -> None:
    assert read_pickle(pickle.dumps(value, protocol), "p") == value


@pytest.mark.parametrize("protocol", range(2, 6))
@pytest.mark.parametrize("dtype", ["f4", "f8", "i8", ">f8", "u1"])
@pytest.mark.parametrize("shape", [(), (3,), (2, 3), (0, 2)])
def test_arrays_of_numpy(protocol: int, dtype: str, shape: tuple[int, ...]) -> None:
    array = np.asarray(np.random.default_rng(0).integers(0, 200, shape), dtype=dtype)
    for value in (array, np.asfortranarray(array)):
        read = array_of(read_pickle(pickle.dumps(value, protocol), "p"), "a")
        assert read.dtype == array.dtype.newbyteorder("=") and np.array_equal(read, value) and read.shape == value.shape
    assert array_of(read_pickle(pickle.dumps(np.float64(0.1), protocol), "p"), "a") == 0.1


class Asks:
    """Pickles as a call of a function that must never happen."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.given = (function, arguments)

    def __reduce__(self) -> Any:
        return self.given


@pytest.mark.parametrize("protocol", range(6))
def test_nothing_is_called(protocol: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    attacks = [
        Asks(os.system, "touch executed"),
        Asks(eval, "open('executed', 'w').close()"),
        Asks(exec, "open('executed', 'w').close()"),
        Asks(Path("executed").touch),
        collections.OrderedDict(a=Asks(os.system, "touch executed")),
        [{"x": (Asks(os.system, "touch executed"),)}],
    ]
    for attack in attacks:
        pickle.loads(pickle.dumps(attack, protocol))  # the attack works
        assert (tmp_path / "executed").exists()
        (tmp_path / "executed").unlink()
        read_pickle(pickle.dumps(attack, protocol), "p")
        assert not (tmp_path / "executed").exists()


def test_what_is_asked_for_is_written_down_and_inert() -> None:
    node = read_pickle(pickle.dumps(Asks(os.system, "touch executed")), "p")
    assert isinstance(node, Call) and node.function == Name("posix", "system") and node.arguments == ("touch executed",)
    assert not callable(node) and not callable(node.function)


@pytest.mark.parametrize(
    ("program", "message"),
    [
        (b"cos\nsystem\n}b.", "gives a state to the name os.system"),  # BUILD on a global would set its attributes
        (b"cbuiltins\neval\n(S'a'\nS'b'\nu.", "sets items of the name builtins.eval"),
        (b"cbuiltins\neval\nS'a'\na.", "appends to the name builtins.eval"),
        (b"I1\nS'a'\na.", "appends to 1"),
        (b"]}(]I1\nu.", "a key must be"),
        (b"}((((tttI1\ns.", "is no pickle|a key"),
        (b"\x82\x01.", "EXT1"),
        (b"\x97.", "NEXT_BUFFER"),
        (b"", "ends before|no pickle"),
        (b"(.", "no pickle|ends"),
        (b"0.", "no pickle"),
        (b"g5\n.", "no pickle"),
        (b"\x8e" + struct.pack("<Q", 2**62) + b"a.", "no pickle"),  # says that it holds more than there is
        (b"I1", "no pickle|ends"),
        (b"\x93.", "no pickle"),
        (b"I1\nI2\n\x93.", "two words"),
    ],
)
def test_damaged_and_hostile_pickles_are_refused(program: bytes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_pickle(program, "p")


def test_a_class_may_be_a_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As Lightning has its callbacks; what lies under it is named like all else."""
    program = b"}cposix\nsystem\nI1\ns."
    monkeypatch.chdir(tmp_path)
    assert read_pickle(program, "p") == {Name("posix", "system"): 1}
    saved = io.BytesIO()
    torch.save({"callbacks": {Asks: {"best": torch.ones(1)}}, "w": torch.ones(2, 2)}, saved)
    assert set(load_tensors(saved.getvalue(), "f")) == {"w", f"callbacks.{Asks.__module__}.Asks.best"}
    # a call in a key is none
    with pytest.raises(InputError, match="a key must be"):
        read_pickle(b"}cposix\nsystem\n(S'touch executed'\ntRI1\ns.", "p")
    assert not Path("executed").exists()


def test_a_key_whose_hash_would_take_for_ever_is_refused() -> None:
    doubling = b")" + b"2\x86" * 60  # t = (t, t), sixty times
    with pytest.raises(InputError, match="a key must be"):
        read_pickle(b"}" + doubling + b"I1\ns.", "p")
    deep = read_pickle(doubling + b".", "p")
    assert brief(deep) == "a tuple"


def test_a_value_that_holds_itself_is_walked_once(tmp_path: Path) -> None:
    own: dict[str, Any] = {"w": torch.ones(2, 2)}
    own["self"] = own
    torch.save(own, tmp_path / "own.pt")
    assert list(load_tensors((tmp_path / "own.pt").read_bytes(), "f")) == ["w"]


def dtype(code: str = "f8") -> Call:
    return Call(Name("numpy", "dtype"), (code, False, True), [(3, "<", None, None, None, -1, -1, 0)])


def reconstructed(shape: Any, raw: Any, kind: Any = None) -> Call:
    function = Name("numpy.core.multiarray", "_reconstruct")
    return Call(function, (Name("numpy", "ndarray"), (0,), b"b"), [(1, shape, kind or dtype(), False, raw)])


FROM_BUFFER = Name("numpy._core.numeric", "_frombuffer")
ENCODE = Name("_codecs", "encode")


@pytest.mark.parametrize(
    "node",
    [
        reconstructed((2**40,), b""),
        reconstructed((2**30, 2**30), b""),
        reconstructed((-1,), b""),
        reconstructed((1.0,), b"12345678"),
        reconstructed([True], b"12345678"),
        reconstructed((2,), b"12345678"),
        reconstructed((1,), b"1234567"),
        reconstructed((1,), 3),
        reconstructed((1,), b"12345678", dtype("O")),
        reconstructed((1,), b"12345678", dtype("V8")),
        reconstructed((1,), b"12345678", Call(Name("numpy", "dtype"), ([],))),
        reconstructed((1,), Call(ENCODE, ("a", "rot13"))),
        reconstructed((1,), Call(ENCODE, ("Ā" * 8, "latin1"))),
        reconstructed("ab", b"12345678"),
        Call(FROM_BUFFER, (b"12345678", dtype(), (2,), "C")),
        Call(FROM_BUFFER, (Call(Name("builtins", "open"), ("/etc/passwd",)), dtype(), (1,), "C")),
        Call(Name("numpy._core.multiarray", "scalar"), (dtype("O"), b"12345678")),
        Call(Name("numpy.core.multiarray", "fromfile"), ("/etc/passwd",)),
        Call(Call(Name("a", "b"), ()), ()),
        Name("numpy", "pi"),
        True,
        "1.0",
        None,
    ],
)
def test_hostile_arrays_are_refused(node: Any) -> None:
    with pytest.raises(InputError):
        array_of(node, "a")


TENSORS = {
    "float32": torch.arange(12.0).reshape(3, 4),
    "float64": torch.arange(6.0, dtype=torch.float64),
    "half": torch.tensor([0.1, -3.0], dtype=torch.float16),
    "bfloat16": torch.tensor([0.1, -3.0], dtype=torch.bfloat16),
    "transposed": torch.arange(12.0).reshape(3, 4).T,
    "slice": torch.arange(20.0)[3:11:2],
    "scalar": torch.tensor(2.5),
    "int": torch.tensor([2**40, -1]),
    "parameter": torch.nn.Parameter(torch.tensor([1.0, 2.0])),
}


@pytest.mark.parametrize("name", TENSORS)
def test_tensors_as_torch_reads_them(name: str) -> None:
    buffer = io.BytesIO()
    torch.save({"a": {"b": TENSORS[name]}, "beside": np.random.default_rng(0).bit_generator.state}, buffer)
    read = load_tensors(buffer.getvalue(), "f")
    assert list(read) == ["a.b"]
    expected = TENSORS[name].detach()
    narrow = expected.dtype in (torch.float16, torch.bfloat16)
    expected = expected.to(torch.float32) if narrow else expected
    assert read["a.b"].dtype == expected.numpy().dtype
    assert np.array_equal(read["a.b"], expected.numpy())


def test_what_weights_only_refuses_is_read_and_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    weight = torch.ones(2, 3)
    torch.save({"w": weight, "state": np.random.RandomState(1), "evil": Asks(os.system, "touch executed")}, "a.pt")
    with pytest.raises(pickle.UnpicklingError):
        torch.load("a.pt", weights_only=True)
    assert np.array_equal(load_tensors(Path("a.pt").read_bytes(), "f")["w"], weight.numpy())
    assert not Path("executed").exists()


STORAGE = ("storage", "torch FloatStorage", "0", "cpu", 6)


def torch_file(
    offset: Any = 0,
    size: Any = (2, 3),
    stride: Any = (3, 1),
    storage: tuple[Any, ...] = STORAGE,
    function: str = "torch._utils _rebuild_tensor_v2",
    members: dict[str, bytes] | None = None,
    behind: tuple[Any, ...] = (),
) -> bytes:
    """A file of torch whose one tensor `w` is described by hand."""

    def globals_in(value: Any) -> bytes:
        if isinstance(value, str) and value.startswith("torch"):
            module, name = value.split(" ")
            return f"c{module}\n{name}\n".encode()
        if isinstance(value, tuple):
            return b"(" + b"".join(globals_in(v) for v in value) + b"t"
        return pickle.dumps(value, 2)[2:-1]

    arguments = (
        b"("
        + globals_in(storage)
        + b"Q"
        + b"".join(globals_in(v) for v in (offset, size, stride, False, {}, *behind))
        + b"t"
    )
    program = b"\x80\x02}" + globals_in("w") + globals_in(function) + arguments + b"Rs."
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("a/data.pkl", program)
        archive.writestr("a/data/0", np.arange(6, dtype="<f4").tobytes())
        archive.writestr("outside", np.arange(6, dtype="<f4").tobytes())
        for name, content in (members or {}).items():
            archive.writestr(name, content)
    return buffer.getvalue()


def test_the_file_by_hand_is_read() -> None:
    assert np.array_equal(load_tensors(torch_file(), "f")["w"], np.arange(6.0).reshape(2, 3))
    big = torch_file(members={"a/byteorder": b"big"})
    assert np.array_equal(load_tensors(big, "f")["w"].ravel(), np.arange(6, dtype="<f4").view(">f4").astype(float))


@pytest.mark.parametrize(
    "file",
    [
        torch_file(behind=({"neg": True},)),  # torch would give the numbers negated
        torch_file(offset=1),
        torch_file(offset=-1),
        torch_file(offset=0.0),
        torch_file(offset=2**70),
        torch_file(size=(2, 4), stride=(0, 1)),
        torch_file(size=(2**12, 2**12), stride=(0, 0)),
        torch_file(size=(2**62, 4)),
        torch_file(size=(-2, 3)),
        torch_file(size=()),
        torch_file(size=(0, 3)),
        torch_file(stride=(4, 1)),
        torch_file(stride=(-3, 1)),
        torch_file(stride=(3,)),
        torch_file(stride=(2**40, 1)),
        torch_file(stride=3),
        torch_file(storage=("storage", "torch FloatStorage", "../outside", "cpu", 6)),
        torch_file(storage=("storage", "torch FloatStorage", "/etc/passwd", "cpu", 6)),
        torch_file(storage=("storage", "torch FloatStorage", "1", "cpu", 6)),
        torch_file(storage=("storage", "torch FloatStorage", "²", "cpu", 6)),
        torch_file(storage=("storage", "torch FloatStorage", 0, "cpu", 6)),
        torch_file(storage=("storage", "torch FloatStorage", "0", "cpu", 7)),
        torch_file(storage=("storage", "torch FloatStorage", "0", "cpu", 2**62)),
        torch_file(storage=("storage", "torch QInt8Storage", "0", "cpu", 24)),
        torch_file(storage=("storage", "torch ComplexFloatStorage", "0", "cpu", 3)),
        torch_file(storage=("module", "torch FloatStorage", "0", "cpu", 6)),
        torch_file(storage=("storage", "torch FloatStorage", "0", "cpu")),
        torch_file(members={"a/byteorder": b"middle"}),
        torch_file(members={"b/data.pkl": b"N."}),
    ],
)
def test_hostile_tensors_are_refused(file: bytes) -> None:
    with pytest.raises(InputError):
        load_tensors(file, "f")


def test_a_tensor_that_is_to_be_negated_is_refused() -> None:
    buffer = io.BytesIO()
    negated = torch.ones(2, dtype=torch.complex64).conj().imag
    assert negated.is_neg()
    torch.save({"w": negated}, buffer)
    with pytest.raises(InputError):
        load_tensors(buffer.getvalue(), "f")


@pytest.mark.parametrize("name", ["_rebuild_qtensor", "_rebuild_sparse_tensor", "_rebuild_from_type_v2"])
def test_other_tensors_are_no_tensors(name: str) -> None:
    assert load_tensors(torch_file(function=f"torch._utils {name}"), "f") == {}


def test_many_views_of_one_storage_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("certify.loop.files.torchfile._MAX_NUMBERS", 100)
    buffer = io.BytesIO()
    base = torch.zeros(30)
    torch.save({str(k): base[:] for k in range(4)}, buffer)
    with pytest.raises(InputError, match="at most 100 numbers"):
        load_tensors(buffer.getvalue(), "f")


@pytest.mark.parametrize("base", [torch.zeros(30), np.zeros(30)], ids=["tensor", "array"])
@pytest.mark.parametrize("alone", [True, False])
def test_one_array_under_many_names_is_refused(monkeypatch: pytest.MonkeyPatch, base: Any, alone: bool) -> None:
    monkeypatch.setattr("certify.loop.policies.importers.tensors._MAX_NUMBERS", 100)
    for names in (3, 4):
        value, buffer = {str(k): base for k in range(names)}, io.BytesIO()
        buffer.write(pickle.dumps(value)) if alone else torch.save(value, buffer)
        if names == 3:
            assert len(load_tensors(buffer.getvalue(), "f")) == 3
    with pytest.raises(InputError, match="at most 100 numbers"):
        load_tensors(buffer.getvalue(), "f")


def legacy(value: Any) -> bytes:
    """A file in the format of torch before version 1.6."""
    buffer = io.BytesIO()
    torch.save(value, buffer, _use_new_zipfile_serialization=False)
    return buffer.getvalue()


@pytest.mark.parametrize("name", TENSORS)
def test_files_of_old_torch_are_read_as_torch_reads_them(name: str) -> None:
    base = torch.arange(12.0)
    raw = legacy({"a": {"b": TENSORS[name], "shared": base[2:5]}, "c": base.reshape(3, 4).T, "n": 3})
    assert raw.startswith(BEGINNING)
    read, theirs = load_tensors(raw, "f"), torch.load(io.BytesIO(raw), weights_only=True)
    expected = {"a.b": theirs["a"]["b"].detach(), "a.shared": theirs["a"]["shared"], "c": theirs["c"]}
    assert set(read) == set(expected)
    for key, tensor in expected.items():
        narrow = tensor.dtype in (torch.float16, torch.bfloat16)
        assert np.array_equal(read[key], (tensor.float() if narrow else tensor).numpy())


def test_nothing_in_a_file_of_old_torch_is_called(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    raw = legacy({"w": torch.ones(2), "evil": Asks(os.system, "touch executed")})
    assert np.array_equal(load_tensors(raw, "f")["w"], [1, 1]) and not Path("executed").exists()


def test_damaged_files_of_old_torch_are_refused() -> None:
    raw = legacy({"w": torch.ones(2), "v": torch.zeros(3, dtype=torch.float64)})
    for end in range(len(BEGINNING), len(raw)):
        with pytest.raises(InputError):
            load_tensors(raw[:end], "f")
    for old, new in (
        (b"M\xe9\x03.", b"M\xe8\x03."),  # the protocol
        (b"little_endianq\x02\x88", b"little_endianq\x02\x89"),
        (b"FloatStorage", b"QInt8Storage"),
        (b"FloatStorage", b"ShortStorage"),
        (struct.pack("<q", 2), struct.pack("<q", -2)),
        (struct.pack("<q", 2), struct.pack("<q", 2**62)),
        (b"storage", b"modules"),
    ):
        assert old in raw
        with pytest.raises(InputError):
            load_tensors(raw.replace(old, new, 1), "f")
    with pytest.raises(InputError, match="more behind"):
        load_tensors(raw + b"\0", "f")
    with pytest.raises(InputError, match="pickled whole"):
        load_tensors(legacy(torch.nn.Linear(1, 1)), "f")


@given(st.data())
def test_a_file_of_old_torch_with_changed_bytes_is_refused_or_read(data: st.DataObject) -> None:
    raw = bytearray(legacy({"w": torch.ones(2), "v": [torch.zeros(3, 2)]}))
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(len(BEGINNING), len(raw) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(InputError):
        load_tensors(bytes(raw), "f")


def test_zip_bombs_are_not_unpacked(monkeypatch: pytest.MonkeyPatch) -> None:
    assert MAX_BYTES < 2**31
    monkeypatch.setattr("certify.loop.files.archives.MAX_BYTES", 10_000)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("bomb", bytes(1_000_000))
        archive.writestr("a", bytes(6_000))
        archive.writestr("b", bytes(6_000))
    read = Archive(buffer.getvalue(), "f")
    with pytest.raises(InputError, match="must unpack to at most"):
        read.read("bomb")
    read.read("a")
    with pytest.raises(InputError, match="must unpack to at most"):  # all members together
        read.read("b")


def test_a_size_that_lies_is_not_believed() -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a", bytes(5_000))
    raw = buffer.getvalue().replace(struct.pack("<L", 5_000), struct.pack("<L", 10))
    try:
        assert len(Archive(raw, "f").read("a")) <= 10
    except InputError as error:
        assert "damaged" in str(error)


def test_names_that_stand_twice_are_refused() -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("a", b"1")
        archive.writestr("a", b"2")
    with pytest.raises(InputError, match="once"):
        Archive(buffer.getvalue(), "f")


@given(st.binary(max_size=60))
def test_noise_is_refused_or_read_but_never_crashes(noise: bytes) -> None:
    for read in (lambda: read_pickle(noise, "p"), lambda: Archive(b"PK\x03\x04" + noise, "f")):
        with contextlib.suppress(InputError):
            read()


@given(st.data())
def test_a_torch_file_with_changed_bytes_is_refused_or_read(data: st.DataObject) -> None:
    raw = bytearray(torch_file())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(InputError):
        load_tensors(bytes(raw), "f")
