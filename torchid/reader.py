"""Foreign files are opened by another process with limits: whatever they do to it ends in one line.

The process takes one file at a time and answers calls of the object that an opener makes of it. Results come back as
JSON and the bytes of arrays, of which nothing is run. It imports no torch, and waits for the next file when one is
closed. Where the system knows no such limits (`resource` is missing), files are read without them.
"""

from __future__ import annotations

import ast
import atexit
import json
import math
import os
import select
import signal
import struct
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from torchid import errors
from torchid.errors import InputError, LogError, TorchidWarning, about_file, current_file, excerpt, warn
from torchid.guards import MAX_ARRAYS, check_regular

MEMORY_BYTES = 3 * 2**28
PROCESSOR_SECONDS = 10
FREE_BYTES = 10_000_000
"""What reading may take of memory and of processor time, of files below so many bytes; more in proportion above."""

LIMITS = "TORCHID_READ_LIMITS"
"""Environment variable: a factor of both limits."""

_MAX_HEADER = 2**28  # bytes of JSON in an answer
_ANSWER_SECONDS = 20.0  # without an answer, per second of processor time that is allowed
_POLL_SECONDS = 0.5
# of values that are sent together; of each, beside its content
_BYTES_OF_GROUP = 2**20
_BYTES_OF_VALUE = 100
_LENGTH = struct.Struct("<Q")
_TO_JSON = json.JSONEncoder().encode
_COMMAND = "import sys; sys.path[:] = {!r}; from torchid.reader import serve; serve()"
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"}  # threads take memory

Opener = Callable[[Path], AbstractContextManager[Any]]


class RemoteObject:
    """What an opener has made of a file, in another process."""

    def __init__(self, reader: _Reader) -> None:
        self._reader = reader

    def call(self, method: str, *args: Any) -> Any:
        """The result of a method, or its error; arguments and result are plain values and arrays."""
        return self._reader.ask({"call": method, "args": args})

    def stream(self, method: str, *args: Any) -> Iterator[Any]:
        """The values that a method yields, one by one."""
        yield from self._reader.ask_for_many({"stream": method, "args": args})


@contextmanager
def open_apart(opener: Opener, path: Path) -> Iterator[RemoteObject]:
    """Open a file in another process.

    Args:
        opener: a function of a module, which gives a context with the object whose methods are called.
        path: the file.

    Raises:
        LogError: no regular file; one whose reader takes too much memory or time, or crashes.
    """
    try:
        check_regular(path)
    except OSError as error:
        raise LogError(path, "file", str(error.strerror), "a regular file") from error
    try:
        reader = _take()
    except OSError as error:
        raise LogError(path, "file", f"cannot start Python to read it ({error})", "an executable Python") from error
    try:
        reader.open(opener, path)
        yield RemoteObject(reader)
    finally:
        reader.close()


def warm_up() -> None:
    """Start a process that reads, for it to be ready when there is something to read."""
    with suppress(OSError):  # which whoever reads will tell
        _idle.append(_take())


_idle: list[_Reader] = []
_of_parent: list[_Reader] = []  # of a fork's: it ends them


def _take() -> _Reader:
    """A process that has nothing to do, of those of this process: a fork has none."""
    while _idle:
        reader = _idle.pop()
        if not reader.is_own:
            _of_parent.append(reader)
        elif reader.is_running:
            return reader
        else:
            reader.end()
    return _Reader()


@atexit.register
def _end_all() -> None:
    while _idle:
        _idle.pop().end()


