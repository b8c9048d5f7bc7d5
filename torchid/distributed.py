"""Processes that share the work of one run through torch.distributed (the only module that imports it).

All processes run the same program on the same files, and exchange their reduced results. In each exchange a process
sends a value, or the error that ended it. So a failure reaches the others at their next exchange.
"""

from __future__ import annotations

import os
import pickle
import secrets
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from itertools import accumulate
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from torchid.errors import InputError, TorchidError

if TYPE_CHECKING:
    from torch.distributed import ProcessGroup

T = TypeVar("T")

_LAUNCHED = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")  # torchrun sets them
#: For one exchange: processes wait for the slowest. Failures are told, and the death of a process ends its connections.
_PATIENCE = timedelta(days=1)
_POLL = 0.01  # [s]
_FAILED = "failed"
_END = "end"
_STATUS = "status"


class LostProcessError(TorchidError):
    """Another process of the run has ended without an error message."""


class ConnectionFailedError(TorchidError):
    """The processes that torchrun started cannot connect to each other."""


class _RemoteError(Exception):
    """Where another process failed, as the cause of the error that it sent."""


class _Group:
    """The processes of a group; `failed`: one has sent an error; `lost`: one has ended."""

    def __init__(self, group: ProcessGroup | None, rank: int, size: int) -> None:
        self.group = group
        self.rank = rank
        self.size = size
        self.failed = self.lost = False

    def exchange(self, about: str, value: object) -> list[Any]:
        """The values of all processes, in their order.

        Args:
            about: what the value is, the same in all processes.
            value: anything that pickles.

        Raises:
            LostProcessError: a process has gone.
            Exception: the error of a process that failed.
        """
        if self.size == 1:
            return [value]
        if self.failed or self.lost:
            raise LostProcessError("another process of this run has failed; the processes no longer exchange results")
        import torch.distributed as dist

        out: list[Any] = [None] * self.size
        try:
            dist.all_gather_object(out, (about, value), group=self.group)
        except RuntimeError as error:  # of the connection
            self.lost = True
            message = f"process {self.rank} of {self.size}: another process of this run has ended"
            raise LostProcessError(f"{message}. Start the run again") from error
        errors = [sent for what, sent in out if what == _FAILED]
        if errors:
            self.failed = True
            if about == _FAILED:
                return []
            raise _received(*errors[0])
        if any(what != about for what, _ in out):
            self.lost = True
            raise RuntimeError(f"the processes are at different steps: {', '.join(str(what) for what, _ in out)}")
        return [sent for _, sent in out]

    def tell(self, error: Exception) -> None:
        """Send an error to all others, unless they know of it."""
        with suppress(LostProcessError):
            if self.size > 1 and not (self.failed or self.lost):
                self.exchange(_FAILED, _portable(error))


_ALONE = _Group(None, 0, 1)
_launched: _Group | None = None  # this process's group, if the command line has made it
_sharing: _Group | None = None  # the processes that share the work now


def rank() -> int:
    """Number of this process among those that share the work, from 0."""
    return 0 if _sharing is None else _sharing.rank


def world_size() -> int:
    """Number of processes that share the work, 1 outside of `share_work`."""
    return 1 if _sharing is None else _sharing.size


def is_first() -> bool:
    """Whether this process is the one that writes and prints."""
    return rank() == 0


def all_gather(value: T, about: str) -> list[T]:
    """Gather the values of all processes, in rank order.

    Args:
        value: of this process; anything that pickles.
        about: name of the value, for the message if processes disagree.

    Raises:
        LostProcessError: a process has ended.
        Exception: the error of another process.
    """
    return [value] if _sharing is None else _sharing.exchange(about, value)


def from_first(compute: Callable[[], T], about: str) -> T:
    """Call a function in the first process only; all processes get its value, or its error.

    Args:
        compute: the function; passes over samples inside it are not shared.
        about: as for `all_gather`.

    Raises:
        Exception: the error of `compute`.
    """
    value = None
    if is_first():
        with apart():
            value = compute()
    out: T = all_gather(value, about)[0]  # type: ignore[assignment]
    return out


def broadcast(value: T, about: str) -> T:
    """The value of the first process, for decisions that rounding could change on another machine.

    Args:
        value: of this process.
        about: as for `all_gather`.
    """
    return all_gather(value, about)[0]


def require_same(value: object, about: str) -> None:
    """Raise InputError if the processes have different values."""
    if any(other != value for other in all_gather(value, about)):
        raise InputError("", about, "differs between processes", "the same files and settings on every machine")


def own_share(sizes: Sequence[int]) -> slice:
    """The contiguous pieces, of these sizes, that this process works on; all processes get about the same amount.

    Contiguous pieces of one log and contact state reduce to one result.
    """
    number = rank()
    count = world_size()
    total = max(sum(sizes), 1)
    ends = list(accumulate(sizes))
    owners = [min(int(count * (end - size / 2) / total), count - 1) for size, end in zip(sizes, ends, strict=True)]
    return slice(owners.index(number), len(owners) - owners[::-1].index(number)) if number in owners else slice(0)


@contextmanager
def apart() -> Iterator[None]:
    """Share nothing within the block, in which processes do different things."""
    global _sharing
    together = _sharing
    _sharing = _ALONE
    try:
        yield
    finally:
        _sharing = together


