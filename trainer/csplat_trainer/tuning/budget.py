"""A file that is to have a size: what its bytes cost in the loss follows from how many they are."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

_REACHED = 0.6  # fraction of the steps after which the size should be reached: later ones hardly move a value
_BELOW = 0.002  # fraction of the size that is left free: counts come every few steps, and files grow between them
_GAIN, _FASTEST = 40.0, 0.5  # gain of log(cost) per relative excess of bits, and its largest change at each count
_COSTS = (1e-7, 1e-2)
# Smallest cost, as a fraction of the first: files grow while values move far, and a cost that had fallen to nothing,
# because bytes were free before, rises too late.
_LEAST = 0.25


@dataclass
class Budget:
    """Bytes that a file may have, and what they cost at present so that it does.

    Attributes:
        size_bytes: largest size of the file.
        byte_cost: rate weight at present: loss per bit and splat.
        first_bits: bits of the integers at the start of the run; 0: not known yet.
        goal_bits: bits of the integers of a file of that size, by the last file that was made.
    """

    size_bytes: int
    byte_cost: float
    first_bits: float = 0.0
    goal_bits: float = 0.0

    def __post_init__(self) -> None:
        self.byte_cost = min(max(self.byte_cost, _COSTS[0]), _COSTS[1])  # a cost of 0 would stay 0 under any factor

    @property
    def exhausted(self) -> bool:
        """True if the rate weight cannot be raised further."""
        return self.byte_cost >= _COSTS[1]

    @classmethod
    def of(cls, stored: Any) -> Budget | None:
        """The budget of a checkpoint; `None` if it holds none, or not all of its numbers."""
        names = {one.name for one in fields(cls)}
        if not isinstance(stored, dict) or stored.keys() != names:
            return None
        numbers = all(isinstance(one, (int, float)) and math.isfinite(one) for one in stored.values())
        return cls(**stored) if numbers else None

    def overdrawn(self, size_bytes: int, bits: float) -> float:
        """Return the penalty of a file that is too large; its size determines how many bits its integers may have.

        Args:
            size_bytes: size of the file.
            bits: bits of its integers, by their order-0 entropy.
        """
        allowed = (1.0 - _BELOW) * self.size_bytes
        self.first_bits = self.first_bits or bits
        self.goal_bits = max(bits + 8.0 * (allowed - size_bytes), 0.1 * bits)
        return max(0.0, size_bytes / self.size_bytes - 1.0)

    def weigh(self, bits: float, done: float, first_cost: float) -> None:
        """Make bytes dearer or cheaper, by how many bits there are and how many should be left.

        Args:
            bits: bits of the integers at present.
            done: fraction of the steps done.
            first_cost: rate weight at the start of the run.
        """
        wanted = self.goal_bits + (self.first_bits - self.goal_bits) * max(0.0, 1.0 - done / _REACHED)
        by = min(max(_GAIN * (bits / max(wanted, 1.0) - 1.0), -_FASTEST), _FASTEST)
        least = max(_LEAST * min(first_cost, _COSTS[1]), _COSTS[0])
        self.byte_cost = min(max(self.byte_cost * math.exp(by), least), _COSTS[1])
