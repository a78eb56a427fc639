"""Configurations, images, samples, observations and episodes for unit tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from services.robot_driver.driver import Driver
from shared.config import Config
from shared.facts import IMAGE_BYTES, IMAGE_SHAPE
from shared.messages import Episode, HaltKind, Observation
from shared.rl.memory import MIRROR, SAMPLE, ReplayMemory, SampleStore

Images = npt.NDArray[np.uint8]
LIFE, OTHER_LIFE = "a" * 12, "b" * 12


def make_config(**sections: dict[str, Any]) -> Config:
    """A configuration with a narrow network and the given sections changed."""
    return Config.model_validate(
        {**sections, "network": {"filters": 4, **sections.get("network", {})}}
    )


def make_images(n: int, seed: int = 0) -> Images:
    """Different noise images: uint8 [n, 50, 75]."""
    return np.random.default_rng(seed).integers(0, 256, (n, *IMAGE_SHAPE), np.uint8)


def image_with(front: bytes) -> bytes:
    """An image that begins with these bytes and is black elsewhere."""
    return front + bytes(IMAGE_BYTES - len(front))


def images_with(fronts: Sequence[bytes]) -> Images:
    """Images that begin with these bytes and are black elsewhere: uint8 [n, 50, 75]."""
    together = b"".join(image_with(front) for front in fronts)
    return np.frombuffer(together, np.uint8).reshape(len(fronts), *IMAGE_SHAPE)


def fill_store(
    store: SampleStore,
    ids: Sequence[int],
    actions: Sequence[int],
    rewards: Sequence[float] | None = None,
    images: Images | None = None,
) -> None:
    """Append samples to a store or memory; images are noise by insertion number if not given."""
    dtype = SAMPLE if isinstance(store, ReplayMemory) else MIRROR
    rows = np.zeros(len(ids), dtype)
    rows["id"], rows["action"] = ids, actions
    rows["reward"] = rewards if rewards is not None else 0.0
    if isinstance(store, ReplayMemory):
        rows["world"] = store.world_indices(["plus"])[0]
    if images is None:
        images = (
            np.concatenate([make_images(1, seed=i) for i in ids])
            if len(ids)
            else np.zeros((0, *IMAGE_SHAPE), np.uint8)
        )
    store.append(rows, images)


def make_observation(sequence: int, **given: Any) -> Observation:
    """An observation of robot `robot1`; its image says its sequence number."""
    plain: dict[str, Any] = {
        "robot": "robot1",
        "life": LIFE,
        "sequence": sequence,
        "image": image_with(sequence.to_bytes(4, "little")),
        "x_m": 0.0,
        "y_m": 0.0,
        "heading_rad": 0.0,
        "bump": False,
        "world": "plus",
        "period_s": 0.25,
        "stamp_s": 0.0,
    }
    return Observation(**{**plain, **given})


def command(driver: Driver, order: str) -> None:
    """What an operator's estop, clear, pause or resume does to a driver."""
    kinds: set[HaltKind] = set()
    kinds |= {"estop"} if driver.safety.estop else set()
    kinds |= {"pause"} if driver.safety.paused else set()
    kind: HaltKind = "estop" if order in ("estop", "clear") else "pause"
    driver.hold(kinds | {kind} if order in ("estop", "pause") else kinds - {kind})


def make_episode(n: int, *, seed: int = 0, images: Images | None = None, **given: Any) -> Episode:
    """A valid submission of n samples with random contents."""
    rng = np.random.default_rng([seed, n])
    ended = given.get("ended", "bump")
    if images is None:
        images = rng.integers(0, 256, (n, *IMAGE_SHAPE), np.uint8)
    plain: dict[str, Any] = {
        "robot": "robot1",
        "life": LIFE,
        "number": seed,
        "fill": False,
        "ended": ended,
        "bump": ended == "bump",
        "weights_version": 1,
        "fitness": n,
        "actions": n,
        "dropped_samples": 0,
        "dropped_episodes": 0,
        "worlds": ("plus",),
        "images": images.tobytes(),
        "sample_actions": rng.integers(0, 3, n).astype(np.uint8).tobytes(),
        "sample_rewards": rng.uniform(-1.0, 1.0, n).astype("<f4").tobytes(),
        "sample_steps": np.arange(n).astype("<u4").tobytes(),
        "sample_episodes": np.full(n, seed, "<u4").tobytes(),
        "sample_versions": np.ones(n, "<u4").tobytes(),
        "sample_worlds": bytes(n),
        "sample_by": bytes(n),
        "positions": rng.uniform(-5.0, 5.0, (n, 3)).astype("<f4").tobytes(),
        "robot_life": OTHER_LIFE,
        "last_sequence": 10_000 * seed + n - 1,
    }
    return Episode(**{**plain, **given})


class FakePredictor:
    """Predictions and descriptors that are simple functions of image and version.

    Q values come from the first four bytes of the image, the descriptor is the first 15 bytes,
    that of units the next 15.
    """

    def __init__(self, version: int = 1) -> None:
        self.version = version
        self._first: FakePredictor | None = None
        self.described: list[int] = []
        """Number of images of each call of `descriptors`."""

    def all_values(self, images: Images, progress: Callable[[int, int], None] | None = None) -> Any:
        """float32 [n, 3] in [-1, 1]."""
        return np.array([fake_values(i.tobytes(), self.version) for i in images], np.float32)

    def values(self, images: Images, actions: Any, progress: Any = None) -> Any:
        """float32 [n]."""
        return self.all_values(images)[np.arange(len(images)), actions]

    def descriptors(self, images: Images, progress: Any = None) -> Any:
        """uint8 [n, 15]."""
        self.described.append(len(images))
        return images.reshape(len(images), -1)[:, :15].copy()

    def unit_descriptors(self, images: Images, progress: Any = None) -> Any:
        """uint8 [n, 15]."""
        self.described.append(len(images))
        return images.reshape(len(images), -1)[:, 15:30].copy()

    def hidden(self, images: Images, actions: Any, progress: Any = None) -> Any:
        """float32 [n, 128] and [n]."""
        numbers = np.array([int.from_bytes(i.tobytes()[:4], "little") + 1 for i in images])
        angles = numbers.reshape(-1, 1) * np.arange(1, 129) + self.version
        return np.abs(np.sin(angles)).astype(np.float32), self.values(images, actions)

    def first(self, seed: int) -> FakePredictor:
        """Version 1."""
        if self._first is None:
            self._first = FakePredictor(1)
        return self._first


def fake_values(image: bytes, version: int) -> list[float]:
    """Q of the three actions for an image under a version, as FakePredictor tells it."""
    number = int.from_bytes(image[:4], "little") + 1
    return [float(np.float32(np.sin(number * (a + 1.7) + version))) for a in range(3)]