class _Reader:
    """A process that reads, from the side of who asks."""

    def __init__(self) -> None:
        self._owner = os.getpid()
        self._path = Path()
        self._limits = (0, 0)
        self._is_answering = False  # whether answers to a request are still to come
        command = [sys.executable, "-c", _COMMAND.format(sys.path)]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, bufsize=0, env=os.environ | _ENVIRONMENT
        )
        self._requests: Any = self._process.stdin
        self._answers: Any = self._process.stdout

    @property
    def is_own(self) -> bool:
        """Whether this process has started it."""
        return self._owner == os.getpid()

    @property
    def is_running(self) -> bool:
        return self._process.poll() is None

    def open(self, opener: Opener, path: Path) -> None:
        status = path.stat()
        size = min(status.st_size, 512 * getattr(status, "st_blocks", status.st_size))  # holes of a file count nothing
        times = max(1.0, size / FREE_BYTES) * _factor()
        self._path = path
        self._limits = (int(times * MEMORY_BYTES), math.ceil(times * PROCESSOR_SECONDS))
        self.ask(
            {
                "open": [opener.__module__, opener.__qualname__],
                "path": os.fspath(path.absolute()),
                "source": current_file(),
                "limits": self._limits,
            }
        )

    def close(self) -> None:
        """Leave the process to others, unless it has not said all that it was asked for."""
        if self._is_answering:
            self.end()
            return
        try:
            self.ask({"close": True})
        except BaseException as error:
            self.end()
            if not isinstance(error, Exception):
                raise
        else:
            _idle.append(self)

    def end(self) -> None:
        """End the process."""
        if not self.is_own:
            return
        self._process.kill()
        self._process.wait()
        self._requests.close()
        self._answers.close()

    def ask(self, request: dict[str, Any]) -> Any:
        (answer,) = self.ask_for_many(request)
        return answer

    def ask_for_many(self, request: dict[str, Any]) -> Iterator[Any]:
        self._is_answering = True
        self._send(request)
        while True:
            kind, value = self._receive()
            self._is_answering = kind in ("warning", "value", "values")
            if kind == "warning":
                name, text = value
                warn(text, getattr(errors, name))
            elif kind == "error":
                raise _error(*value)
            elif kind == "value":
                yield value
            elif kind == "values":
                yield from value
            else:
                return

    def _send(self, request: dict[str, Any]) -> None:
        with suppress(BrokenPipeError):  # whose cause the answer tells
            self._requests.write(_TO_JSON(request).encode() + b"\n")

    def _receive(self) -> tuple[str, Any]:
        """Kind and value of the next answer. Raises LogError: the process has ended, or says nothing."""
        patience = _ANSWER_SECONDS * self._limits[1] or None
        if sys.platform != "win32" and not select.select([self._answers], [], [], patience)[0]:
            self.end()
            raise self._failure(f"its reader did not answer for {patience:g} s")
        try:
            return _receive(self._answers)
        except EOFError as error:
            self.end()
            raise self._failure(self._why_ended()) from error

    def _why_ended(self) -> str:
        code = self._process.returncode
        if code == -getattr(signal, "SIGXCPU", 0):
            return f"reading it takes more than {self._limits[1]} s of CPU time"
        reason = signal.Signals(-code).name if code < 0 else f"status {code}"
        return f"its reader crashed ({reason})"

    def _failure(self, reason: str) -> LogError:
        return LogError(self._path, "file", reason, _accepted())


def _factor() -> float:
    text = os.environ.get(LIMITS, "1")
    try:
        factor = float(text)
    except ValueError:
        factor = 0.0
    if not 0.0 < factor < math.inf:
        raise InputError("environment", LIMITS, f"'{excerpt(text)}'", "a number above 0, such as 4")
    return factor


def _accepted() -> str:
    return f"a smaller file, or {LIMITS}=4 in the environment for four times higher limits"


def _error(module: str, name: str, text: str, args: list[Any]) -> Exception:
    """The error of another process; of what is not torchid's own another class of the same name."""
    if module.startswith("torchid."):
        known = getattr(import_module(module), name)
        if issubclass(known, InputError):
            return known(*args)
    if name.endswith("MemoryError"):
        return LogError.at_field("file", "reading it exceeds the memory limit", _accepted())
    return type(name, (Exception,), {})(text)


# ---------------------------------------------------------------------------------------------------- what goes through


def _encode(value: Any, buffers: list[Any]) -> Any:
    """A value as JSON; bytes, and those of arrays, are added to the buffers."""
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            return {"object": value.shape}
        array = np.asarray(value, order="C")
        buffers.append(array.reshape(-1).view(np.uint8).data if array.size else b"")
        return {"array": repr(np.lib.format.dtype_to_descr(array.dtype)), "shape": array.shape}
    if isinstance(value, bytes):
        buffers.append(value)
        return {"bytes": len(value)}
    if isinstance(value, dict):
        return {"dict": [[key, _encode(inner, buffers)] for key, inner in value.items()]}
    if isinstance(value, (list, tuple)):
        return [_encode(inner, buffers) for inner in value]
    return value.item() if isinstance(value, np.generic) else value


def _decode(tree: Any, stream: BinaryIO) -> Any:
    if isinstance(tree, list):
        return [_decode(inner, stream) for inner in tree]
    if not isinstance(tree, dict):
        return tree
    if "dict" in tree:
        return {key: _decode(inner, stream) for key, inner in tree["dict"]}
    if "bytes" in tree:
        return bytes(_read_exactly(stream, bytearray(tree["bytes"])))
    if "object" in tree:
        return np.broadcast_to(np.array(None, dtype=object), tree["object"])
    dtype = np.lib.format.descr_to_dtype(ast.literal_eval(tree["array"]))
    return _array(dtype, tuple(tree["shape"]), stream)


