"""CPU time that a solve may spend."""

from __future__ import annotations

from ponn_torch.optim.base import Stopwatch


class Budget:
    """CPU seconds spent inside its ``with`` blocks, and whether they are more than allowed."""

    def __init__(self, allowed: float) -> None:
        self._allowed, self._before, self._watch = allowed, 0.0, Stopwatch()
        self._running = False

    def __enter__(self) -> None:
        self._watch, self._running = Stopwatch(), True

    def __exit__(self, *_: object) -> None:
        self._before, self._running = self.seconds, False

    def add(self, seconds: float) -> None:
        """Count seconds that were spent before."""
        self._before += seconds

    @property
    def seconds(self) -> float:
        return self._before + (self._watch.seconds if self._running else 0.0)

    @property
    def spent(self) -> bool:
        return self.seconds > self._allowed
