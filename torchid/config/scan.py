"""A look at a YAML text before anything is built of it: how deep, how large with aliases unfolded, what it holds."""

from __future__ import annotations

import yaml

from torchid.text import is_plain, shown

#: Bytes of a file, nesting, entries with aliases unfolded, and characters of one entry.
MAX_BYTES, MAX_DEPTH, MAX_NODES, MAX_LETTERS = 2**20, 30, 5000, 5000

_LOADER: type = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Count:
    """Entries of the collections that are open, and of those that have an anchor."""

    def __init__(self) -> None:
        self.open: list[tuple[str | None, int]] = [(None, 0)]
        self.anchored: dict[str, int] = {}

    def add(self, entries: int) -> None:
        anchor, count = self.open[-1]
        self.open[-1] = (anchor, count + entries)
        if sum(count for _, count in self.open) > MAX_NODES:
            raise ValueError(f"more than {MAX_NODES} entries, aliases unfolded")

    def start(self, anchor: str | None) -> None:
        if len(self.open) > MAX_DEPTH:
            raise ValueError(f"nested more than {MAX_DEPTH} deep")
        self.open.append((anchor, 0))

    def end(self) -> None:
        anchor, count = self.open.pop()
        if anchor is not None:
            self.anchored[anchor] = count
        self.add(count + 1)


def check_yaml(text: str) -> None:
    """Refuse what would unfold beyond all bounds, what cannot be shown, and `${...}`, whose value lies elsewhere.

    Raises:
        ValueError, yaml.YAMLError: what was found.
    """
    if len(text) > MAX_BYTES:
        raise ValueError(f"more than {MAX_BYTES} bytes")
    count = _Count()
    for event in yaml.parse(text, Loader=_LOADER):
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in count.anchored:
                raise ValueError(f"'*{shown(str(event.anchor))}', which stands for nothing complete")
            count.add(count.anchored[event.anchor])
        elif isinstance(event, yaml.CollectionStartEvent):
            count.start(event.anchor)
        elif isinstance(event, yaml.CollectionEndEvent):
            count.end()
        elif isinstance(event, yaml.ScalarEvent):
            _check_scalar(event.value)
            count.add(1)
            if event.anchor is not None:
                count.anchored[event.anchor] = 1


def _check_scalar(value: str) -> None:
    if len(value) > MAX_LETTERS:
        raise ValueError(f"a text of {len(value)} characters, more than {MAX_LETTERS}")
    if not is_plain(value.replace("\n", "")):
        raise ValueError(f"'{shown(value)}', with a control character")
    if "${" in value:
        raise ValueError(f"'{shown(value)}', but ${{...}} stands for nothing here")
