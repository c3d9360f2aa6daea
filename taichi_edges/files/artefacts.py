"""Files are written under a temporary name and renamed, so a killed run never leaves half a file under a final name."""

import contextlib
import csv
import errno
import functools
import hashlib
import io
import json
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TextIO

import psutil
from filelock import lock_descriptor

from taichi_edges.errors import UserError

LOCK = ".lock"  # in the folder of a run, with the number of the process that writes there
NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)  # of file systems that know none


@contextlib.contextmanager
def replacing(path: Path | str) -> Iterator[Path]:
    """A temporary path beside `path` (same suffix) that takes its place when the block ends without an error."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.stem}.{os.getpid()}.unfinished{path.suffix}")
    try:
        yield unfinished
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Nobody else writes into `folder` meanwhile; UserError where another run does so now.

    The system gives the lock up when its process ends, however it ends. The file stays: were it removed, a third
    process might lock a new one beside a second that still holds the old. Its first byte is blank, for Windows lets
    nobody read the byte that is locked.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / LOCK, "a+", encoding="utf-8") as file:
        if not _is_ours(file):
            file.seek(1)
            owner = file.read().strip() or "unknown"
            problem = f"another run, process {owner}, is writing into this folder"
            raise UserError(f"{folder}: {problem}; wait for it, or choose another folder with --out")
        file.truncate(0)
        file.write(f" {os.getpid()}\n")
        file.flush()
        try:
            yield
        finally:
            file.truncate(0)


def _is_ours(file: TextIO) -> bool:
    """Lock an open file; False where another process has. What cannot be locked counts as ours."""
    try:
        return lock_descriptor(file.fileno(), blocking=False)
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        return True


def remove_unfinished(folder: Path | str) -> None:
    """Delete the temporary files that a killed run has left below `folder`; those of a living process stay."""
    for path in Path(folder).rglob(".*.unfinished*"):
        process = path.name.partition(".unfinished")[0].rpartition(".")[2]
        # Our own number is that of a dead process, too: nothing of this run has been written yet.
        if process.isdigit() and (int(process) == os.getpid() or not psutil.pid_exists(int(process))):
            path.unlink(missing_ok=True)


def write_text(path: Path | str, text: str) -> Path:
    """Write a text file, all of it or nothing."""
    with replacing(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
    return Path(path)


def write_json(path: Path | str, content: Any) -> Path:
    """Write JSON, all of it or nothing; keys in the order given, floats with all their digits."""
    return write_text(path, json.dumps(content, indent=1) + "\n")


def file_state(path: Path | str) -> tuple[int, ...]:
    """What changes when a file is written anew, found without reading it: the key of what is remembered about it."""
    status = os.stat(path)
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def digest_file(path: Path | str) -> str:
    """A short hash of a file's bytes; a file that several stages read is hashed once."""
    return _digest_of(os.fspath(path), file_state(path))


@functools.lru_cache(maxsize=1 << 14)
def _digest_of(path: str, _state: tuple[int, ...]) -> str:
    hasher = hashlib.blake2b(digest_size=16)
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            hasher.update(block)
    return hasher.hexdigest()


def digest(content: Any) -> str:
    """A short hash of anything JSON can hold."""
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def write_csv(path: Path | str, rows: Iterable[Sequence[object]]) -> Path:
    """Write a table as CSV, all of it or nothing. rows: the headings first."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return write_text(path, text.getvalue())


def read_facts(path: Path) -> dict[str, Any]:
    """A JSON artefact as a dict; {} where it is not there or damaged (then the stage runs again)."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
