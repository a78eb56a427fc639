"""What needs torch: done in one process of its own, started when it is first asked for."""

import multiprocessing
import os
import threading
from multiprocessing.connection import wait
from pathlib import Path

import numpy as np
import numpy.typing as npt

from shared import settings
from shared.facts import ACTION_COUNT


def begin() -> None:
    """Let robots and learner go first, and end with the page, however it ends."""
    os.nice(10)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(0)

    threading.Thread(target=watch, daemon=True).start()


def predict(run: Path, images: npt.NDArray[np.uint8]) -> tuple[list[list[float]], int | None]:
    """Predictions for all actions with the target network of the newest checkpoint, its episode."""
    from services.commander import frozen

    found = frozen.read(frozen.find(run))
    predictor = found.predictor(settings.read_folder(run).network)
    return predictor.all_values(images).tolist(), found.episode


def marked(
    run: Path, actions: npt.NDArray[np.uint8], descriptors: npt.NDArray[np.uint8], bits: int
) -> npt.NDArray[np.bool_]:
    """Which samples, oldest first, the search of the run's strategy would mark: bool [n]."""
    from shared.rl.retention.rmm import RMM
    from shared.rl.retention.strategy import strategy

    config = settings.read_folder(run).memory
    chosen, found = strategy(config.strategy), np.zeros(len(actions), np.bool_)
    search = chosen if isinstance(chosen, RMM) else RMM()
    for action in range(ACTION_COUNT):
        own = np.flatnonzero(actions == action)
        found[own] = search.similar(descriptors[own], bits, config.rule)
    return found
