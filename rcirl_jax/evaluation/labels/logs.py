"""Signals and stop labels of whole logs, read wherever an executor has room.

The logs are read twice: what their drivers say of the signals has to be known of
all of them before the labels that follow from it can be compared.
"""

import dataclasses
import functools
from collections.abc import Iterator, Sequence

from rcirl_jax.data.parts import Item, Part, items, recordings_in
from rcirl_jax.data.scenes.signal_checks import SignalChecks, signal_checks
from rcirl_jax.evaluation.labels.signals import (
    LineEvents,
    PhaseCheck,
    check_events,
    line_events,
)
from rcirl_jax.evaluation.labels.stops import StopReport, joined, recording_stops
from rcirl_jax.runtime.executors import Executor, Here


@dataclasses.dataclass(frozen=True, kw_only=True)
class LogsReport:
    """Written phases, and labels with the signals that follow from them."""

    phases: list[PhaseCheck]
    stops: dict[str, StopReport]  # by which signals are used


def check_logs(
    parts: Sequence[Part], *, executor: Executor | None = None
) -> LogsReport:
    """Test the signals of logs, then the labels with some or all of them.

    Args:
      parts: of `importers.parts`.
      executor: where they are read; default: this process. Changes no number.

    Raises:
      InputError: logs that cannot be read.
    """
    places = executor or Here()
    phases = check_written(parts, executor=places)
    checks = signal_checks({check.name: check.verdict for check in phases})
    work = functools.partial(_stops, checks=checks)
    found = list(places.stream(work, items(parts, places.workers)))
    names = found[0] if found else {}
    return LogsReport(
        phases=phases,
        stops={name: joined(reports[name] for reports in found) for name in names},
    )


def check_written(
    parts: Sequence[Part], *, executor: Executor | None = None
) -> list[PhaseCheck]:
    """What all drivers of the logs say of the written signals, line by line.

    Args and errors: of `check_logs`.
    """
    places = executor or Here()
    return check_events(places.stream(_events, items(parts, places.workers)))


def _events(item: Item) -> Iterator[LineEvents]:
    for _, recording in recordings_in(item):
        yield line_events(recording)


def _stops(item: Item, checks: SignalChecks) -> Iterator[dict[str, StopReport]]:
    """Labels with the signals an import trusts of itself, those borne out, all."""
    for _, recording in recordings_in(item):
        yield {
            "trusted signals": recording_stops(recording),
            "signals by their phases": recording_stops(recording, checks=checks),
            "all signals": recording_stops(recording, trust_all=True),
        }
