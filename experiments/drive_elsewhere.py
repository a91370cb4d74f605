"""Drive a reward and its rivals in a simulator that somebody else wrote.

    python -m experiments.drive_elsewhere --weights=FILE --episodes=N \
        --output=DIR --simulator=highway_env|sumo|commonroad

The rows drive the same episodes, at 10 Hz behind the same safety filter; the last are
the simulator's own drivers. Writes table.txt, episodes.csv and elsewhere.json:
docs/simulators.md.
"""

from collections.abc import Sequence
from pathlib import Path

from absl import flags

from experiments.flags.common import provenance, run
from rcirl_jax.elsewhere.drive import drive_all, entrants
from rcirl_jax.elsewhere.simulators import SIMULATORS, Simulator, open_simulator
from rcirl_jax.elsewhere.table import Entry, Table, driven_before, entry_of
from rcirl_jax.errors import InputError
from rcirl_jax.export.closed_loop import table_rows

ROWS = ("hand-set", "IDM", "constant V", "+velocity", "random weights")
_SIMULATOR = flags.DEFINE_string(
    "simulator", None, f"one of {', '.join(SIMULATORS)}", required=True
)
_OPTIONS = flags.DEFINE_list("options", [], "NAME=VALUE of the simulator, several by ,")
_WEIGHTS = flags.DEFINE_list("weights", None, "weights files", required=True)
_OUTPUT = flags.DEFINE_string("output", None, "folder to write", required=True)
_EPISODES = flags.DEFINE_integer("episodes", 500, "how many, 2 at least")
_SECONDS = flags.DEFINE_float("seconds", 30.0, "s that an episode lasts")
_SEED = flags.DEFINE_integer("seed", 0, "of the episodes")
_BASELINES = flags.DEFINE_list("baselines", ",".join(ROWS), "rival rows, or empty")
_ONLY = flags.DEFINE_list("rows", [], "names of the rows to drive; empty: all")
_ALSO = flags.DEFINE_list(
    "also", [], "outputs over the same episodes, whose rows are not driven again"
)


def _driven(simulator: Simulator, names: Sequence[str]) -> list[Entry]:
    """The entries in the order of the table: driven here, or read from --also."""
    rows = table_rows(_WEIGHTS.value, _BASELINES.value)
    known: dict[str, Entry] = {}
    for folder in _ALSO.value:
        known |= driven_before(Path(folder) / "episodes.csv", names)
    every = entrants(simulator, rows)
    wanted = _ONLY.value or [entrant.name for entrant in every]
    if missing := set(wanted) - {entrant.name for entrant in every}:
        raise InputError(
            f"--rows: {', '.join(sorted(missing))}: expected some of "
            f"{'; '.join(entrant.name for entrant in every)}"
        )
    entries = []
    for entrant in every:
        if entrant.name in known:
            entries.append(known[entrant.name])
        elif entrant.name in wanted:
            drives = drive_all(simulator, entrant, names, _SECONDS.value, _say)
            entries.append(entry_of(entrant.name, drives))
    return entries


def _say(line: str) -> None:
    print(line, flush=True)


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
    names = simulator.episodes(_EPISODES.value, _SEED.value)
    entries = _driven(simulator, names)
    against = {"hand-set", simulator.own_drivers[0]}
    table = Table(
        simulator=simulator.name,
        episodes=names,
        entries=entries,
        against=[entry.name for entry in entries if entry.name in against],
    )
    print(table.write(Path(_OUTPUT.value), made_by))
    print(f"written: {_OUTPUT.value}/table.txt, episodes.csv, elsewhere.json")


if __name__ == "__main__":
    run(main)
