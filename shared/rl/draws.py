"""Counter-based randomness: every draw is a function of the seed, a role and a position.

It does not matter which process draws, in which order, or how often it restarted.
"""

from __future__ import annotations

import hashlib

import numpy as np


def generator(seed: int, role: str, *position: int | str) -> np.random.Generator:
    """A fresh generator for one place, e.g. ``generator(seed, "policy", robot, episode, step)``.

    Equal arguments give equal streams; any difference gives an independent one (Philox keyed by a
    128-bit hash).
    """
    place = "\x1f".join([str(seed), role, *(f"{type(p).__name__}:{p}" for p in position)])
    digest = hashlib.blake2b(place.encode(), digest_size=16).digest()
    return np.random.Generator(np.random.Philox(key=int.from_bytes(digest, "little")))
