"""A further strategy takes a file and a row of the table; everything else carries it by itself."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[5]
TABLE = "shared/rl/retention/table.py"
STRATEGY = '''
from shared.rl.retention.strategy import Discard, Situation, Strategy


class Alternate(Strategy):
    """Every second sample goes; each sample knows how many discards it has outlived."""

    columns = (("outlived", "<u2"),)

    def choose(self, there: Situation) -> Discard:
        memory = there.memory
        memory.rows["outlived"] += 1
        discards = memory.kept.get("discards", 0) + 1
        told = {"discards": discards}
        return Discard(memory.capacity, memory.ids[::2].copy(), marked=True, keep=told, told=told)

    def state(self, memory):
        return {"most_outlived": int(memory.rows["outlived"].max())}


STRATEGY = Alternate()
'''
USE = """
import sys
from pathlib import Path

from builders import FakePredictor, make_episode

from services.replay.storage import Storage
from shared.config import MemoryConfig
from shared.rl.turn import maintain
from shared.run_record import REPLAY_COLUMNS

config = MemoryConfig(capacity=30, fill="none", strategy="alternate")
told = []
for number in (1, 2, 3):
    storage = Storage(Path(sys.argv[1]), config, "run/1")
    memory = storage.load()
    storage.commit(make_episode(20, seed=number))
    pending = storage.pending(number - 1)
    memory.append(pending.rows, pending.images)
    done = maintain(memory, number, config, FakePredictor())
    storage.apply_turn(pending, memory, done)
    assert done.discarded.told["threshold_percent"] == 1, done
    told.append(done.discarded.told["discards"])
    loaded = storage.load()
    assert loaded.rows["outlived"].tolist() == memory.rows["outlived"].tolist()
    loaded.check_valid()
    storage.close()
assert told == [0, 1, 2], told
assert memory.rows["outlived"].tolist() == [2] * 10 + [1] * 10, memory.rows["outlived"]
assert "discards" in REPLAY_COLUMNS
"""


def test_a_file_and_a_row_make_a_strategy(tmp_path: Path) -> None:
    for folder in ("shared", "services"):
        ignored = shutil.ignore_patterns("__pycache__", "robot_driver", "presets")
        shutil.copytree(ROOT / folder, tmp_path / "code" / folder, ignore=ignored)
    (tmp_path / "code/shared/rl/retention/alternate.py").write_text(STRATEGY)
    table = (tmp_path / "code" / TABLE).read_text()
    row = '    "alternate": Row("alternate", tells=("discards",)),\n'
    added = table.replace('    "normm": ', row + '    "normm": ')
    assert added != table
    (tmp_path / "code" / TABLE).write_text(added)
    path = os.pathsep.join((str(tmp_path / "code"), str(ROOT / "tests")))
    command = [sys.executable, "-P", "-W", "error", "-c", USE, str(tmp_path / "replay")]
    done = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
