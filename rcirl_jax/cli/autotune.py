"""The whole tuning loop by one command, from logs to a verdict and its report.

    rcirl autotune --data=DATASET[,DATASET] --output=RUN
    rcirl autotune --input=LOGS --output=RUN
    rcirl autotune --synthetic --recipe=quick --cases=4 --duration=20 --output=RUN

import (unless there is --data) -> demonstrate -> train -> rank -> simulate -> gate ->
report, as the --recipe says; a flag given beside it wins. Every stage is kept until
what it is made from changes; a killed run goes on where it was, also one ended by
SIGTERM (exit status 143) or SIGINT (130), which save the training's step. The candidate
is in RUN/weights.msgpack; open RUN/report.html. `--cases=3 --duration=30` is a look
that can prove little. `rcirl gate` gives the verdict as its exit status.
"""

import dataclasses
from pathlib import Path

from absl import flags

from rcirl_jax.cli import flags as shared
from rcirl_jax.cli.flags import AS_SAID
from rcirl_jax.cli.running import provenance
from rcirl_jax.data.formats import IMPORTERS
from rcirl_jax.data.formats.recognise import recognised_format
from rcirl_jax.data.importing import ImportConfig, Logs
from rcirl_jax.errors import InputError, did_you_mean
from rcirl_jax.evaluation.gate.types import DRIVES
from rcirl_jax.export.closed_loop import write_own_terms
from rcirl_jax.runtime.pipeline import only_one
from rcirl_jax.train.loop import Running
from rcirl_jax.train.parallel import PARALLEL, share_cores
from rcirl_jax.tuning.loop import STAGES, tune
from rcirl_jax.tuning.recipes import EXPERTS
from rcirl_jax.tuning.run import TODAY, Run, TuneConfig

USUAL = (
    *("output", "data", "input", "format", "source", "synthetic", "recipe"),
    *("terms", "incumbent", "sampler", "suite", "cases", "duration", "drives"),
    *("until", "workers"),
)
_OUTPUT = flags.DEFINE_string("output", None, shared.OUTPUT, required=True)
_DATA = flags.DEFINE_list("data", None, "datasets of `rcirl import`, with commas")
_SYNTHETIC = flags.DEFINE_bool(
    "synthetic", False, "instead: embedded synthetic traffic, to try things out"
)
_FORMAT = flags.DEFINE_list(
    "format", None, "of each --input, where it is not recognised"
)
_INPUT = flags.DEFINE_list(
    "input", None, "instead: logs to import first, files or folders"
)
_SOURCE = flags.DEFINE_list(
    "source", None, "TOML of columns and units of each --input, for your own tables"
)
_INCUMBENT = flags.DEFINE_string(
    "incumbent",
    "hand-set",
    "what drives today, to be compared with: a weights file, a baseline, your own "
    "cost, FILE.py:FUNCTION or FILE.so, or planner:COMMAND, a program that plans; with "
    "--terms, where it is not given, today's weights",
)
_SEEDS = flags.DEFINE_integer(
    "seeds", None, "training runs; the median one drives" + AS_SAID
)
_EXPERT = flags.DEFINE_enum(
    "expert", None, EXPERTS, "who drives simulated demonstrations" + AS_SAID
)
_DRIVES = flags.DEFINE_integer(
    "drives",
    DRIVES,
    "held-out drives that measure nearness to the human and safety among recorded "
    "traffic, 1 or more; by default all, up to that many",
)
_PARALLEL = flags.DEFINE_enum(
    "parallel", "auto", PARALLEL, "how devices share a batch: auto takes all of them"
)
_SWEEP = flags.DEFINE_string(
    "sweep", None, "folder of `rcirl sweep`, shown in the report"
)
_UNTIL = flags.DEFINE_enum("until", "report", STAGES, "last stage of this time")
_TRAINING = shared.training()
_IMPORT = shared.importing()
_SIGNALS = shared.signals()
_SUITE = shared.suite()
_MARGINS = shared.margins()
_SEARCH = shared.search()
_HORIZON = shared.horizon()
_TRACKERS = shared.trackers()
_EXECUTOR = shared.executor()


def main() -> None:
    """Flags -> one run of the loop."""
    given, one = sources(), made_run(Path(_OUTPUT.value))
    with only_one(one.folder):
        if one.config.incumbent == str(one.today):
            write_own_terms(one.today, one.config.train)
        tune(one, given, _UNTIL.value)


def made_run(folder: Path) -> Run:
    """The run in a folder that the flags describe."""
    recipe = _TRAINING.recipe()
    simulated = recipe.simulated
    if _EXPERT.value is not None:
        simulated = dataclasses.replace(simulated, expert=_EXPERT.value)
    train = _TRAINING.config()
    if _PARALLEL.value == "auto":
        share_cores(train.batch_size)
    incumbent = _INCUMBENT.value
    if train.reward.today and not _INCUMBENT.present:
        incumbent = str(folder / TODAY)
    config = TuneConfig(
        train=train,
        gate=_MARGINS(),
        incumbent=incumbent,
        simulated=simulated,
        gain=recipe.gain,
        data_weights=_TRAINING.data_weights,
        recipe=recipe.name,
        seeds=recipe.seeds if _SEEDS.value is None else _SEEDS.value,
        search=_SEARCH.value,
        drives=_DRIVES.value,
        horizon_s=_HORIZON.value,
        **_SUITE.settings(),
        sweep=Path(_SWEEP.value) if _SWEEP.value else None,
    )
    return Run(
        folder=folder,
        config=config,
        executor=_EXECUTOR(),
        running=Running(parallel=_PARALLEL.value, trackers=_TRACKERS()),
        facts=provenance(),
    )


def sources() -> list[str | Logs]:
    """The sources: datasets, logs, or synthetic traffic."""
    ways = [bool(_DATA.value), bool(_INPUT.value), _SYNTHETIC.value]
    if sum(ways) != 1:
        raise InputError(
            "--data, --input, --synthetic: expected one of them: datasets of "
            "`rcirl import`, logs, or the embedded synthetic traffic"
        )
    if not _INPUT.value and (_FORMAT.value or _SOURCE.value):
        raise InputError("--input: not given: expected one for each --format")
    if _DATA.value:
        if _SIGNALS.value:
            raise InputError("--signals: expected with --input, whose lights they are")
        return list(_DATA.value)
    if _SYNTHETIC.value:
        return [_logs("synthetic", None, None)]
    inputs = [Path(path) for path in _INPUT.value or []]
    count = len(inputs)
    named = _SOURCE.value or [""] * count
    if len(named) != count or len(_FORMAT.value or inputs) != count:
        raise InputError(
            f"--format, --source: {len(_FORMAT.value or [])} and "
            f"{len(_SOURCE.value or [])}: expected one for each of the {count} --input"
        )
    sources = [Path(source) if source else None for source in named]
    for name in _FORMAT.value or []:
        if name not in IMPORTERS:
            known = ", ".join(sorted(IMPORTERS))
            hint = did_you_mean(name, IMPORTERS)
            raise InputError(f"--format: {name}: expected one of {known}{hint}")
    formats = _FORMAT.value or map(recognised_format, inputs, sources)
    return list(map(_logs, formats, inputs, sources))


def _logs(name: str, path: Path | None, source: Path | None) -> Logs:
    """One log to import, cut as the recipe and the flags say."""
    return Logs(
        format=name,
        input=path,
        source=source,
        config=_IMPORT(ImportConfig(format=name, collect=_TRAINING.recipe().collect)),
        signals=_SIGNALS.value or "",
        checked=shared.pooled_signals if _SIGNALS.value else None,
    )
