"""Run folders, parameters and checkpoints that nobody should trust."""

from __future__ import annotations

import io
import pickle
import zipfile
from collections import OrderedDict
from itertools import islice, product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hostile_logs import Cases, Evil, mutated
from hostile_settings import places_in

NUMBERS = (
    *("NaN", "Infinity", "-Infinity", "1e400", "1e308", "-1e308", "1e-320", "null", "true", '"1"', "[]", "{}", "[[[]]]"),
    *("9" * 400, "-" + "9" * 400, "9" * 5000, "0" * 10, "1e", "1E+999999999", "0x1", "1_0", "١", ".5", "+1", "nul", '"\\ud800"'),
)  # fmt: skip


def parameter_files(path: Path, count: int, seed: int) -> Cases:
    """Versions of a valid `parameters.json`, which is left as it was."""
    whole = path.read_text()
    try:
        for name, content in _documents(whole).items():
            path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass"))
            yield name, path
        for value in NUMBERS:
            for old in ('"m": ', '"fv": ', '"Ixx": ', '"identified": ', '"name": ', '"bodies": '):
                place = whole.index(old, whole.index('"identified": {') if old in ('"m": ', '"fv": ', '"Ixx": ') else 0)
                end = min(x for x in (whole.find(mark, place + len(old)) for mark in (",", "\n")) if x > 0)
                path.write_text(whole[: place + len(old)] + value + whole[end:])
                yield f"{old}{value[:20]}", path
        rng = np.random.default_rng(seed)
        for number in range(count):
            kind, content = mutated(whole.encode(), rng)
            path.write_bytes(content)
            yield f"{kind} {number}", path
    finally:
        path.write_text(whole)


def _documents(whole: str) -> dict[str, str | bytes]:
    deep = "[" * 100_000 + "]" * 100_000
    return {
        "nothing": "",
        "a list": "[]",
        "null": "null",
        "no bodies": "{}",
        "bodies that are null": '{"bodies": null}',
        "bodies that are a number": '{"bodies": 3}',
        "bodies that are a text": '{"bodies": "abc"}',
        "bodies that are a mapping": '{"bodies": {"a": 1}}',
        "bodies that are lists": '{"bodies": [[], [1]]}',
        "10^5 brackets": deep,
        "10^5 brackets in a body": f'{{"bodies": [{deep}]}}',
        "10^5 open brackets": "[" * 100_000,
        "10^5 mappings": '{"a":' * 100_000,
        "10^5 bodies": '{"bodies": [' + ",".join(['{"name": "x"}'] * 100_000) + "]}",
        "a number of 10^6 digits": '{"bodies": ' + "9" * 10**6 + "}",
        "a key twice": whole.replace('"bodies"', '"bodies": [], "bodies"', 1),
        "NUL": whole.replace("name", "na\0me"),
        "not UTF-8": b'{"bodies": "\xff\xfe"}',
        "UTF-16": whole.encode("utf-16"),
        "a byte order mark": b"\xef\xbb\xbf" + whole.encode(),
        "half a letter": '{"bodies": "\ud800"}',
        "names with an escape": whole.replace('"name": "', '"name": "\\u001b[2J'),
        "20 MB of blanks": whole + " " * 20_000_000,
        "one body too many": whole.replace('"bodies": [', '"bodies": [{"name": "x"},', 1),
    }


# ---------------------------------------------------------------------------------------------------------- checkpoints


def checkpoints(path: Path, count: int, seed: int, share: int = 1) -> Cases:
    """Versions of a valid checkpoint, which is left as it was; every so manieth of those with one value changed."""
    whole = path.read_bytes()
    state = torch.load(io.BytesIO(whole), weights_only=True)
    try:
        for name, content in _files(whole).items():
            path.write_bytes(content)
            yield name, path
        for name, other in _states(state).items():
            torch.save(other, path)
            yield name, path
        for place, value in islice(product(places_in(state), VALUES), 0, None, share):
            torch.save(_with(state, place, value), path)
            yield f"{'.'.join(map(str, place))} = {str(value)[:30]}", path
        rng = np.random.default_rng(seed)
        for number in range(count):
            kind, content = mutated(whole, rng)
            path.write_bytes(content)
            yield f"{kind} {number}", path
    finally:
        path.write_bytes(whole)


