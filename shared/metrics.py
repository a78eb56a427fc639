"""Tables of a run that grow by a row each episode, with the same numbers for TensorBoard."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from torch.utils.tensorboard import SummaryWriter

from shared.run_record import Row, append_csv, read_csv, write_csv


class MetricsLog:
    """One CSV file whose first column is the global episode number, mirrored to TensorBoard.

    A restarted writer says which rows are certain; everything later is written again.

    Args:
        path: The file, in the folder of a run.
        columns: Columns of the table; the last one is never empty.
    """

    def __init__(self, path: Path, columns: tuple[str, ...]) -> None:
        self._path, self._columns = path, columns
        self._board = SummaryWriter(str(path.parent / "tensorboard" / path.stem), flush_secs=10)

    def restart(self, rows: Iterable[Row]) -> None:
        """Begin anew with exactly these rows."""
        write_csv(self._path, self._columns, rows)

    def rows(self) -> list[dict[str, str]]:
        """Rows on disk; a torn last line is left out. Raises ValueError for other columns."""
        return read_csv(self._path, self._columns)

    def write(self, row: Row) -> None:
        """Append one row; readers see it when this returns."""
        append_csv(self._path, self._columns, [row])
        episode = int(row["episode"])
        for column, value in row.items():
            if column != "episode" and not isinstance(value, str):
                self._board.add_scalar(f"{self._path.stem}/{column}", value, episode)

    def close(self) -> None:
        """Flush TensorBoard's file."""
        self._board.close()
