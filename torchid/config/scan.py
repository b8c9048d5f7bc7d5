"""A look at a YAML text before anything is built of it: how deep, how large with aliases unfolded, what it holds."""

from __future__ import annotations

import yaml

from torchid.guards import MAX_DEPTH, MAX_NODES, MAX_TEXT, MAX_YAML
from torchid.text import is_plain, shown

_LOADER: type = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_TAG = "tag:yaml.org,2002:"
#: Tags that settings may have; others make dates, sets or bytes, which stand nowhere in them.
_KINDS = ("str", "int", "float", "bool", "null", "map", "seq", "merge")
_NUMBERS = ("int", "float", "bool", "null")


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
    if len(text) > MAX_YAML:
        raise ValueError(f"more than {MAX_YAML} bytes")
    count = _Count()
    for event in yaml.parse(text, Loader=_LOADER):
        _check_tag(event)
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


def _check_tag(event: yaml.Event) -> None:
    """Refuse a tag that says what its value is not: what builds values of it fails in ways of its own."""
    tag = getattr(event, "tag", None)
    if tag in (None, "!"):
        return
    kind = tag.removeprefix(_TAG)
    if kind not in _KINDS:
        raise ValueError(f"the tag '{shown(tag)}', which settings have no use for")
    if isinstance(event, yaml.ScalarEvent) and kind in _NUMBERS:
        resolved = yaml.resolver.Resolver().resolve(yaml.ScalarNode, event.value, (True, False)).removeprefix(_TAG)
        if resolved != kind and (kind, resolved) != ("float", "int"):
            raise ValueError(f"'{shown(event.value)}', which is no !!{kind}")


def _check_scalar(value: str) -> None:
    if len(value) > MAX_TEXT:
        raise ValueError(f"a text of {len(value)} characters, more than {MAX_TEXT}")
    if not is_plain(value.replace("\n", "")):
        raise ValueError(f"'{shown(value)}', with a control character")
    if "${" in value:
        raise ValueError(f"'{shown(value)}', but ${{...}} stands for nothing here")