VALUES: tuple[Any, ...] = (
    *(None, -1, 10**30, float("nan"), float("inf"), "x", [], {}, [1, 2], {"x": 1}, (1, 2), True, "a: &a [*a]"),
    *(torch.zeros(0), torch.zeros(3), torch.full((2, 2), float("nan")), torch.zeros(10**12, device="meta")),
)


def _files(whole: bytes) -> dict[str, bytes]:
    evil = pickle.dumps(Evil())
    return {
        "nothing": b"",
        "a text": b"hello",
        "a pickle": evil,
        "a pickle of torch's old kind": _legacy(),
        "an archive with a pickle": _archive({"archive/data.pkl": evil, "archive/version": b"3"}),
        "an archive without a pickle": _archive({"archive/version": b"3"}),
        "an empty archive": _archive({}),
        "a compressed bomb": _archive({"archive/data.pkl": bytes(2 * 10**8), "archive/version": b"3"}, 8),
        "entries that climb": _archive({"../../x/data.pkl": evil, "../../x/version": b"3"}),
        "20000 entries": _archive({f"archive/{k}": b"" for k in range(20_000)}),
        "a large array of bytes": _archive(
            {"a/data.pkl": b"cbuiltins\nbytearray\n(I4000000000\ntR.", "a/version": b"3"}
        ),
        "endless tuples": _archive({"a/data.pkl": b"\x80\x02" + b"(" * 10**5 + b"t" * 10**5 + b".", "a/version": b"3"}),
        "a long number": _archive({"a/data.pkl": b"\x80\x02\x8b" + b"\xff\xff\xff\x7f" + b"1.", "a/version": b"3"}),
        "a name of os": _archive({"a/data.pkl": b"cos\nsystem\n(S'touch pwned'\ntR.", "a/version": b"3"}),
        "a memo that is not there": _archive({"a/data.pkl": b"\x80\x02h\x07.", "a/version": b"3"}),
        "TorchScript": _archive({"a/code/x.py": b"import os", "a/constants.pkl": b"\x80\x02).", "a/version": b"3"}),
        "twice as long": whole + whole,
    }


def _archive(entries: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return stream.getvalue()


def _legacy() -> bytes:
    stream = io.BytesIO()
    torch.save({"trainer": torch.zeros(3)}, stream, _use_new_zipfile_serialization=False)
    return stream.getvalue()


def _states(state: dict[str, Any]) -> dict[str, Any]:
    deep: list[Any] = []
    for _ in range(400):
        deep = [deep]
    return {
        "a tensor": torch.zeros(3),
        "a list": [1, 2],
        "an ordered mapping": OrderedDict(state),
        "nothing in it": {},
        "a key too many": state | {"x": 1},
        "keys that are numbers": {1: 2},
        "a deep list": state | {"logs": deep},
        "settings that laugh": state
        | {"config": "a: &a [1, 2]\n" + "".join(f"b{k}: &b{k} [*a, *a]\n" for k in range(9))},
        "settings that multiply": state | {"config": _laughs()},
        "settings with a tag": state | {"config": "a: !!python/object/apply:os.system ['touch pwned']"},
        "a tensor that is expanded": state | {"logs": torch.zeros(1).expand(10**12)},
        "a sparse tensor": state | {"logs": torch.eye(3).to_sparse()},
    }


def _laughs() -> str:
    return "a0: &a0 [x, x]\n" + "".join(f"a{k + 1}: &a{k + 1} [{', '.join([f'*a{k}'] * 10)}]\n" for k in range(30))


def _with(state: Any, place: tuple[Any, ...], value: Any) -> Any:
    """A state with another value in one place."""
    if not place:
        return value
    key, *rest = place
    if isinstance(state, dict):
        return type(state)({k: _with(x, tuple(rest), value) if k == key else x for k, x in state.items()})
    return type(state)(_with(x, tuple(rest), value) if k == key else x for k, x in enumerate(state))
