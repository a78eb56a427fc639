"""The replay memory: samples in order of insertion, each image stored once as uint8."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import numpy.typing as npt

from shared.facts import ACTION_COUNT, IMAGE_SHAPE
from shared.rl.retention.strategy import columns, strategy
from shared.rl.retention.table import STRATEGIES

Ids = npt.NDArray[np.uint64]
Mask = npt.NDArray[np.bool_]
Images = npt.NDArray[np.uint8]

MIRROR = np.dtype([("id", "<u8"), ("slot", "<u4"), ("action", "u1"), ("reward", "<f4")])
"""id: insertion number; slot: where the image lies (never visible outside this file)."""

SAMPLE = np.dtype(
    [
        *MIRROR.descr,
        ("commit", "<u4"),  # submission that brought it: robot, life and worlds stand there
        ("episode", "<u4"),  # global episode number e; 0 while the memory was filled
        ("robot_episode", "<u4"),
        ("step", "<u4"),
        ("version", "<u4"),  # weights that chose the action
        ("world", "<u2"),  # index into ReplayMemory.worlds
        ("by", "u1"),  # who chose the action: index into facts.CHOOSERS
        ("x_m", "<f4"),
        ("y_m", "<f4"),
        ("heading_rad", "<f4"),
        *columns(),
    ]
)
BLOCK = 4096
"""Images per block: the store grows and shrinks by blocks and is never copied as a whole."""
PART = 2048
"""Images looked at together in a pass over the memory: what a GPU takes at once, too."""


class SampleStore:
    """Rows ordered by insertion number, with their images in blocks of fixed place."""

    def __init__(self, dtype: np.dtype[np.void] = MIRROR) -> None:
        self.rows: npt.NDArray[np.void] = np.zeros(0, dtype)
        self._blocks: list[Images] = []
        self._free: list[int] = []

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.rows)

    @property
    def ids(self) -> Ids:
        """The insertion numbers, ascending: uint64 [n]."""
        return self.rows["id"]

    def append(self, rows: npt.NDArray[np.void], images: Images) -> None:
        """Add samples with ascending insertion numbers beyond all stored ones.

        rows: [k] with every field but `slot` set; images: uint8 [k, 50, 75], copied. Raises
        ValueError when sizes, order, actions or rewards are wrong; nothing is stored then.
        """
        if images.shape != (len(rows), *IMAGE_SHAPE) or images.dtype != np.uint8:
            raise ValueError(
                f"images: expected uint8 {[len(rows), *IMAGE_SHAPE]}, "
                f"got {images.dtype} {list(images.shape)}"
            )
        if not len(rows):
            return
        ids = rows["id"]
        if (len(self) and ids[0] <= self.ids[-1]) or np.any(ids[1:] <= ids[:-1]):
            raise ValueError("insertion numbers must grow")
        if rows["action"].max() >= ACTION_COUNT:
            raise ValueError(f"action: expected 0..{ACTION_COUNT - 1}, got {rows['action'].max()}")
        if not np.all(np.abs(rows["reward"]) <= 1.0):
            raise ValueError("reward: expected -1..1")
        added = rows.astype(self.rows.dtype, copy=True)
        added["slot"] = self._take_slots(len(rows))
        self._write(added["slot"], images)
        self.rows = np.concatenate([_whole(self.rows), _whole(added)]).view(self.rows.dtype)

    def remove(self, ids: Ids) -> None:
        """Remove the samples with these insertion numbers. Raises KeyError if one is missing."""
        keep = np.ones(len(self), np.bool_)
        keep[self.ranks(ids)] = False
        self._free.extend(int(slot) for slot in self.rows["slot"][~keep][::-1])
        self.rows = _whole(self.rows)[keep].view(self.rows.dtype)

    def ranks(self, ids: Ids) -> npt.NDArray[np.int64]:
        """Return the positions of insertion numbers. Raises KeyError if one is missing."""
        ranks = np.searchsorted(self.ids, ids)
        if np.any(ranks >= len(self)) or np.any(self.ids[np.minimum(ranks, len(self) - 1)] != ids):
            raise KeyError("insertion number not in memory")
        return ranks

    def set_rewards(self, ids: Ids, rewards: npt.NDArray[np.float32]) -> None:
        """Replace rewards. Raises KeyError if a sample is missing, ValueError outside -1..1."""
        if not np.all(np.abs(rewards) <= 1.0):
            raise ValueError("reward: expected -1..1")
        self.rows["reward"][self.ranks(ids)] = rewards

    def images(self, ranks: npt.NDArray[np.int64]) -> Images:
        """Return copies of the images at these ranks: uint8 [k, 50, 75]."""
        slots = self.rows["slot"][ranks]
        images = np.empty((len(slots), *IMAGE_SHAPE), np.uint8)
        blocks, places = np.divmod(slots, BLOCK)
        for block in np.unique(blocks):
            here = blocks == block
            images[here] = self._blocks[block][places[here]]
        return images

    def parts(self, ranks: npt.NDArray[np.int64]) -> Iterator[tuple[npt.NDArray[np.int64], Images]]:
        """Yield some of these ranks at a time with their images: all would be a second memory."""
        for start in range(0, len(ranks), PART):
            some = ranks[start : start + PART]
            yield some, self.images(some)

    def by_action(self) -> list[int]:
        """Return the number of samples of each action."""
        return [int(n) for n in np.bincount(self.rows["action"], minlength=ACTION_COUNT)]

    def check_valid(self) -> None:
        """Raise AssertionError naming the first invariant that does not hold."""
        slots = [int(slot) for slot in self.rows["slot"]]
        places = sorted([*slots, *self._free])
        rewards = self.rows["reward"]
        actions = not len(self) or int(self.rows["action"].max()) < ACTION_COUNT
        _check(
            [
                (bool(np.all(self.ids[1:] > self.ids[:-1])), "insertion numbers grow"),
                (places == list(range(len(self._blocks) * BLOCK)), "each slot is used or free"),
                (actions, "actions are known"),
                (bool(np.all(np.abs(rewards) <= 1.0)), "rewards lie in [-1, 1]"),
            ]
        )

    def _take_slots(self, count: int) -> npt.NDArray[np.uint32]:
        while len(self._free) < count:
            start = len(self._blocks) * BLOCK
            self._blocks.append(np.empty((BLOCK, *IMAGE_SHAPE), np.uint8))
            self._free = list(range(start + BLOCK - 1, start - 1, -1)) + self._free
        taken = self._free[-count:][::-1]
        del self._free[-count:]
        return np.array(taken, np.uint32)

    def _write(self, slots: npt.NDArray[np.uint32], images: Images) -> None:
        blocks, places = np.divmod(slots, BLOCK)
        for block in np.unique(blocks):
            here = blocks == block
            self._blocks[block][places[here]] = images[here]


def _whole(rows: npt.NDArray[np.void]) -> npt.NDArray[np.void]:
    """Rows as opaque records: numpy copies those some 20 times faster than field by field."""
    return rows.view(np.dtype((np.void, rows.dtype.itemsize)))


class ReplayMemory(SampleStore):
    """The store of replay, with capacity and provenance (A27), and what strategies add."""

    def __init__(self, capacity: int) -> None:
        super().__init__(SAMPLE)
        self.worlds: list[str] = []
        """Names that the column `world` points into."""
        self.kept: dict[str, int] = {}
        """What strategies of retention keep from one discard to the next."""
        self.set_capacity(capacity)

    def set_capacity(self, capacity: int) -> None:
        """Change N while running; surplus samples go at the next discard. Raises ValueError."""
        if capacity < 1:
            raise ValueError(f"capacity: expected at least 1, got {capacity}")
        self.capacity = capacity

    def world_indices(self, names: Sequence[str]) -> npt.NDArray[np.uint16]:
        """Return the indices of world names in `worlds`, which grows as needed."""
        return world_indices(self.worlds, names)

    def check_valid(self) -> None:
        """Raise AssertionError naming the first invariant that does not hold."""
        super().check_valid()
        worlds = not len(self) or int(self.rows["world"].max()) < len(self.worlds)
        _check([(worlds, "worlds are known")])
        for name in STRATEGIES:
            _check(strategy(name).invariants(self.rows))


def world_indices(worlds: list[str], names: Sequence[str]) -> npt.NDArray[np.uint16]:
    """Return the indices of `names` in `worlds`, which grows as needed."""
    for name in names:
        if name not in worlds:
            worlds.append(name)
    return np.array([worlds.index(name) for name in names], np.uint16)


def _check(invariants: Iterable[tuple[bool, str]]) -> None:
    for holds, invariant in invariants:
        if not holds:
            raise AssertionError(f"replay memory: broken invariant: {invariant}")
