"""Print as JSON what lies in a replay memory; runs in the replay image, which has our code."""

import json
import sys
from pathlib import Path

from services.replay.storage import Storage
from shared.settings import read_folder

folder = Path(sys.argv[1])
config = read_folder(folder)
storage = Storage(folder / "replay", config.memory, f"{config.run.name}/{config.run.seed}")
records = storage.records()
memory = storage.load()
memory.check_valid()
counters = storage.counters()
storage.close()
sys.stdout.write(
    json.dumps(
        {
            "submissions": [(r["robot"], r["life"], r["number"]) for r in records],
            "episodes": [r["commit"]["episode"] for r in records if r["commit"]["episode"]],
            "commits": counters.commit,
            "counted": counters.episode,
            "dropped_samples": counters.dropped_samples,
            "dropped_episodes": counters.dropped_episodes,
        }
    )
    + "\n"
)
