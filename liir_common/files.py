"""Writing files so that a reader sees the old content or the new, never a part, whatever dies when."""

from __future__ import annotations

import csv
import os
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TextIO


def write_atomic(path: Path, data: bytes) -> None:
    """Replace `path` by `data`, on disk before the name changes."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


class Table:
    """A CSV file that grows by rows; its columns are fixed by the first row."""

    def __init__(self, path: Path) -> None:
        """Go on with the file at `path`, or begin it."""
        self.path = path
        self.rows = _read(path)
        self._columns: list[str] = list(self.rows[0]) if self.rows else []

    def append(self, row: Mapping[str, Any]) -> None:
        """Add one row, flushed to the operating system; `row` must have the columns of the first."""
        self.extend([row])

    def extend(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Add rows."""
        with self.path.open("a", newline="", encoding="utf-8") as file:
            for row in rows:
                if not self._columns:
                    self._columns = list(row)
                    self._writer(file).writeheader()
                self._writer(file).writerow(row)
                self.rows.append({key: str(value) for key, value in row.items()})

    def keep(self, column: str, at_most: int) -> None:
        """Drop the rows whose `column` is larger; a resumed run writes them again."""
        kept = [row for row in self.rows if int(row[column]) <= at_most]
        self.path.unlink(missing_ok=True)
        self.rows, self._columns = [], []
        self.extend(kept)

    def _writer(self, file: TextIO) -> csv.DictWriter[str]:
        return csv.DictWriter(file, self._columns, lineterminator="\n")


def _read(path: Path) -> list[dict[str, str]]:
    if not path.exists():
        return []
    text = path.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]
    if whole != text:  # the process that wrote the last row died in the middle of it
        write_atomic(path, whole.encode())
    return list(csv.DictReader(whole.splitlines()))
