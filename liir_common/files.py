"""Writing files so that a reader sees the old content or the new, never a part, whatever dies when."""

from __future__ import annotations

import csv
import errno
import fcntl
import hashlib
import io
import mmap
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from liir_common.errors import ConfigError, CorruptError

_DIGEST_DIGITS = 16


def write_atomic(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Replace `path` by `data`, on disk before the name changes; the default lets other users read it."""
    with _replaced(path, mode) as file:
        file.write(data)


@contextmanager
def _replaced(path: Path, mode: int = 0o644) -> Iterator[BinaryIO]:
    """What is written in the block becomes `path`, if all of it can be written."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            os.fchmod(file.fileno(), mode)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def write_digested(path: Path, data: bytes) -> Path:
    """`write_atomic` under a name that ends with the data's digest; returns that path."""
    digest = hashlib.sha256(data).hexdigest()[:_DIGEST_DIGITS]
    path = path.with_stem(f"{path.stem}-{digest}")
    write_atomic(path, data)
    return path


def check_digest(path: Path) -> None:
    """Compare a file with the digest in its name; one that was written before names had any passes.

    Raises:
        CorruptError: the bytes have another digest.
    """
    wanted = re.search(rf"-([0-9a-f]{{{_DIGEST_DIGITS}}})$", path.stem)
    with path.open("rb") as file:
        got = hashlib.file_digest(file, "sha256").hexdigest()
    if wanted and not got.startswith(wanted[1]):
        raise CorruptError(f"{path} is corrupt: its name says SHA-256 {wanted[1]}…, its bytes {got}")


def remove_leftovers(directory: Path) -> None:
    """Remove what processes that died in the middle of `write_atomic` left in a directory."""
    for path in directory.glob(".*.????????"):
        path.unlink()


@contextmanager
def held(directory: Path) -> Iterator[None]:
    """Hold a directory, made if missing, while the block lasts or until this process dies.

    Raises:
        ConfigError: another process holds it.
    """
    directory.mkdir(parents=True, exist_ok=True)
    with (directory / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(
                f"another process works in {directory}; wait for its end, or name another --run-dir"
            ) from None
        yield


@contextmanager
def appended_alone(path: Path) -> Iterator[BinaryIO]:
    """`path`, made if missing, open at its end; one at a time, and who comes later waits."""
    while True:
        with path.open("ab") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            # Whoever had it may have renamed or removed it meanwhile; then the name is free again.
            if _is_named(file, path):
                file.seek(0, os.SEEK_END)
                yield file
                return


def _is_named(file: BinaryIO, path: Path) -> bool:
    try:
        return os.path.samefile(file.fileno(), path)
    except FileNotFoundError:
        return False


class Table:
    """A CSV file that grows by rows. A row may bring new columns; what a row lacks stays empty."""

    def __init__(self, path: Path) -> None:
        """Go on with the file at `path`, or begin it; nobody else may write to it."""
        self.path = path
        self.columns: list[str] = []
        if path.exists():
            # Without the row that a dying process may have left half-written.
            os.truncate(path, complete_bytes(path))
            with path.open("rb") as file:
                self.columns = _cells(file.readline())

    def read(self) -> list[dict[str, str]]:
        """All rows, oldest first."""
        return read_table(self.path)

    def scan(self) -> Iterator[tuple[int, dict[str, str]]]:
        """Where each row begins in the file, and the row: all, oldest first, one in memory at a time."""
        if self.columns:
            with self.path.open("rb") as file:
                start = len(file.readline())
                for line in file:
                    if line.strip():
                        yield start, self._row(line)
                    start += len(line)

    def read_at(self, starts: Iterable[int]) -> Iterator[dict[str, str]]:
        """The rows that begin there; wherever a row brings new columns, all others begin elsewhere."""
        with self.path.open("rb") as file:
            for start in starts:
                file.seek(start)
                yield self._row(file.readline())

    def append(self, row: Mapping[str, Any]) -> int:
        """Add one row, flushed to the operating system; returns where it begins.

        If that fails no row is lost and none is added.
        """
        new = [column for column in row if column not in self.columns]
        if new:
            self._widen(new)
        text = io.StringIO()
        csv.DictWriter(text, self.columns, lineterminator="\n").writerow(row)
        return _append_whole(self.path, text.getvalue().encode())

    def keep(self, column: str, at_most: int) -> None:
        """Drop the last rows, those whose `column` is larger; a resumed run writes them again."""
        if not self.columns:
            return
        place = self.columns.index(column)
        end = complete_bytes(self.path)
        for start, cells in _last_rows_first(self.path):
            if int(cells[place]) <= at_most:
                break
            end = start
        os.truncate(self.path, end)

    def _row(self, line: bytes) -> dict[str, str]:
        return dict(zip(self.columns, _cells(line), strict=True))

    def _widen(self, new: list[str]) -> None:
        """Give all rows empty cells under new columns, one row in memory at a time."""
        columns = [*self.columns, *new]
        with _replaced(self.path) as file:
            file.write(csv_text([], columns).encode())
            if self.columns:
                with self.path.open("rb") as old:
                    old.readline()
                    file.writelines(
                        line.rstrip(b"\n") + b"," * len(new) + b"\n" for line in old if line.strip()
                    )
        self.columns = columns


def _cells(line: bytes) -> list[str]:
    return next(csv.reader([line.decode()]), [])


def append_line(path: Path, line: str) -> None:
    """Append to a file that is there, on disk when this returns; a line left half-written stays one."""
    unfinished = path.stat().st_size > complete_bytes(path)
    start = "\n" if unfinished else ""
    _append_whole(path, f"{start}{line}\n".encode(), durable=True)


def _append_whole(path: Path, data: bytes, durable: bool = False) -> int:
    """Append all of `data` or, where the disk is full, nothing; returns where it begins."""
    with path.open("ab", buffering=0) as file:
        end = file.seek(0, os.SEEK_END)
        try:
            if file.write(data) < len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
            if durable:
                os.fsync(file.fileno())
        except OSError:
            file.truncate(end)
            raise
        return end


def csv_text(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] = ()) -> str:
    """A CSV file's text with a header; `columns` are those of the first row unless given."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns or list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def read_table(path: Path) -> list[dict[str, str]]:
    """All complete rows of a CSV file, which may be growing; none if it does not exist."""
    if not path.exists():
        return []
    text = path.read_text(encoding="utf-8")
    return list(csv.DictReader(text[: text.rfind("\n") + 1].splitlines()))


def last_row(path: Path) -> dict[str, str] | None:
    """The last complete row of a CSV file, which may be long, and growing; None if there is none."""
    if not path.exists():
        return None
    with path.open("rb") as file:
        columns = _cells(file.readline())
        return next((dict(zip(columns, row, strict=True)) for _, row in _last_rows_first(path)), None)


def _last_rows_first(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Where each complete row of a CSV file begins, and its cells; nothing of the file is read but these."""
    if end := complete_bytes(path):
        with path.open("rb") as file, mmap.mmap(file.fileno(), end, access=mmap.ACCESS_READ) as data:
            while start := data.rfind(b"\n", 0, end - 1) + 1:  # 0 for the line of the columns
                if cells := _cells(data[start:end]):
                    yield start, cells
                end = start


def complete_bytes(path: Path) -> int:
    """How many bytes of a file, which may be growing, are complete lines."""
    if not path.stat().st_size:
        return 0
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        return data.rfind(b"\n") + 1
