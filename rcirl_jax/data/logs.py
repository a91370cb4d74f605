"""Recordings that are still to be imported, and how."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

from rcirl_jax.data.importing import ImportConfig
from rcirl_jax.data.parts import Part
from rcirl_jax.data.scenes.signal_checks import SignalChecks
from rcirl_jax.runtime.executors import Executor


@dataclasses.dataclass(frozen=True, kw_only=True)
class Logs:
    """Recordings to import: as `rcirl import` takes them."""

    format: str
    input: Path | None
    source: Path | None
    config: ImportConfig
    # which written lights are used: what was asked for, and who finds it out
    signals: str = ""
    checked: Callable[[Sequence[Part], Executor], SignalChecks | None] | None = None

    def import_config(self, parts: Sequence[Part], places: Executor) -> ImportConfig:
        """The configuration with the verdicts on the lights, which reads all logs."""
        if self.checked is None:
            return self.config
        checks = self.checked(parts, places)
        collect = dataclasses.replace(self.config.collect, signal_checks=checks)
        return dataclasses.replace(self.config, collect=collect)
