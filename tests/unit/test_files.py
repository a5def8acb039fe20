"""Files that survive whoever dies while writing them."""

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from liir_common.files import Table, last_row, remove_leftovers, write_atomic
from tests.traced import bytes_at_peak


def test_a_failed_write_leaves_the_old_content_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "file"
    write_atomic(path, b"old")

    def full_disk(_: int) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr("os.fsync", full_disk)
    with pytest.raises(OSError, match="no space"):
        write_atomic(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_table_goes_on_where_it_was(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    table = Table(path)
    table.append({"step": 1, "x": 0.5})
    table.append({"step": 2, "x": 1.5})
    again = Table(path)
    again.append({"step": 3, "x": 2.5})
    assert path.read_text().splitlines() == ["step,x", "1,0.5", "2,1.5", "3,2.5"]
    assert again.read() == [{"step": str(i), "x": f"{i - 1}.5"} for i in (1, 2, 3)]


def test_a_half_written_row_is_dropped(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    Table(path).append({"step": 1, "x": 0.5})
    with path.open("a") as file:
        file.write("2")
    table = Table(path)
    assert [row["step"] for row in table.read()] == ["1"]
    table.append({"step": 2, "x": 1.5})
    assert path.read_text().splitlines() == ["step,x", "1,0.5", "2,1.5"]


def test_a_half_written_header_is_no_header(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("step,x")
    Table(path).append({"step": 1, "x": 0.5})
    assert path.read_text().splitlines() == ["step,x", "1,0.5"]


def test_rows_are_found_again_where_they_begin(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    table = Table(path)
    assert list(table.scan()) == []
    starts = [table.append({"step": step, "x": "é," * step}) for step in range(4)]
    path.write_bytes(path.read_bytes() + b"\n")  # by an editor
    again = Table(path)
    starts.append(again.append({"step": 4, "x": ""}))
    assert [start for start, _ in again.scan()] == starts
    assert [row for _, row in again.scan()] == again.read()
    assert [row["step"] for row in again.read_at([starts[3], starts[0]])] == ["3", "0"]


def test_rows_may_bring_and_lack_columns(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    table = Table(path)
    table.append({"step": 1})
    table.append({"step": 2, "x": 0.5})
    Table(path).append({"step": 3})
    assert path.read_text().splitlines() == ["step,x", "1,", "2,0.5", "3,"]


def test_a_long_table_that_gets_new_columns_is_not_in_memory(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    rows = 100_000
    path.write_text("a,b\n" + "".join(f"{i},{i + 1}\n" for i in range(rows)))
    table = Table(path)
    assert bytes_at_peak(lambda: table.append({"c": 5, "d": 6})) < 300_000 < path.stat().st_size
    assert table.read()[-2:] == [
        {"a": f"{rows - 1}", "b": f"{rows}", "c": "", "d": ""},
        {"a": "", "b": "", "c": "5", "d": "6"},
    ]
    assert len(table.read()) == rows + 1


def test_keep_drops_what_a_resumed_run_writes_again(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    table = Table(path)
    table.keep("step", 0)
    for step in range(1, 6):
        table.append({"x": "é", "step": step})
    path.write_bytes(path.read_bytes() + b"\n")  # by an editor
    table.keep("step", 5)
    assert [row["step"] for row in table.read()] == ["1", "2", "3", "4", "5"]
    table.keep("step", 3)
    table.append({"x": "", "step": 4})
    assert path.read_text().splitlines() == ["x,step", "é,1", "é,2", "é,3", ",4"]
    table.keep("step", 0)
    assert path.read_text().splitlines() == ["x,step"]


@pytest.mark.parametrize(
    ("text", "row"),
    [
        (None, None),
        ("", None),
        ("ste", None),
        ("step,x\n", None),
        ("step,x\n1,", None),
        ("step,x\n1,é\n", {"step": "1", "x": "é"}),
        ("step,x\n1,é\n2,b\n3", {"step": "2", "x": "b"}),
        ("step,x\n1,é\n\n", {"step": "1", "x": "é"}),  # by an editor
    ],
)
def test_the_last_row_is_the_last_that_is_complete(
    tmp_path: Path, text: str | None, row: dict[str, str] | None
) -> None:
    path = tmp_path / "table.csv"
    if text is not None:
        path.write_text(text)
    assert last_row(path) == row


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """The operating system lets this process write no file beyond that size."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("room", [0, 3])
def test_a_row_without_room_leaves_the_table_as_it_was(tmp_path: Path, room: int) -> None:
    path = tmp_path / "table.csv"
    table = Table(path)
    table.append({"step": 1, "x": 0.5})
    before = path.read_bytes()
    with files_of_at_most(len(before) + room), pytest.raises(OSError, match=r"File too large|No space left"):
        table.append({"step": 2, "x": 1.5})
    assert path.read_bytes() == before
    table.append({"step": 2, "x": 1.5})
    assert path.read_text().splitlines() == ["step,x", "1,0.5", "2,1.5"]


def test_a_new_column_without_room_leaves_the_table_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    table = Table(path)
    table.append({"step": 1})
    with files_of_at_most(5), pytest.raises(OSError, match="File too large"):
        table.append({"step": 2, "x": 1.5})
    table.append({"step": 2, "x": 1.5})
    assert path.read_text().splitlines() == ["step,x", "1,", "2,1.5"]


def test_leftovers_of_the_dead_are_removed_and_nothing_else(tmp_path: Path) -> None:
    for name in (".state-1.safetensors.a1b2c3d4", "state-1.safetensors", ".hidden"):
        (tmp_path / name).touch()
    remove_leftovers(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".hidden", "state-1.safetensors"]
