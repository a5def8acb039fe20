"""The tests of a run's checkpoints, of which memory has only where to find them."""

from __future__ import annotations

import bisect
from array import array
from collections.abc import Mapping
from typing import Any

from liir_common.checkpoint import Manifest
from liir_common.files import Table
from liir_common.rpc.gen.liir.v1 import checkpoint_pb2


class Evaluations:
    """evaluations.csv, by episode. A long run tests millions; sixteen bytes of each are in memory."""

    def __init__(self, table: Table, begin: float) -> None:
        """Go on with the table, which nobody else may write to; the run began at the Unix time `begin`."""
        self._table = table
        self._begin = begin
        self._find_rows()

    def __len__(self) -> int:
        return len(self._episodes)

    def __contains__(self, episode: int) -> bool:
        position = bisect.bisect_left(self._episodes, episode)
        return episode in self._episodes[position : position + 1]

    def __getitem__(self, episode: int) -> checkpoint_pb2.Evaluation:
        """The test of the checkpoint of that episode, which there must be."""
        position = bisect.bisect_left(self._episodes, episode)
        return self._read(position, position + 1)[0]

    @property
    def newest(self) -> checkpoint_pb2.Evaluation | None:
        """That of the newest checkpoint that has one."""
        return self._read(len(self) - 1, len(self))[0] if self._episodes else None

    def after(self, episode: int, limit: int) -> list[checkpoint_pb2.Evaluation]:
        """Those of the next checkpoints after `episode`, oldest first."""
        position = bisect.bisect_right(self._episodes, episode)
        return self._read(position, position + limit)

    def add(self, evaluation: checkpoint_pb2.Evaluation, manifest: Manifest) -> None:
        """Store the first test of a checkpoint; if that fails all is as before."""
        try:
            start = self._table.append(_to_row(evaluation, manifest, self._begin))
            self._insert(evaluation.episode, start)
        finally:
            if self._table.columns != self._columns:
                self._find_rows()

    def _find_rows(self) -> None:
        self._episodes, self._starts = array("q"), array("q")
        self._columns: list[str] = []
        for start, row in self._table.scan():
            self._insert(int(row["episode"]), start)
        self._columns = self._table.columns

    def _insert(self, episode: int, start: int) -> None:
        position = bisect.bisect_left(self._episodes, episode)
        if episode in self:  # in a table that somebody has put together; the last row counts
            self._starts[position] = start
            return
        # Nearly always at the end, but a checkpoint whose file was restored is tested late.
        self._episodes.insert(position, episode)
        self._starts.insert(position, start)

    def _read(self, begin: int, end: int) -> list[checkpoint_pb2.Evaluation]:
        starts = self._starts[begin:end]
        return [*map(_from_row, self._table.read_at(starts))] if starts else []


def _to_row(evaluation: checkpoint_pb2.Evaluation, manifest: Manifest, begin: float) -> dict[str, Any]:
    row: dict[str, Any] = {
        "episode": evaluation.episode,
        "env_steps": manifest.env_steps,
        "policy_version": manifest.policy_version,
        "seconds": manifest.created - begin,
        "sha256": evaluation.sha256,
    }
    for name in ("greedy", "sampled"):
        stats = getattr(evaluation, name)
        row |= {
            f"{name}_episodes": stats.episodes,
            f"{name}_wins": stats.wins,
            f"{name}_win_rate": stats.wins / stats.episodes,
            f"{name}_return_mean": stats.return_mean,
            f"{name}_length_mean": stats.length_mean,
        }
        row |= {f"{name}_{key}_mean": stats.info_means[key] for key in sorted(stats.info_means)}
    return row


def _from_row(row: Mapping[str, str]) -> checkpoint_pb2.Evaluation:
    evaluation = checkpoint_pb2.Evaluation(
        episode=int(row["episode"]), sha256=row["sha256"], env_steps=int(row["env_steps"])
    )
    for name in ("greedy", "sampled"):
        stats = getattr(evaluation, name)
        stats.episodes, stats.wins = int(row[f"{name}_episodes"]), int(row[f"{name}_wins"])
        stats.return_mean = float(row[f"{name}_return_mean"])
        stats.length_mean = float(row[f"{name}_length_mean"])
        plain = {"return", "length"}
        for key, value in row.items():
            figure = key.removeprefix(f"{name}_").removesuffix("_mean")
            if value and key == f"{name}_{figure}_mean" and figure not in plain:
                stats.info_means[figure] = float(value)
    return evaluation
