"""Drive a reward and its rivals in a simulator that somebody else wrote.

    python -m experiments.drive_elsewhere --simulator=highway_env|sumo --weights=FILE \
        --episodes=N --output=DIR

The rows drive the same episodes, at 10 Hz behind the same safety filter; the last are
the simulator's own drivers. Writes table.txt, episodes.csv and elsewhere.json:
docs/simulators.md. A run that was ended goes on with --also=DIR.
"""

from collections.abc import Sequence
from pathlib import Path

from absl import flags

from experiments.flags.common import provenance, run
from rcirl_jax.elsewhere.drive import Entrant, drive, entrants, groups
from rcirl_jax.elsewhere.simulators import SIMULATORS, Simulator, open_simulator
from rcirl_jax.elsewhere.table import (
    Results,
    numbers_of,
    read_results,
    table_of,
    write_results,
)
from rcirl_jax.errors import InputError
from rcirl_jax.export.closed_loop import table_rows

ROWS = ("hand-set", "IDM", "constant V", "+velocity", "random weights")
_SIMULATOR = flags.DEFINE_string(
    "simulator", None, f"one of {', '.join(SIMULATORS)}", required=True
)
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


def _entrants(simulator: Simulator) -> list[Entrant]:
    """Who drives: --rows of those that there are."""
    every = entrants(simulator, table_rows(_WEIGHTS.value, _BASELINES.value))
    names = [entrant.name for entrant in every]
    if missing := set(_ONLY.value) - set(names):
        raise InputError(
            f"--rows: {', '.join(sorted(missing))}: expected some of {', '.join(names)}"
        )
    return [x for x in every if not _ONLY.value or x.name in _ONLY.value]


def _drive(simulator: Simulator, who: Sequence[Entrant]) -> Results:
    """All episodes by everybody, group by group; what is known is not driven again."""
    results: Results = {}
    for folder in _ALSO.value:
        for name, drives in read_results(Path(folder) / "episodes.csv").items():
            results.setdefault(name, {}).update(drives)
    names = simulator.episodes(_EPISODES.value, _SEED.value)
    for group in groups(simulator, names):
        for entrant in who:
            known = results.setdefault(entrant.name, {})
            if not all(name in known for name in group):
                known |= numbers_of(drive(simulator, entrant, group, _SECONDS.value))
        write_results(Path(_OUTPUT.value) / "episodes.csv", results)
        print(f"driven: {group[-1]}, {names.index(group[-1]) + 1} episodes", flush=True)
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
    simulator = open_simulator(_SIMULATOR.value)
    made_by = provenance(_WEIGHTS.value)
    results = _drive(simulator, _entrants(simulator))
    against = ["hand-set", simulator.own_drivers[0]]
    table = table_of(simulator.name, results, against)
    print(table.write(Path(_OUTPUT.value), made_by))
    print(f"written: {_OUTPUT.value}/table.txt, episodes.csv, elsewhere.json")


if __name__ == "__main__":
    run(main)
