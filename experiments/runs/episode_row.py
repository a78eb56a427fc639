"""The record of one episode, of a memory, and what proves that compared runs began alike."""

import hashlib

import numpy as np

from experiments.single_process import SingleProcess, TurnDone
from shared.rl.memory import ReplayMemory
from shared.run_record import MemoryRecord, Row, turn_columns


def episode_row(loop: SingleProcess, done: TurnDone, stage: str, seconds: float) -> Row:
    """A row of `episodes.csv` (`run_record.EPISODE_COLUMNS`) about the turn just done."""
    submitted, counters, trainer = done.submitted, loop.counters, loop.trainer
    losses = [trained.loss for trained in done.trained if trained.loss is not None]
    return {
        "episode": done.commit.episode,
        "stage": stage,
        "world": submitted.worlds[-1] if submitted.worlds else "",
        "robot": submitted.robot,
        "ended": submitted.ended,
        "bump": int(submitted.bump),
        "fitness": submitted.fitness,
        "actions": submitted.actions,
        "total_actions": counters.actions,
        "bumps": counters.bumps,
        "laps_left": counters.laps_left,
        "laps_right": counters.laps_right,
        "longest_run_actions": counters.longest_run_actions,
        "samples": done.commit.stored,
        "mini_batches": len(done.trained),
        "loss": f"{float(np.mean(losses)):.6g}" if losses else "",
        "fitting": int(any(trained.batches for trained in done.trained)),
        "train_steps": trainer.train_steps,
        "fits": trainer.fits,
        "weights_version": trainer.version,
        "target_age": done.commit.episode - trainer.episode_at_copy,
        "acting_version": submitted.weights_version,
        **turn_columns(loop.memory, done.maintenance),
        "seconds": round(seconds, 2),
    }


def held(memory: ReplayMemory) -> MemoryRecord | None:
    """What a memory is made of; None if nothing is in it."""
    if not len(memory):
        return None
    rewards = memory.rows["reward"]
    return MemoryRecord(
        of_fill=round(float(np.mean(memory.rows["episode"] == 0)), 4),
        negative=round(float(np.mean(rewards < 0.0)), 4),
        mean_reward=round(float(np.mean(rewards)), 4),
    )


def memory_hash(loop: SingleProcess, before: int) -> str:
    """16 hex digits over what was stored before this insertion number: states and actions."""
    memory = loop.memory
    ranks = np.flatnonzero(memory.ids < before)
    digest = hashlib.sha256()
    for name in ("id", "action", "x_m", "y_m", "heading_rad"):
        digest.update(np.ascontiguousarray(memory.rows[name][ranks]).tobytes())
    digest.update(memory.images(ranks).tobytes())
    return digest.hexdigest()[:16]
