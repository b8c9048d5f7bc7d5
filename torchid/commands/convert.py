"""`torchid convert`: a log of one file type as a log of another."""

from __future__ import annotations

from pathlib import Path

from torchid.commands.folder import check_free_file
from torchid.config.experiment import load_topics
from torchid.logs import Log, read_log, write_log
from torchid.logs.containers import new_log_kind
from torchid.report.tables import progress_bars


def convert(source: str | Path, target: str | Path, topics: str | Path | None = None, overwrite: bool = False) -> Log:
    """Read a log and write it as a file of another type, which appears complete or not at all.

    Args:
        source: any log that can be read.
        target: .npz, .h5, .hdf5, .csv or .parquet.
        topics: experiment file whose `logs.topics` says what the topics of a bag hold.
        overwrite: whether `target` may be replaced; what is read never is, as a log may hold more than is written.

    Returns:
        The log, in canonical frames and orders: another quaternion order or frame of the source is not kept.

    Raises:
        InputError: whatever does not fit; nothing has been written then.
    """
    path = Path(target)
    new_log_kind(path)
    check_free_file(path, "OUT", overwrite, (source, *([] if topics is None else [topics])))
    mapped = None if topics is None else load_topics(topics)
    with progress_bars() as bars:
        reading = bars.add_task("reading", total=None)
        log = read_log(source, mapped, lambda share: bars.update(reading, completed=round(100 * share), total=100))
        bars.update(reading, completed=100, total=100)
        bars.add_task("writing", total=None)
        write_log(log, path)
    return log
