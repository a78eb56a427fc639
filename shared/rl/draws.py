"""Counter-based randomness: every draw is a function of the seed, a role and a position."""

import hashlib

import numpy as np
import numpy.typing as npt


def generator(seed: int, role: str, *position: int | str) -> np.random.Generator:
    """A fresh generator for one place, e.g. ``generator(seed, "policy", robot, episode, step)``.

    Any difference gives an independent stream (Philox keyed by a 128-bit hash).
    """
    place = "\x1f".join([str(seed), role, *(f"{type(p).__name__}:{p}" for p in position)])
    digest = hashlib.blake2b(place.encode(), digest_size=16).digest()
    return np.random.Generator(np.random.Philox(key=int.from_bytes(digest, "little")))


def uniform(seed: int, role: str, numbers: npt.NDArray[np.uint64]) -> npt.NDArray[np.float64]:
    """One draw from [0, 1) for each number, always the same one: float64 [n] (SplitMix64)."""
    digest = hashlib.blake2b(f"{seed}\x1f{role}".encode(), digest_size=8).digest()
    with np.errstate(over="ignore"):
        mixed = numbers.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        mixed += np.uint64(int.from_bytes(digest, "little"))
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
        mixed ^= mixed >> np.uint64(31)
    return (mixed >> np.uint64(11)).astype(np.float64) / 2.0**53
