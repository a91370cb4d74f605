"""Drive a reward and its baselines in a simulator that somebody else wrote.

    rcirl drive-elsewhere --simulator=sumo --weights=FILE --episodes=N --output=DIR

The rows drive the same episodes, at 10 Hz behind the same safety filter; the last are
the simulator's own drivers. Writes table.txt, episodes.csv and elsewhere.json:
docs/simulators.md. A run that was ended goes on with --also=DIR.
"""

from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import Any

import msgspec
from absl import flags

from rcirl_jax.cli.running import provenance
from rcirl_jax.errors import InputError
from rcirl_jax.export.closed_loop import table_rows
from rcirl_jax.runtime.atomic_files import read_json, write_json
from rcirl_jax.runtime.checked import checked
from rcirl_jax.sampling.sampler import MODES
from rcirl_jax.simulation.rows import Row
from rcirl_jax.simulators.drive import drive
from rcirl_jax.simulators.simulators import SIMULATORS, Simulator, open_simulator
from rcirl_jax.simulators.table import (
    Results,
    numbers_of,
    read_results,
    table_of,
    write_results,
    write_table,
)

ROWS = ("hand-set", "IDM", "constant V", "+velocity", "random weights")
USUAL = (
    *("simulator", "weights", "episodes", "output", "seconds", "baselines"),
    *("mode", "also"),
)
_SIMULATOR = flags.DEFINE_string(
    "simulator", None, f"one of {', '.join(SIMULATORS)}", required=True
)
_OPTIONS = flags.DEFINE_list("options", [], "NAME=VALUE of the simulator, several by ,")
_WEIGHTS = flags.DEFINE_list(
    "weights", None, "weights files, with commas", required=True
)
_OUTPUT = flags.DEFINE_string("output", None, "folder to write", required=True)
_EPISODES = flags.DEFINE_integer(
    "episodes", 500, "how many, 2 or more: the more, the narrower the intervals"
)
_SECONDS = flags.DEFINE_float("seconds", 30.0, "s that an episode lasts, 1 to 600")
_SEED = flags.DEFINE_integer("seed", 0, "of the episodes")
_BASELINES = flags.DEFINE_list(
    "baselines", ",".join(ROWS), "baselines that drive too, or empty"
)
_MODE = flags.DEFINE_enum(
    "mode",
    None,
    MODES,
    "what baselines that rank candidates plan: speed along their lane, or paths and "
    "lane changes too; default: what the first weights were trained for",
)
_ALSO = flags.DEFINE_list(
    "also",
    [],
    "earlier outputs over the same episodes: their rows are not driven again",
)


class _MadeBy(msgspec.Struct):
    """The fields of an output's made_by.json that are read."""

    flags: dict[str, Any]
    weights_sha256: dict[str, str]


def _driven_before(made_by: Mapping, fixed: Set[str]) -> Results:
    """Returns the rows of --also; those of weights only if these are the same.

    Raises:
      InputError: it drove elsewhere or for another time.
    """
    results: Results = {}
    for folder in map(Path, _ALSO.value):
        file = folder / "made_by.json"
        found = read_json(file, "an output of drive-elsewhere")
        then = checked(found, _MadeBy, file)
        for flag in ("simulator", "seconds", "mode"):
            was, now = then.flags.get(flag), made_by["flags"][flag]
            if was != now:
                raise InputError(f"--also: {folder}: --{flag}: {was}: expected {now}")
        now = list(made_by["weights_sha256"].values())
        differ = list(then.weights_sha256.values()) != now
        for name, drives in read_results(folder / "episodes.csv").items():
            if name in fixed or not differ:
                results.setdefault(name, {}).update(drives)
    return results


def _drive(simulator: Simulator, who: Sequence[Row | str], results: Results) -> Results:
    """Drive all episodes by everybody, group by group; what is known is kept."""
    names = simulator.episodes(_EPISODES.value, _SEED.value)
    for first in range(0, len(names), simulator.together):
        group = names[first : first + simulator.together]
        for driver in who:
            name = driver if isinstance(driver, str) else driver.name
            known = results.setdefault(name, {})
            if not all(episode in known for episode in group):
                known |= numbers_of(drive(simulator, driver, group, _SECONDS.value))
        write_results(Path(_OUTPUT.value) / "episodes.csv", results)
        print(f"driven: {first + len(group)} of {len(names)}", flush=True)
    return {
        name: {n: drives[n] for n in names if n in drives}
        for name, drives in results.items()
    }


def main() -> None:
    """Flags -> one table."""
    if _EPISODES.value < 2:
        raise InputError(f"--episodes: {_EPISODES.value}: expected at least 2")
    if not 1.0 <= _SECONDS.value <= 600.0:
        raise InputError(f"--seconds: {_SECONDS.value:g}: expected 1 to 600 s")
    parts = [option.partition("=") for option in _OPTIONS.value]
    options = {name: value for name, _, value in parts}
    simulator = open_simulator(_SIMULATOR.value, **options)
    made_by = provenance(_WEIGHTS.value)
    rows = table_rows(_WEIGHTS.value, _BASELINES.value, mode=_MODE.value)
    who = [*rows, *simulator.own_drivers]
    fixed = {*_BASELINES.value, *simulator.own_drivers} - {"random weights"}
    before = _driven_before(made_by, fixed)
    write_json(Path(_OUTPUT.value) / "made_by.json", made_by)
    results = _drive(simulator, who, before)
    against = ["hand-set", simulator.own_drivers[0]]
    table = table_of(simulator.name, results, against)
    print(write_table(Path(_OUTPUT.value), table, made_by))
    print(f"written: {_OUTPUT.value}/table.txt, episodes.csv, elsewhere.json")
