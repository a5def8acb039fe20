"""Writing files so that a reader sees the old content or the new, never a part, whatever dies when."""

from __future__ import annotations

import csv
import io
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


def write_atomic(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Replace `path` by `data`, on disk before the name changes; the default lets other users read it."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
            os.fchmod(file.fileno(), mode)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


class Table:
    """A CSV file that grows by rows. A row may bring new columns; what a row lacks stays empty."""

    def __init__(self, path: Path) -> None:
        """Go on with the file at `path`, or begin it; nobody else may write to it."""
        self.path = path
        rows = read_table(path)
        self._columns = list(rows[0]) if rows else []
        if rows:
            self._rewrite(rows)  # without the row that a dying process may have left half-written

    def read(self) -> list[dict[str, str]]:
        """All rows, oldest first."""
        return read_table(self.path)

    def append(self, row: Mapping[str, Any]) -> None:
        """Add one row, flushed to the operating system."""
        new = [column for column in row if column not in self._columns]
        if new:
            rows = self.read()
            self._columns += new
            self._rewrite(rows)
        with self.path.open("a", newline="", encoding="utf-8") as file:
            csv.DictWriter(file, self._columns, lineterminator="\n").writerow(row)

    def keep(self, column: str, at_most: int) -> None:
        """Drop the rows whose `column` is larger; a resumed run writes them again."""
        rows = self.read()
        kept = [row for row in rows if int(row[column]) <= at_most]
        if len(kept) < len(rows):
            self._rewrite(kept)

    def _rewrite(self, rows: list[dict[str, str]]) -> None:
        write_atomic(self.path, csv_text(rows, self._columns).encode())


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
