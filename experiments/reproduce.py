"""Train a weights file again from its own provenance: is it the same reward?

    python -m experiments.reproduce --weights=FILE --output=DIR [--data=DATASET]

Exit status 0: reproduced. On the same machine with the same versions and commit every
bit has to be the same; else, with a warning that names what differs, no tensor may
differ by more than --tolerance of its largest entry. 1: not reproduced; the tensor
that differs most is named. 2: could not: other data, an older file, or one that no
training made. There is no --recipe: the file holds every setting of its training, and
what a recipe says may have changed since. Takes as long as the training did, of a
sweep's member as long as its group; writes DIR/run (not of a member),
DIR/weights.msgpack and DIR/reproduction.json.
"""

import functools
import sys
from pathlib import Path

from absl import flags

from experiments.common import provenance, run
from rcirl_jax.data.store.joined import open_datasets
from rcirl_jax.errors import InputError
from rcirl_jax.export.loading import open_reward
from rcirl_jax.export.provenance import check_local, dataset_names
from rcirl_jax.export.reproduce import (
    Reproduction,
    compare,
    is_member,
    member_again,
    settings_of,
    setup_warnings,
    sweep_of,
    train_again,
)
from rcirl_jax.runtime.atomic_files import write_json

_WEIGHTS = flags.DEFINE_string("weights", None, "weights file", required=True)
_DATA = flags.DEFINE_list(
    "data", None, "its datasets (default: where its flags say they were)"
)
_OUTPUT = flags.DEFINE_string("output", None, "new folder to write", required=True)
_TOLERANCE = flags.DEFINE_float(
    "tolerance", 0.01, "largest difference on another machine or version", 0.0
)


def main() -> None:
    """Flags -> one verdict."""
    reward, folder = open_reward(_WEIGHTS.value), Path(_OUTPUT.value)
    named = _DATA.value or (reward.provenance.get("flags") or {}).get("data")
    if not named:
        raise InputError("--data: not given and not in the file: expected datasets")
    where = f"{reward.file}: provenance.flags.data"
    names = dataset_names(named, where)
    if not _DATA.value:
        check_local(names, where)
    dataset = open_datasets(names)
    # what fails, fails before a warning
    if is_member(reward):
        sweep = sweep_of(reward, dataset, names)
        make = functools.partial(member_again, reward, sweep, folder)
    else:
        settings_of(reward, dataset)
        make = functools.partial(train_again, reward, dataset, folder)
    facts = provenance()
    warnings = setup_warnings(reward.provenance, facts)
    for line in warnings:
        print(f"warning: {line}")
    again = make(provenance=facts)
    found = Reproduction(
        differences=compare(reward, again),
        warnings=warnings,
        tolerance=_TOLERANCE.value,
    )
    body = {
        "reproduced": found.reproduced,
        "differences": found.differences,
        "allowed": found.allowed,
        "warnings": list(warnings),
        "weights_sha256": {reward.file: reward.sha256, again.file: again.sha256},
        "made_by": {**facts, "data_hash": dataset.hash},
    }
    write_json(folder / "reproduction.json", body)
    print(found.text())
    print(f"written: {folder}/weights.msgpack, reproduction.json")
    sys.exit(0 if found.reproduced else 1)


if __name__ == "__main__":
    run(main)
