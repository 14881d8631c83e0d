"""Where do random numbers come from? Named children of the run's one seed ("vio/3", "detector/3", "survey/1")."""

import zlib

import numpy as np


def generator(seed: int, name: str) -> np.random.Generator:
    """The generator that belongs to this name in the run with this seed: the same on every machine, forever."""
    return np.random.Generator(np.random.PCG64([seed, zlib.crc32(name.encode())]))
