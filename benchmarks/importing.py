"""Scenes per second of an import, parsing and cutting apart, on one core and on two.

    python -m benchmarks.importing --data=DIR [--processes=2]

For every folder of recordings under DIR that is there: seconds to parse all of it,
then scenes per second when its recordings are cut in this process, and in
`--processes` processes, and its quality report. Programs are compiled before the
clock starts, in every process. Goal: 500 scenes/s after parsing, on two cores.
"""

import functools
import itertools
import time
from pathlib import Path

from absl import flags

from benchmarks.common import write
from rcirl_jax.cli.running import run
from rcirl_jax.data.importing import scenes_in
from rcirl_jax.data.inputs import input_files, recordings_of
from rcirl_jax.data.quality import QualityReport
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.runtime.executors import Executor, Processes, Serial
from rcirl_jax.runtime.specs import spec_root

_DATA = flags.DEFINE_string("data", "../shared/data", "folder of the recordings")
_PROCESSES = flags.DEFINE_integer("processes", 2, "processes side by side")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")

# format, place, name of the source TOML
FOLDERS = {
    "US-101": ("commonroad", "ngsim_us101_commonroad/xml", "commonroad"),
    "urban": ("commonroad", "ngsim_urban_commonroad/xml", "commonroad"),
    "I-80": ("ngsim", "ngsim_i80_native", "ngsim"),
    "I-80 pairs": ("ngsim_pairs", "ngsim_i80_pairs", "ngsim_pairs"),
    "US-101 in metres": (
        *("ngsim", "formats/ngsim_reference/ngsim_us101_subset_SIunits.csv"),
        "ngsim_metres",
    ),
    "Argoverse 2": ("argoverse2", "formats/argoverse2_motion", "argoverse2"),
    "CommonRoad 2018b": ("commonroad", "formats/commonroad_2018b", "commonroad"),
    "Apollo record": ("apollo", "formats/apollo_record", "apollo"),
}


def rate(executor: Executor, items: list, config: CollectConfig) -> tuple[dict, dict]:
    """Scenes per second, and the quality report.

    A first pass compiles in every process and is not timed. It repeats the first
    recording that has scenes: one without compiles nothing.
    """
    piece = functools.partial(scenes_in, config=config)
    has_scenes = (item for item in items if any(x.vehicles for x in piece(item)))
    busy = list(itertools.islice(has_scenes, 1))
    for _ in executor.stream(piece, busy * 4 * executor.workers):
        pass
    begin = time.perf_counter()
    made = list(executor.stream(piece, items))
    seconds = time.perf_counter() - begin
    quality = QualityReport()
    for one in made:
        quality.merge(one.quality)
    scenes = quality.scenes
    found = {"scenes": scenes, "seconds": seconds, "scenes_per_s": scenes / seconds}
    return found, quality.as_dict()


def main() -> None:
    """Every folder that is there."""
    found = {}
    for name, (format_, place, source) in FOLDERS.items():
        path = Path(_DATA.value) / place
        if not path.exists():
            print(f"{name}: {path} is not there")
            continue
        toml = spec_root() / "sources" / f"{source}.toml"
        begin = time.perf_counter()
        items = [
            (part, made)
            for part in input_files(format_, path, toml)
            for made in recordings_of(part)
        ]
        parsing = time.perf_counter() - begin
        states = sum(t.t.size for _, made in items for t in made.tracks)
        row = {"states": states, "parsing_s": parsing, "states_per_s": states / parsing}
        row["one_process"], quality = rate(Serial(), items, CollectConfig())
        there = Processes(_PROCESSES.value)
        row["processes"], again = rate(there, items, CollectConfig())
        assert quality == again
        found[name] = {**row, "quality": quality}
        print(
            f"{name}: {states:,} states parsed at {row['states_per_s']:,.0f}/s; "
            f"{row['one_process']['scenes']:,} scenes cut at "
            f"{row['one_process']['scenes_per_s']:.0f}/s, in {_PROCESSES.value} "
            f"processes {row['processes']['scenes_per_s']:.0f}/s",
            flush=True,
        )
    write("importing", {"processes": _PROCESSES.value, "folders": found}, _OUTPUT.value)


if __name__ == "__main__":
    run(main)
