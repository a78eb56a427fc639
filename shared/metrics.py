"""Metrics of a run: CSV files with one row per episode, and the same numbers for TensorBoard."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path

from torch.utils.tensorboard import SummaryWriter

Row = Mapping[str, int | float | str]


class MetricsLog:
    """One CSV file whose first column is the global episode number, mirrored to TensorBoard.

    A restarted writer says which rows are certain; everything later is written again.
    """

    def __init__(self, folder: Path, name: str, columns: tuple[str, ...]) -> None:
        self._path = folder / "metrics" / f"{name}.csv"
        self._columns, self._name = columns, name
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._board = SummaryWriter(str(folder / "tensorboard" / name), flush_secs=10)

    def restart(self, rows: Iterable[Row]) -> None:
        """Begin anew with exactly these rows."""
        with self._path.open("w", newline="") as file:
            writer = csv.DictWriter(file, self._columns)
            writer.writeheader()
            writer.writerows(rows)

    def kept(self, upto: int) -> list[dict[str, str]]:
        """Rows on disk whose episode is at most `upto`; a torn last line is left out."""
        if not self._path.exists():
            return []
        with self._path.open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if row.get(self._columns[-1])]
        return [row for row in rows if int(row["episode"]) <= upto]

    def write(self, row: Row) -> None:
        """Append one row; visible to readers when this returns."""
        with self._path.open("a", newline="") as file:
            csv.DictWriter(file, self._columns).writerow(row)
        episode = int(row["episode"])
        for column, value in row.items():
            if column != "episode" and not isinstance(value, str):
                self._board.add_scalar(f"{self._name}/{column}", value, episode)

    def close(self) -> None:
        """Flush TensorBoard's file."""
        self._board.close()