def _array(dtype: np.dtype[Any], shape: tuple[int, ...], stream: BinaryIO) -> NDArray[Any]:
    if dtype.hasobject or math.prod(shape) * dtype.itemsize > MAX_ARRAYS:
        raise EOFError
    out = np.empty(shape, dtype)
    if out.size:
        _read_exactly(stream, out.reshape(-1).view(np.uint8).data)
    return out


def _read_exactly(stream: BinaryIO, buffer: Any) -> Any:
    view = memoryview(buffer)
    while view:
        count = stream.readinto(view)  # type: ignore[attr-defined]
        if not count:
            raise EOFError
        view = view[count:]
    return buffer


def _receive(stream: BinaryIO) -> tuple[str, Any]:
    (length,) = _LENGTH.unpack(_read_exactly(stream, bytearray(_LENGTH.size)))
    if length > _MAX_HEADER:
        raise EOFError
    kind, tree = json.loads(bytes(_read_exactly(stream, bytearray(length))))
    return kind, _decode(tree, stream)


# ---------------------------------------------------------------------------------------------------- the other process


def serve() -> None:
    """Answer requests until there are no more: the whole life of a process that reads."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    with os.fdopen(os.dup(sys.stdout.fileno()), "wb") as stream:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what libraries print
        server = _Server(stream)
        for line in sys.stdin.buffer:
            server.answer(json.loads(line))


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_POLL_SECONDS)
    os._exit(1)


class _Server:
    """Answers requests about one file at a time."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._context: AbstractContextManager[Any] | None = None
        self._opened: Any = None
        self._source = ""

    def answer(self, request: dict[str, Any]) -> None:
        self._source = request.get("source", self._source)
        with warnings.catch_warnings(record=True) as caught, about_file(self._source):
            warnings.simplefilter("always", TorchidWarning)
            try:
                answers = list(self._answers(request)) if "stream" not in request else self._answers(request)
                for kind, value in answers:
                    self._send(kind, value)
            except Exception as error:
                args = error.__reduce__()[1] if isinstance(error, InputError) else ()
                texts = [x if isinstance(x, tuple) else str(x) for x in args]  # type: ignore[attr-defined]
                self._send("error", [type(error).__module__, type(error).__name__, str(error), texts])
                return
        for warning in caught:
            if issubclass(warning.category, TorchidWarning):
                self._send("warning", [warning.category.__name__, str(warning.message)])
        self._send("end", None)

    def _answers(self, request: dict[str, Any]) -> Iterator[tuple[str, Any]]:
        if "open" in request:
            _limit(*request["limits"])
            module, name = request["open"]
            self._context = getattr(import_module(module), name)(Path(request["path"]))
            self._opened = self._context.__enter__()
        elif "close" in request:
            if self._context is not None:
                self._context.__exit__(None, None, None)
            self._context = self._opened = None
        elif "call" in request:
            yield "value", getattr(self._opened, request["call"])(*request["args"])
            return
        else:
            for values in _together(getattr(self._opened, request["stream"])(*request["args"])):
                yield "values", values
            return
        yield "value", None

    def _send(self, kind: str, value: Any) -> None:
        buffers = list[Any]()
        header = _TO_JSON([kind, _encode(value, buffers)]).encode()
        self._stream.write(_LENGTH.pack(len(header)) + header)
        for buffer in buffers:
            self._stream.write(buffer)
        self._stream.flush()


def _together(values: Iterable[Any]) -> Iterator[list[Any]]:
    """Values in groups of about so many bytes."""
    group = list[Any]()
    size = 0
    for value in values:
        group.append(value)
        parts = value if isinstance(value, tuple) else (value,)
        size += _BYTES_OF_VALUE + sum(len(part) for part in parts if isinstance(part, bytes))
        if size > _BYTES_OF_GROUP:
            yield group
            group = []
            size = 0
    yield group


def _limit(memory: int, seconds: int) -> None:
    """Limit what this process may take from now on; nothing where the system knows no limits."""
    try:
        import resource
    except ImportError:
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    taken = 0
    with suppress(OSError):
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limits = {resource.RLIMIT_CPU: math.ceil(used.ru_utime + used.ru_stime + seconds), resource.RLIMIT_CORE: 0}
    if taken:
        limits[resource.RLIMIT_AS] = taken + memory
    for kind, most in limits.items():
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
