"""What lies in a sweep's folder.

DIR/stages.json           the groups that are finished, and what they were made from
DIR/weights/NAME.msgpack  every member
DIR/groups/SHAPE.json     how the members of a group trained (a search: of a round)
DIR/sweep.json            all members with their metrics, and the choice
DIR/best.msgpack          the chosen member, a copy of its file
"""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.sweep import SweepConfig, member_name
from rcirl_jax.runtime.pipeline import FILE, Stages
from rcirl_jax.train.state import TrainConfig

SWEEP = "sweep.json"  # in the sweep's folder
ELSEWHERE = ("data", "trials", "points")  # fields that are no settings of a folder


def grid_of(config: SweepConfig) -> dict:
    """What decides the result, as JSON; where the data lie and how many trials do not.

    More trials go on where fewer ended.
    """
    made = json.loads(json.dumps(dataclasses.asdict(config)))
    kept = {n: value for n, value in made.items() if n not in ELSEWHERE}
    return {**kept, "search": "optuna" if config.trials else "grid"}


def settings_of(config: SweepConfig) -> dict:
    """The same in one level, as the folder's files name it."""
    made = grid_of(config)
    return {n: v for n, v in made.items() if n != "base"} | made["base"]


def check_settings(stages: Stages, settings: Mapping[str, object]) -> None:
    """Check that the groups of a folder are of these settings.

    Raises:
      InputError: one is of others (names the first).
    """
    for record in stages.read().values():
        for name, setting in settings.items():
            if (found := record.get("inputs", {}).get(name)) != setting:
                raise InputError(
                    f"{stages.folder / FILE}: {name}: {found}: expected {setting} to "
                    "resume; use another output folder for other settings"
                )


def weights_file(folder: Path, member: TrainConfig) -> Path:
    """A member's weights."""
    return folder / "weights" / f"{member_name(member)}.msgpack"