@contextmanager
def share_work() -> Iterator[None]:
    """Share passes over samples between the processes of the initialised `torch.distributed` group.

    Every process enters the block and calls the same functions with the same arguments; each gets the same results.
    Outside of the block nothing is shared::

        torch.distributed.init_process_group("gloo")
        with torchid.share_work():
            parts = torchid.compress_parts(logs, builder)

    Without a group, or inside another such block, it has no effect.

    Raises:
        LostProcessError: another process has ended.
        Exception: the error of another process.
    """
    global _sharing
    if _sharing is not None:
        yield
        return
    with _group_of_cpus() as together:
        _sharing = together
        try:
            yield
            together.exchange(_END, None)
        except Exception as error:
            together.tell(error)
            raise
        except BaseException:  # an interrupt: others learn of it from the end of this process, not in some minutes
            together.lost = True
            raise
        finally:
            _sharing = None


def is_launched() -> bool:
    """Whether torchrun has started this process beside others."""
    return _launched is not None


def is_launched_first() -> bool:
    """Whether this process is the first of those that torchrun has started, or the only one."""
    return _launched is None or _launched.rank == 0


def join_launched() -> bool:
    """Join the processes that torchrun has started, if it has started this one, which then ends in `leave_launched`.

    On machines with GPUs, `cuda` is a GPU of its own for each process of the machine, as far as there are some.

    Raises:
        ConnectionFailedError: they do not reach each other.
    """
    global _launched
    if int(os.environ.get("WORLD_SIZE", "1")) == 1 or not all(name in os.environ for name in _LAUNCHED):
        return False
    import torch
    import torch.distributed as dist

    if dist.is_initialized():  # by whoever calls the command line
        return False
    if torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count())
    from torch.distributed.rendezvous import rendezvous

    try:
        store, rank, size = next(rendezvous("env://", timeout=_PATIENCE))
        attempt_store = dist.PrefixStore(_name_of_attempt(store, rank, size), store)  # type: ignore[attr-defined]
        dist.init_process_group("gloo", store=attempt_store, rank=rank, world_size=size, timeout=_PATIENCE)
    except (RuntimeError, ValueError) as error:
        raise ConnectionFailedError(f"the processes of this run cannot connect to each other ({error})") from error
    _launched = _Group(dist.group.WORLD, rank, size)
    return True


def _name_of_attempt(store: Any, rank: int, size: int) -> str:
    """A name that the processes of this attempt have in common, and no attempt before.

    torchrun starts processes again beside the store of the attempt before (torch 2.13), where they would wait at the
    addresses of dead ones. What others have left is told from what they write now by answers to names just drawn.
    """
    drawn = secrets.token_hex(8)
    place = "torchid/{}".format
    if rank:
        store.set(place(rank), drawn)
        name: str = store.get(place(drawn)).decode()  # waits for it
        store.set(place(f"{name}/{rank}"), "")
        return name
    missing = set(range(1, size))
    while missing:
        for other in tuple(missing):
            if store.check([place(other)]):
                store.set(place(store.get(place(other)).decode()), drawn)
            if store.check([place(f"{drawn}/{other}")]):
                missing.remove(other)
        time.sleep(_POLL)
    return drawn


def leave_launched(status: int) -> int:
    """End this process, with the exit status of the first one, which has printed before any other ends.

    At once: Gloo's threads now and then abort a process that ends in order (one in some dozens, torch 2.13).
    """
    if _launched is not None and not _launched.lost:
        _launched.failed = False  # all know
        with suppress(LostProcessError):
            statuses = _launched.exchange(_STATUS, status)
            status = statuses[0] or max(statuses)
    end_process(status)


def end_process(status: int) -> NoReturn:
    """End this process at once, without taking libraries down one by one."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(status)


def is_restart() -> bool:
    """Whether torchrun runs the processes again after one of them had ended (`--max-restarts`)."""
    return os.environ.get("TORCHELASTIC_RESTART_COUNT", "0") != "0"


@contextmanager
def _group_of_cpus() -> Iterator[_Group]:
    """The processes of torch's default group, with connections between their CPUs."""
    dist: Any = sys.modules.get("torch.distributed")  # without it nobody has made a group
    if _launched is not None:
        yield _launched
    elif dist is None or not dist.is_available() or not dist.is_initialized() or dist.get_world_size() == 1:
        yield _ALONE
    elif dist.get_backend() == "gloo":
        yield _Group(dist.group.WORLD, dist.get_rank(), dist.get_world_size())
    else:
        group = dist.new_group(backend="gloo", timeout=_PATIENCE)
        try:
            yield _Group(group, dist.get_rank(), dist.get_world_size())
        finally:
            dist.destroy_process_group(group)


def _portable(error: Exception) -> tuple[bytes, str]:
    """An error as another process can read it, and where it came up."""
    where = "".join(traceback.format_exception(error))
    try:
        data = pickle.dumps(error)
        pickle.loads(data)
    except Exception:  # noqa: B902 - an error may refuse either as it likes
        data = pickle.dumps(RuntimeError(f"{type(error).__name__}: {error}"))
    return data, where


def _received(data: bytes, where: str) -> Exception:
    error: Exception = pickle.loads(data)
    error.__cause__ = _RemoteError(f"\n{where}")
    return error
