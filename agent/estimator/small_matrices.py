"""How are many 3 x 3 matrices inverted at once? By cofactors: numpy's batched inverse costs three times as much."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.interface.frames import Array

_COFACTORS = np.array(
    [
        [[4, 5, 3], [7, 8, 6], [1, 2, 0]],
        [[8, 6, 7], [2, 0, 1], [5, 3, 4]],
        [[5, 3, 4], [8, 6, 7], [2, 0, 1]],
        [[7, 8, 6], [1, 2, 0], [4, 5, 3]],
    ]
).reshape(4, 9)


class Inverses(NamedTuple):
    inverse: Array  # (n, 3, 3)
    determinant: Array  # (n,)


def inverses(matrices: Array) -> Inverses:
    """Of symmetric positive definite matrices (n, 3, 3)."""
    flat = matrices.reshape(-1, 9)
    parts = flat.take(_COFACTORS, axis=1)
    adjugate = parts[:, 0] * parts[:, 1] - parts[:, 2] * parts[:, 3]
    determinant = (flat[:, :3] * adjugate[:, :3]).sum(1)
    return Inverses((adjugate / determinant[:, None]).reshape(-1, 3, 3), determinant)


def diagonal_blocks(matrix: Array) -> Array:
    """The 3 x 3 blocks on the diagonal of a (3n, 3n) matrix, (n, 3, 3): a copy."""
    return matrix.take(diagonal_index(len(matrix) // 3)).reshape(-1, 3, 3)


@lru_cache(maxsize=64)
def diagonal_index(n: int) -> npt.NDArray[np.intp]:
    """Where the entries (n, 9) of the diagonal blocks lie in a flattened (3n, 3n) matrix."""
    row, column = np.divmod(np.arange(9), 3)
    first = 3 * np.arange(n)[:, None]
    return (first + row) * 3 * n + first + column
