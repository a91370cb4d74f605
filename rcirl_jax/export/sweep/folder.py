"""What lies in a sweep's folder, and what is taken from it to resume.

DIR/settings.json         what the folder belongs to
DIR/weights/NAME.msgpack  every member
DIR/groups/SHAPE.json     the group is finished; written after its members
DIR/sweep.json            all members with their metrics, and the choice
DIR/best.msgpack          the chosen member, a copy of its file
"""

import dataclasses
import datetime
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from rcirl_jax.errors import UNFORESEEN, InputError
from rcirl_jax.evaluation.ranking.sweep import (
    Hidden,
    Part,
    SweepConfig,
    member_name,
    shape_name,
)
from rcirl_jax.export.loading import open_reward
from rcirl_jax.runtime.atomic_files import read_json, write_json
from rcirl_jax.train.state import TrainConfig

SWEEP = "sweep.json"  # in the sweep's folder
GROUP_FACTS = (
    "members",
    "seconds",
    "compiles",
    "compile_seconds",
)  # of a group, numbers


def grid_of(config: SweepConfig) -> dict:
    """What decides the result, as JSON; where the data lie does not."""
    made = json.loads(json.dumps(dataclasses.asdict(config)))
    return {name: value for name, value in made.items() if name != "data"}


def settings_of(config: SweepConfig) -> dict:
    """The same in one level, as the folder's files name it."""
    made = grid_of(config)
    return {n: v for n, v in made.items() if n != "base"} | made["base"]


def claim(config: SweepConfig, folder: Path, dataset_hash: str) -> str:
    """Write settings.json, or check the one that is there; when it was written.

    Raises:
      InputError: the folder is of a sweep with other settings (names the first).
    """
    path = folder / "settings.json"
    own = {**settings_of(config), "dataset_sha256": dataset_hash}
    if path.exists():
        found = read_json(path, "the file of a sweep")
        try:
            created = str(found["created"])
        except (KeyError, TypeError) as error:
            raise InputError(
                f"{path}: {type(error).__name__}: {error}: expected the file of a sweep"
            ) from error
        for name, setting in own.items():
            if found.get(name) != setting:
                raise InputError(
                    f"{path}: {name}: {found.get(name)}: expected {setting} to "
                    "resume; use another --output for other settings"
                )
        return created
    created = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    write_json(path, {**own, "created": created})
    return created


def weights_file(folder: Path, member: TrainConfig) -> Path:
    """A member's weights."""
    return folder / "weights" / f"{member_name(member)}.msgpack"


def finish_group(folder: Path, parts: Sequence[Part], settings: dict) -> dict:
    """Write and return the file of a finished group."""
    members = {
        member_name(member): {
            "sha256": open_reward(str(weights_file(folder, member))).sha256,
            "loss": float(part.loss[number]),
            "pairs_won": float(part.wins[number]),
            "finite": bool(part.finite[number]),
        }
        for part in parts
        for number, member in enumerate(part.members)
    }
    compiled = [seconds for part in parts for seconds in part.compile_s]
    facts = {
        "members": len(members),
        "seconds": round(sum(part.seconds for part in parts), 3),
        "compiles": len(compiled),
        "compile_seconds": round(sum(compiled), 3),
    }
    group = {"facts": facts, "members": members, "settings": settings}
    write_json(folder / "groups" / f"{shape_name(parts[0].hidden)}.json", group)
    return group


def finished_group(
    config: SweepConfig, folder: Path, hidden: Hidden, made_by: Mapping[str, object]
) -> dict | None:
    """A group's file, if it and all its members' files are whole."""
    path = folder / "groups" / f"{shape_name(hidden)}.json"
    try:
        group = read_json(path, "the group of a sweep")
        facts, kept = group["facts"], group["members"]
        numbers = all(type(facts[name]) in {int, float} for name in GROUP_FACTS)
        if not numbers or any(type(one["finite"]) is not bool for one in kept.values()):
            return None
        if group["settings"] != {**settings_of(config), **data_of(made_by)}:
            return None
        for member in config.group(hidden):
            reward = open_reward(str(weights_file(folder, member)))
            if reward.sha256 != group["members"][member_name(member)]["sha256"]:
                return None
    except (OSError, *UNFORESEEN, InputError):
        return None
    return group


def data_of(made_by: Mapping[str, object]) -> dict:
    """The data and the code a group was made from."""
    return {name: made_by.get(name) for name in ("dataset_sha256", "git_commit")}
