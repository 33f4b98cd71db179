"""Entries of the coupled matrix that carried nodes add to the rows and columns of rigid bodies."""

import numpy as np

from ddg_warp.kernels.rigid_bodies.condensation import PLAIN


class CondensationPlan:
    """Condensed entries of raw entries, which have a carried node in row or column; see `kernels.rigid_bodies.condensation`.

    Args:
        rigid: `RigidBodyArrays`.
        raw_rows, raw_columns: blocks of the raw entries.
        out: (N,) blocks without entries in the matrix, bool.

    Attributes:
        rows, columns: blocks of the condensed entry of each term.
        source: raw entry of each term; left, right: carried node whose D multiplies it, `PLAIN` without.
    """

    def __init__(self, rigid, raw_rows: np.ndarray, raw_columns: np.ndarray, out: np.ndarray):
        self.rigid = rigid
        index = np.full(len(out), -1)
        index[rigid.carried] = np.arange(len(rigid.carried))
        terms = [
            (np.arange(len(raw_rows)), row, left, column, right)
            for row, left in self._sides(raw_rows, index)
            for column, right in self._sides(raw_columns, index)
        ]
        source, self.rows, self.left, self.columns, self.right = (
            np.concatenate([term[i] for term in terms]) for i in range(5)
        )
        used = (self.rows >= 0) & (self.columns >= 0)
        used[used] &= ~(out[self.rows[used]] | out[self.columns[used]])
        for name, values in (
            ("source", source),
            *((n, getattr(self, n)) for n in ("rows", "left", "columns", "right")),
        ):
            setattr(self, name, values[used])

    def _sides(self, blocks: np.ndarray, index: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return (block, carried node of D) of both terms of a side; the second is absent (-1) for other blocks."""
        carried = index[blocks]
        owner = self.rigid.owner[carried] if len(self.rigid.owner) else carried
        plain = np.full(len(blocks), PLAIN)
        return [
            (np.where(carried >= 0, self.rigid.origins[owner], blocks), plain),
            (np.where(carried >= 0, self.rigid.spins[owner], -1), carried),
        ]

    def bind(
        self, keys: np.ndarray, position: np.ndarray, raw_position: np.ndarray, blocks: int
    ) -> dict[str, np.ndarray]:
        """Return the arrays of `condense_kernel` by name, and the position `crossing` between origin and rotation of each body.

        Args:
            keys: row * blocks + column of all entries but raw ones, sorted.
            position: their positions; raw_position: of raw entries.
        """
        rigid = self.rigid
        blocks_of_bodies = np.concatenate([rigid.origins, rigid.spins])
        keys_of_terms = self.rows.astype(np.int64) * blocks + self.columns
        diagonal = blocks_of_bodies.astype(np.int64) * blocks + blocks_of_bodies
        diagonal = diagonal[np.isin(diagonal, keys)]
        wanted = np.unique(np.concatenate([keys_of_terms, diagonal]))
        row, column = np.divmod(wanted, blocks)
        turning = np.full(blocks, -1)
        turning[rigid.spins] = np.arange(len(rigid))
        order = np.argsort(keys_of_terms, kind="stable")
        crossing = rigid.origins.astype(np.int64) * blocks + rigid.spins
        place = np.minimum(np.searchsorted(keys, crossing), len(keys) - 1)
        return {
            "targets": position[np.searchsorted(keys, wanted)],
            "rows": np.where(row == column, row, -1),
            "turning": np.where(row == column, turning[row], -1),
            "starts": np.append(np.searchsorted(keys_of_terms[order], wanted), len(order)),
            "sources": raw_position[self.source[order]],
            "crossing": np.where(keys[place] == crossing, position[place], -1),
            "left": self.left[order],
            "right": self.right[order],
        }
