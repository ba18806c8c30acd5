"""Files of other programs that are recognised and not read, each with the step that makes one that is read."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

_ONNX = "python -m tf2onnx.convert --saved-model FOLDER --output policy.onnx"
_NUMPY = (
    'numpy.savez("policy.npz", **{"dense/kernel": W, "dense/bias": b}) with every layer, W of shape (in, out), and '
    "import policy.npz with the layers in their order, as in --prefix dense,dense_1"
)
_NUMBERED = 'numpy.savez("policy.npz", **{"0.weight": W, "0.bias": b}) with every layer, W of shape (out, in)'
_KERAS = (
    f"Write the model as a folder, model.export(FOLDER), and that as ONNX, {_ONNX}; or write its weights, {_NUMPY}."
)
_POINTER = b"version https://git-lfs.github.com/spec/"
_HDF5 = b"\x89HDF\r\n\x1a\n"


def described(raw: bytes, name: str, members: Collection[str] = ()) -> str | None:
    """The kind of a file that is known and not read, and the next step; None if it is none of these.

    Parameters
    ----------
    raw : its first bytes, or more.
    members : the names of its members, if it is a zip archive.
    """
    end = name.lower()
    if raw.startswith(_POINTER):
        return "a pointer of Git LFS, whose file is not here. Fetch it in the folder of its repository, git lfs pull."
    if "model.weights.h5" in members:
        return f"a model of Keras. {_KERAS}"
    if {"data", "parameter_list", "parameters"} <= set(members):
        return (
            "a file of stable-baselines 2, whose weights are arrays of numpy in its member parameters. Read them, "
            f'numpy.load(io.BytesIO(zipfile.ZipFile(FILE).read("parameters"))), and write them again, {_NUMPY}.'
        )
    if raw.startswith(b"\x93NUMPY"):
        return f"one array of numpy. Write all arrays, {_NUMBERED}; a gain K, u = -K x, is one layer, 0.weight = -K."
    if raw.startswith(b"MATLAB") and b"MAT-file" in raw[:128]:
        return (
            "a MAT-file of MATLAB. Write the network there as ONNX, exportONNXNetwork(net, 'policy.onnx'); or load the "
            f"file with scipy.io.loadmat and write its weights, {_NUMBERED}."
        )
    if raw.startswith(_HDF5):
        return f"a file of HDF5, as Keras writes its models. {_KERAS}"
    if end.endswith(".msgpack"):
        return f"a file of msgpack, as flax writes its parameters. Write them with numpy, {_NUMPY}."
    if end.endswith(".nnet"):
        return (
            f"a file of NNet. Write its weights with numpy, {_NUMBERED}; the means and ranges of its inputs are a "
            "normaliser: write them as obs._mean and obs._std beside the layers, and add --epsilon 0."
        )
    if end == "saved_model.pb":
        return f"a part of a SavedModel of TensorFlow. Write its folder as ONNX: {_ONNX}."
    return None


def folder_described(path: Path) -> str:
    """The same for a folder."""
    if (path / "saved_model.pb").is_file():
        return f"a SavedModel of TensorFlow. Write it as ONNX: {_ONNX.replace('FOLDER', str(path))}."
    if any((path / name).exists() for name in ("_METADATA", "_CHECKPOINT_METADATA", "manifest.ocdbt")):
        return f"a checkpoint of orbax. Restore it, and write its parameters with numpy, {_NUMPY}."
    return "a folder. Name the file of the policy in it."
