"""Tables of a run that grow by a row each episode, with the same numbers for TensorBoard."""

import logging
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from shared import plugins
from shared.config import Config
from shared.rl.network import QNetwork
from shared.run_record import Row, append_csv, read_csv, write_csv
from shared.settings import flatten

DENSE = 4096
"""Up to here TensorBoard shows each episode, then every second one, from twice as many on every
fourth one, and so on: its files stay small."""
MOST_FILES = 50
BAR_PX = 6
"""Height of the bar of a prediction below the image it is of."""
log = logging.getLogger(__name__)


class MetricsLog:
    """One CSV file whose first column is the global episode number, and whose last is never empty.

    A restarted writer says which rows are certain; everything later is written again. Trackers of
    other packages get every row. One that raises gets no more. TensorBoard shows `config`.
    """

    def __init__(self, path: Path, columns: tuple[str, ...], config: Config | None = None) -> None:
        self._path, self._columns, self._config = path, columns, config
        self._board: Any = None
        self._trackers = {
            name: plugins.load(plugins.TRACKERS, name) for name in plugins.names(plugins.TRACKERS)
        }

    def restart(self, rows: Iterable[Row]) -> None:
        """Begin anew with exactly these rows."""
        write_csv(self._path, self._columns, rows)

    def rows(self) -> list[dict[str, str]]:
        """Rows on disk; a torn last line is left out. Raises ValueError for other columns."""
        return read_csv(self._path, self._columns)

    def write(self, row: Row) -> None:
        """Append one row; readers see it when this returns. Raises DiskFull."""
        append_csv(self._path, self._columns, [row])
        for name, tracker in list(self._trackers.items()):
            try:
                tracker(self._path.stem, row)
            except Exception as error:  # noqa: BLE001  (of a program that is not ours)
                log.warning("tracker %s gets no more: %s", name, error)
                del self._trackers[name]
        episode = int(row["episode"])
        if episode % (1 << (episode // DENSE).bit_length()) == 0:
            try:
                self._show(episode, row)
            except OSError as error:
                log.warning("TensorBoard lacks episode %d: %s", episode, error)
                self._board = None

    def show_network(self, episode: int, network: QNetwork, images: npt.NDArray[np.uint8]) -> None:
        """Show weights as histograms, and images [n, 50, 75] above what is predicted for them."""
        with suppress(OSError):
            board = self._opened()
            board.add_images("probes", _probes(network, images), episode)
            for name, parameter in network.named_parameters():
                board.add_histogram(f"weights/{name}", parameter, episode)

    def _show(self, episode: int, row: Row) -> None:
        board = self._opened()
        for column, value in row.items():
            if column != "episode" and not isinstance(value, str):
                board.add_scalar(f"{self._path.stem}/{column}", value, episode)

    def _opened(self) -> Any:
        if self._board is None:
            folder = self._path.parent / "tensorboard" / self._path.stem
            for old in sorted(folder.glob("events.*"))[:-MOST_FILES]:  # one for each start
                old.unlink()
            self._board = SummaryWriter(str(folder), flush_secs=10)
            if self._config is not None:
                flat = flatten(self._config.to_dict())
                for summary in hparams({k: str(v) for k, v in flat.items()}, {}):  # type: ignore[no-untyped-call]
                    self._board.file_writer.add_summary(summary)
        return self._board

    def close(self) -> None:
        """Flush TensorBoard's file."""
        if self._board is not None:
            with suppress(OSError):
                self._board.close()


@torch.no_grad()
def _probes(network: QNetwork, images: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Images with a bar for each action below: empty for -1, full for 1; uint8 [n, 1, h, 75]."""
    pixels = torch.from_numpy(images).to(network.action_vectors.device).unsqueeze(1).float() / 255
    values = network.all_values(network.maps(pixels)).clamp(-1, 1).cpu().numpy()
    width = images.shape[2]
    full = np.arange(width) < width * (values[:, :, np.newaxis] + 1) / 2
    bars = np.repeat(np.where(full, 255, 0), BAR_PX, axis=1)
    bars[:, ::BAR_PX] = 0
    return np.concatenate([images, bars.astype(np.uint8)], axis=1)[:, np.newaxis]
