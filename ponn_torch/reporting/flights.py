"""Records of a closed loop: a line per cycle in records.jsonl, TensorBoard scalars, progress on the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from ponn_torch.guidance.verdict import FlightCertificate
from ponn_torch.reporting.records import RECORDS, JsonLines

if TYPE_CHECKING:
    from typing import Self


class FlightRecorder:
    """Writes what a loop tells, through at once, so that an interrupted flight keeps all it had.

    Every line of records.jsonl has ``event``: cycle, certificate, monte_carlo, failure.
    """

    def __init__(
        self,
        folder: Path,
        *,
        n_cycles: int,
        time_label: str = "s",
        settings: Mapping[str, Any] | None = None,
        tensorboard: bool = True,
        progress: bool = True,
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._lines = JsonLines(folder / RECORDS)
        self._n_cycles, self._time_label, self._progress = n_cycles, time_label, progress
        self._events: Any = None
        if tensorboard:
            # only here: its import takes longer than a short flight
            from ponn_torch.reporting.events import Scalars

            metrics = ("certificate/certified", "certificate/largest_error", "certificate/median_error")
            self._events = Scalars(folder, settings or {}, metrics)

    def cycle(self, record: Mapping[str, Any]) -> None:
        """One cycle, as `fly` tells it."""
        self._lines.write("cycle", **record)
        number = int(record["cycle"])
        if self._events is not None:
            self._events.write(record, number)
        if self._progress and (number + 1) % max(1, self._n_cycles // 10) == 0:
            errors = "  ".join(f"{name} {value:.3g}" for name, value in record["error"].items())
            passes = f"{record['passes']} pass(es)  " if "passes" in record else ""
            print(
                f"cycle {number + 1:5}/{self._n_cycles}  t {record['time']:8.4g} {self._time_label}  "
                f"{passes}{1e3 * record['seconds']:6.2f} ms  errors: {errors}",
                flush=True,
            )

    def certificate(self, certificate: FlightCertificate) -> None:
        self._lines.write("certificate", **certificate.to_dict())
        if self._events is not None:
            told = {key: value for key, value in certificate.to_dict().items() if not isinstance(value, list)}
            self._events.write({"certificate": told}, self._n_cycles)
        if self._progress:
            print(certificate.verdict, flush=True)

    def monte_carlo(self, summary: Mapping[str, Any]) -> None:
        self._lines.write("monte_carlo", **summary)

    def failed(self, reason: str) -> None:
        self._lines.write("failure", reason=reason)
        if self._events is not None:
            self._events.failed(reason)

    def close(self) -> None:
        self._lines.close()
        if self._events is not None:
            self._events.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error is not None:
            self.failed(str(error) or type(error).__name__)
        self.close()
