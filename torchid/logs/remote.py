"""Files elsewhere, by URL: whatever fsspec reaches (object stores, other machines), fetched when they are read."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PosixPath
from typing import Any

from torchid.errors import LogError, TorchidError, excerpt

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")
_BLOCK = 2**20  # bytes
_LONGEST = 200  # characters of another package's message


def is_url(text: str) -> bool:
    """Whether a text is a URL rather than the name of a file here."""
    return _URL.match(text) is not None


class RemoteFile(PosixPath):
    """A file elsewhere: a path with the URL's name and suffix, whose text is the URL."""

    url: str

    @classmethod
    def at(cls, url: str) -> RemoteFile:
        """The file at a URL."""
        out = cls(url)
        out.url = url
        return out

    def __str__(self) -> str:
        return getattr(self, "url", None) or super().__str__()  # parents and the like have no URL

    def __fspath__(self) -> str:
        return str(self)

    def __reduce__(self) -> tuple[Any, ...]:
        return RemoteFile.at, (str(self),)


def as_path(path: object) -> object:
    """A URL as a file elsewhere; anything else as it is."""
    return RemoteFile.at(path) if isinstance(path, str) and is_url(path) else path


def list_matching(pattern: RemoteFile) -> list[RemoteFile]:
    """All files whose names match a URL with * or ? in its last part, in order.

    Raises:
        LogError: their place cannot be read.
    """
    with _reached(pattern, "a place that can be listed"):
        files, place = _file_system(pattern)
        found = files.glob(place.replace("[", "[[]"), detail=True)
        names = sorted(name.rpartition("/")[2] for name, about in found.items() if about.get("type") == "file")
        return [RemoteFile.at(f"{pattern.url.rpartition('/')[0]}/{name}") for name in names]


@contextmanager
def local_copy(path: Path, accepted: str, most: int) -> Iterator[Path]:
    """A file here with the content of a file elsewhere, gone after the block; a file here is itself.

    Args:
        path: the file.
        accepted: instead of one that cannot be read.
        most: bytes that it may have.

    Raises:
        LogError: it cannot be read, or is larger; names the URL.
    """
    if not isinstance(path, RemoteFile):
        yield path
        return
    with tempfile.NamedTemporaryFile(suffix=path.suffix) as copy:
        with _reached(path, accepted):
            files, place = _file_system(path)
            with files.open(place, "rb") as source:
                while block := source.read(_BLOCK):
                    if copy.tell() + len(block) > most:
                        raise LogError(path, "file", f"more than {most} bytes", accepted)
                    copy.write(block)
            copy.flush()
        yield Path(copy.name)


def _file_system(path: RemoteFile) -> tuple[Any, str]:
    """The file system of a URL, and the file's name in it."""
    from fsspec.core import url_to_fs  # takes 30 ms, for those that need it

    files, place = url_to_fs(path.url)
    return files, str(place)


@contextmanager
def _reached(path: RemoteFile, accepted: str) -> Iterator[None]:
    """Turn whatever a file system raises into one line with the URL."""
    try:
        yield
    except TorchidError:
        raise
    except FileNotFoundError as error:
        raise LogError(path, "file", "no such file", accepted) from error
    except ImportError as error:
        found = f"needs a package that is not installed ({_text(error)})"
        raise LogError(path, "file", found, "a URL that fsspec can reach") from error
    except Exception as error:  # every file system has its own
        raise LogError(path, "file", f"cannot be read ({type(error).__name__}: {_text(error)})", accepted) from error


def _text(error: Exception) -> str:
    return excerpt(" ".join(str(error).split()), _LONGEST)
