"""Tables of a run that grow by a row each episode, with the same numbers for TensorBoard."""

import logging
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from torch.utils.tensorboard import SummaryWriter

from shared.run_record import Row, append_csv, read_csv, write_csv

DENSE = 4096
"""Up to here TensorBoard shows each episode, then every second one, from twice as many on every
fourth one, and so on: its files stay small."""
MOST_FILES = 50
log = logging.getLogger(__name__)


class MetricsLog:
    """One CSV file whose first column is the global episode number, and whose last is never empty.

    A restarted writer says which rows are certain; everything later is written again.
    """

    def __init__(self, path: Path, columns: tuple[str, ...]) -> None:
        self._path, self._columns = path, columns
        self._board: SummaryWriter | None = None

    def restart(self, rows: Iterable[Row]) -> None:
        """Begin anew with exactly these rows."""
        write_csv(self._path, self._columns, rows)

    def rows(self) -> list[dict[str, str]]:
        """Rows on disk; a torn last line is left out. Raises ValueError for other columns."""
        return read_csv(self._path, self._columns)

    def write(self, row: Row) -> None:
        """Append one row; readers see it when this returns. Raises DiskFull."""
        append_csv(self._path, self._columns, [row])
        episode = int(row["episode"])
        if episode % (1 << (episode // DENSE).bit_length()) == 0:
            try:
                self._show(episode, row)
            except OSError as error:
                log.warning("TensorBoard lacks episode %d: %s", episode, error)
                self._board = None

    def _show(self, episode: int, row: Row) -> None:
        if self._board is None:
            folder = self._path.parent / "tensorboard" / self._path.stem
            for old in sorted(folder.glob("events.*"))[:-MOST_FILES]:  # one for each start
                old.unlink()
            self._board = SummaryWriter(str(folder), flush_secs=10)
        for column, value in row.items():
            if column != "episode" and not isinstance(value, str):
                self._board.add_scalar(f"{self._path.stem}/{column}", value, episode)

    def close(self) -> None:
        """Flush TensorBoard's file."""
        if self._board is not None:
            with suppress(OSError):
                self._board.close()
