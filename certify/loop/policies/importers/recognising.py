"""The kind of a policy file, by its bytes, and the reader of that kind."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

from certify.errors import InputError
from certify.loop.files.archives import Archive
from certify.loop.files.arrays import Numbers
from certify.loop.files.barepickle import BEGINNING as BARE
from certify.loop.files.foreign import described
from certify.loop.files.legacy import BEGINNING
from certify.loop.files.pickles import Call
from certify.loop.files.torchfile import TorchFile
from certify.loop.policies.file import is_text
from certify.loop.policies.importers.onnx_graph import read_onnx
from certify.loop.policies.importers.options import ImportOptions
from certify.loop.policies.importers.reading import Reading
from certify.loop.policies.importers.sb3 import read_sb3
from certify.loop.policies.importers.state_dict import is_two_stage, parameters_of, read_state_dict, read_two_stage
from certify.loop.policies.importers.tensors import METADATA, is_npz, load_npz, load_safetensors, load_tensors, metadata
from certify.loop.policies.importers.torchscript import is_torchscript, read_torchscript

Content = Literal["state-dict", "torchscript", "onnx", "sb3", "safetensors", "two-stage", "policy"]
_WANTED = "it must be a file of torch.save, TorchScript, stable-baselines3, ONNX, safetensors or npz, or a pickle"
_MOST_SHOWN = 80  # letters of a text
_OWN, _LYAPUNOV = "certify-policy/", "certify-lyapunov/"


def content_of(raw: bytes, name: str) -> Content | None:
    """Recognise a file's kind by its bytes and, for ONNX, by its name; None if no reader takes it.

    Raises
    ------
    InputError : it is damaged, or of a kind that is known and not read.
    """
    archive = Archive(raw, name) if raw.startswith(b"PK") else None
    if (known := described(raw, name, archive.names if archive is not None else ())) is not None:
        raise InputError(f"{_WANTED}; it is {known}")
    if raw.startswith((b"PK", BEGINNING)):
        if archive is not None and "policy.pth" in archive and "data" in archive:
            return "sb3"
        if archive is not None and is_npz(archive):
            return "state-dict"
        file = TorchFile(raw, name, archive)
        if is_torchscript(file):
            return "torchscript"
        root = file.pickle("data.pkl")
        said = root.get("format") if isinstance(root, dict) else None
        if isinstance(said, str) and said.startswith(_OWN):
            return "policy"
        if isinstance(said, str) and said.startswith(_LYAPUNOV):
            raise InputError("it must hold a policy; it is a Lyapunov function of this program.")
        return "two-stage" if is_two_stage(load_tensors(raw, name, file, modules={})) else "state-dict"
    if name.endswith(".onnx"):
        return "onnx"
    if name.endswith(".safetensors") or raw[4:9] == b"\0\0\0\0{":
        return "safetensors"
    return "state-dict" if raw.startswith(BARE) else None


def kind_of(raw: bytes, name: str, options: ImportOptions) -> Content:
    """The kind of a file by its bytes, or by `options`.

    Raises
    ------
    InputError : its kind is unknown, it is this program's already, or it contradicts the options.
    """
    kind = options.kind if options.kind in ("onnx", "safetensors") else content_of(raw, name)
    if kind is None:
        if raw[:1] in (b"(", b"]", b"}", b"c"):
            raise InputError(f"{_WANTED} of protocol 2 or later; if it is an older one, load it and pickle it again.")
        raise InputError(f"{_WANTED}; it is none of these{', but text' if is_text(raw) else ''}.")
    if kind == "policy":
        raise InputError("it is a policy file of this program already: use it with certify roa --policy.")
    if options.kind not in ("auto", kind) and (options.kind, kind) != ("state-dict", "two-stage"):
        raise InputError(f"it must be what --from says, {options.kind}; it is {kind}.")
    return kind if options.kind == "auto" else options.kind


def read_kind(
    kind: Content,
    raw: bytes,
    name: str,
    options: ImportOptions,
    n: int,
    m: int,
    folder: Path | None,
    beside: str | None,
) -> Reading:
    parameters, modules = parameters_of(options.activation or ""), dict[str, Call]()
    readers: dict[Content, Callable[[], Reading]] = {
        "sb3": lambda: read_sb3(Archive(raw, name), name, options.ignore),
        "torchscript": lambda: read_torchscript(TorchFile(raw, name), n, options.output),
        "onnx": lambda: read_onnx(raw, name, options.output, folder),
        "safetensors": lambda: _with_texts(
            read_state_dict(tensors_in(kind, raw, name, parameters), options, n, m, beside), raw
        ),
        "two-stage": lambda: read_two_stage(tensors_in(kind, raw, name), options),
        "state-dict": lambda: read_state_dict(
            tensors_in(kind, raw, name, parameters, modules), options, n, m, beside, modules
        ),
    }
    return readers[kind]()


def _with_texts(reading: Reading, raw: bytes) -> Reading:
    """The reading of a file of safetensors that says which texts are left out."""
    texts = {key: text for key, text in metadata(raw).items() if f"{METADATA}.{key}" not in reading.unread}
    texts = {key: text for key, text in texts.items() if key != "format"}  # whose tensors they are: pt, np, flax
    if not texts:
        return reading
    said = ", ".join(
        f"{key} = {text if len(text) <= _MOST_SHOWN else text[:_MOST_SHOWN] + ' …'}" for key, text in texts.items()
    )
    return replace(reading, unread={**reading.unread, METADATA: f"texts, from which nothing is taken: {said}"})


def tensors_in(
    kind: Content,
    raw: bytes,
    name: str,
    also: re.Pattern[str] | None = None,
    modules: dict[str, Call] | None = None,
) -> dict[str, Numbers]:
    """The tensors of a state_dict or two-stage file, of safetensors or npz, by their names; `also` and `modules` as in
    `load_tensors`."""
    if raw.startswith(b"PK") and is_npz(Archive(raw, name)):
        return load_npz(raw, name)
    if kind == "safetensors":
        return load_safetensors(raw, name, also)
    return load_tensors(raw, name, also=also, modules=modules)
