"""Parameters of a run that nobody should trust."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hostile_logs import Cases, mutated

NUMBERS = (
    *("NaN", "-Infinity", "1e400", "1e308", "null", "true", '"1"', "[]", "{}", "9" * 5000, "1e", "0x1", "+1"),
    '"\\ud800"',
)  # fmt: skip


def parameter_files(path: Path, count: int, seed: int) -> Cases:
    """Versions of a valid `parameters.json`, which is left as it was."""
    whole = path.read_text()
    try:
        for name, content in _documents(whole).items():
            path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass"))
            yield name, path
        for value in NUMBERS:
            for old in ('"m": ', '"fv": ', '"name": ', '"bodies": '):
                place = whole.index(old, whole.index('"identified": {') if old in ('"m": ', '"fv": ') else 0)
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
        "no bodies": "{}",
        "bodies that are a mapping": '{"bodies": {"a": 1}}',
        "10^5 brackets": deep,
        "10^5 bodies": '{"bodies": [' + ",".join(['{"name": "x"}'] * 100_000) + "]}",
        "a number of 10^6 digits": '{"bodies": ' + "9" * 10**6 + "}",
        "a key twice": whole.replace('"bodies"', '"bodies": [], "bodies"', 1),
        "NUL": whole.replace("name", "na\0me"),
        "not UTF-8": b'{"bodies": "\xff\xfe"}',
        "names with an escape": whole.replace('"name": "', '"name": "\\u001b[2J'),
        "20 MB of blanks": whole + " " * 20_000_000,
        "one body too many": whole.replace('"bodies": [', '"bodies": [{"name": "x"},', 1),
    }
