"""Flags that several commands share, by subject, and the settings they become.

A function defines the flags of one subject, for the command that calls it while its
module is imported, and returns what reads them once they are parsed. A flag of a single
command stands in its own module. No flag has a default where a recipe has one.
"""

import dataclasses
import functools
import os
from collections.abc import Callable, Collection, Sequence
from typing import Any

from absl import flags

from rcirl_jax.cli.running import AS_SAID, HEADINGS
from rcirl_jax.data.importing import ImportConfig
from rcirl_jax.data.inputs import InputFile
from rcirl_jax.data.scenes.config import SignalChecks, signal_checks
from rcirl_jax.data.scenes.signal_phases import check_written, format_phases
from rcirl_jax.data.store.dataset import EQUAL, Demonstrations
from rcirl_jax.data.store.splits import HOLDOUTS, folds_by_recording, held_out
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.baselines import SEARCHES
from rcirl_jax.evaluation.gate.types import MAX_ACCEPTED, GateConfig
from rcirl_jax.planner.baselines import TUNED_IDM_ROW
from rcirl_jax.reward import LOSSES
from rcirl_jax.reward.network import CONSTRAINTS, SCALE_CONSTRAINTS
from rcirl_jax.runtime.executors import EXECUTORS, Executor, make_executor
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.sampling.sampler import MODES
from rcirl_jax.train.state import (
    ADMISSIBLE_IN,
    LEARNED_FUTURES,
    POSITIVES,
    TrainConfig,
)
from rcirl_jax.train.trackers import TRACKERS
from rcirl_jax.tuning.recipes import (
    DEFAULT,
    TERMS,
    Recipe,
    load_recipe,
    override,
)

OUTPUT = "folder of the run; a run that is in it goes on"
PLANNER = "your own cost (FILE.py:FUNCTION or FILE.so) or the command of a planner"


def _subject(heading: str) -> Callable:
    """Notes the heading of the flags that a function defines."""

    def noted(define: Callable) -> Callable:
        @functools.wraps(define)
        def defined(*args: object, **options: object) -> object:
            before = {*flags.FLAGS}
            made = define(*args, **options)
            HEADINGS.update(dict.fromkeys({*flags.FLAGS} - before, heading))
            return made

        return defined

    return noted


def mutually_exclusive(flag: str, *others: str) -> None:
    """Refuses flags that were given beside one that leaves them unread."""
    for other in others:
        found = flags.FLAGS[other]
        if found.present:
            raise InputError(f"--{other}: {found.value}: expected none beside --{flag}")


def undefine_flags(*names: str) -> None:
    """Removes flags that a command does not read: unknown to it, unrecorded."""
    for name in names:
        delattr(flags.FLAGS, name)


def floats(values: Sequence[str], flag: str) -> tuple[float, ...]:
    """A comma list of numbers, with the flag's name on error."""
    try:
        return tuple(float(value) for value in values)
    except ValueError as error:
        raise InputError(f"--{flag}: {values}: expected numbers") from error


def hidden_sizes(values: Sequence[str], flag: str = "hidden_size") -> tuple[int, ...]:
    """Units per layer: "15", "32,16", or "0" for the linear reward."""
    try:
        sizes = tuple(int(value) for value in values)
    except ValueError as error:
        raise InputError(f"--{flag}: {values}: expected integers") from error
    if sizes == (0,) or not sizes:
        return ()
    if any(not 1 <= size <= 4096 for size in sizes):
        raise InputError(f"--{flag}: {values}: expected 1 to 4096, or 0 alone")
    return sizes


@_subject("Where independent pieces of work run")
def executor() -> Callable[[], Executor]:
    """Defines --executor, --workers, --ray_address; returns what makes the executor."""
    name = flags.DEFINE_enum(
        "executor", "local", EXECUTORS, "where independent pieces of work run"
    )
    workers = flags.DEFINE_integer(
        "workers", 1, "processes at once, 1 or more: as many as cores and memory allow"
    )
    ray = flags.DEFINE_string("ray_address", "auto", "cluster of --executor=ray")
    return lambda: make_executor(
        name.value, workers=workers.value, ray_address=ray.value
    )


@_subject("Distances to the human: when they are taken")
def horizon() -> flags.FlagHolder[float]:
    """Defines --horizon."""
    return flags.DEFINE_float(
        "horizon",
        5.0,
        "s at which distances to the human are taken, 0.4 to 8",
        lower_bound=0.4,
        upper_bound=8.0,
    )


@_subject("How baselines are tuned")
def search() -> flags.FlagHolder[str]:
    """Defines --search."""
    return flags.DEFINE_enum(
        "search",
        "cma",
        list(SEARCHES),
        "search that tunes baselines; optuna needs the extra [optuna]",
    )


@_subject("Trackers of training")
def trackers() -> Callable[[], tuple[str, ...] | None]:
    """Defines --trackers; returns what gives the names, None without any."""
    given = flags.DEFINE_list(
        "trackers",
        None,
        f"some of {', '.join(TRACKERS)}, or empty; default: tensorboard, if installed",
    )
    return lambda: None if given.value is None else tuple(given.value)


@_subject("The recipe: everything that decides a training run")
def recipe() -> Callable[[], Recipe]:
    """Defines --recipe; returns what loads it."""
    name = flags.DEFINE_string(
        "recipe",
        DEFAULT,
        "tuned, paper, quick, residual, terms or a TOML of your own: settings that no "
        "flag gives",
    )
    return lambda: load_recipe(name.value)


# flags of the same name as fields of TrainConfig and RewardConfig: what they take, help
_TRAINING: dict[str, tuple[type | Sequence[str], str]] = {
    "features": (str, "preset in data_specs/features"),
    "loss": (sorted(LOSSES), "what training minimises"),
    "soft_distance": (float, "m, temperature of soft labels"),
    "leaky_rate": (float, "a of the rank loss"),
    "optimizer": (str, "gradient method, by its name in optax"),
    "learning_rate": (
        float,
        "step size, above 0, below 1; smaller if the loss jumps",
    ),
    "halve_every": (int, "steps per halving; 0: never"),
    "weight_decay": (float, "L2 pull on the weights"),
    "clip_norm": (float, "norm the gradient is cut down to; 0: none"),
    "batch_size": (int, "scenes per step, all devices"),
    "epochs": (
        int,
        "passes over the training scenes, 1 or more; more if the loss still falls",
    ),
    "positive": (
        POSITIVES,
        "ranked first: the human's trajectory, or the candidate nearest to it",
    ),
    "futures": (LEARNED_FUTURES, "of the others, as a learner sees them"),
    "admissible_in": (ADMISSIBLE_IN, "scenes whose nearest candidate is admissible"),
    "train_horizon": (float, "s that are compared"),
    "hard_negatives": (int, "near negatives per scene"),
    "hard_pool": (
        int,
        "near negatives drawn for each that the present reward keeps",
    ),
    "activation": (("tanh", "relu", "leaky_relu"), "of the hidden layers"),
    "constraint": (
        CONSTRAINTS,
        "nonnegative costs (linear), monotone in safety, weights of own --terms",
    ),
    "scale_constraint": (SCALE_CONSTRAINTS, "what fixes the scale of the reward"),
    "module": (str, "PACKAGE.MODULE:CLASS, a linen module as R_theta"),
}
_DEFINE = {
    str: flags.DEFINE_string,
    int: flags.DEFINE_integer,
    float: flags.DEFINE_float,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Training:
    """The recipe, and the flags that depart from it."""

    recipe: Callable[[], Recipe]
    given: dict[str, flags.FlagHolder]

    @property
    def data_weights(self) -> str:
        """Share of each of several --data."""
        return self.given["data_weights"].value

    @property
    def terms(self) -> str:
        """Place of the user's own terms, whole; "" for none."""
        given = self.given["terms"].value
        return os.path.abspath(given) if given else ""

    def config(
        self, *, seed: int = 0, hidden: tuple[int, ...] | None = None
    ) -> TrainConfig:
        """The recipe's training, and what flags say besides.

        Args:
          seed: of initial weights, batches, candidates.
          hidden: units per layer, whatever recipe and flags say.

        Raises:
          InputError: a recipe or value that cannot be.
        """
        base = self.recipe().train
        values = {name: flag.value for name, flag in self.given.items()}
        said = {name: values[name] for name in _TRAINING if name in values}
        if self.terms:
            if said.get("features"):
                mutually_exclusive("terms", "features")
            said["features"] = self.terms
        if (margins := values.get("margins")) is not None:
            if len(margins) != 3:
                raise InputError(f"--margins: {margins}: expected three numbers")
            names = ("margin_distance", "margin_collision", "margin_rule")
            said |= dict(zip(names, floats(margins, "margins"), strict=True))
        if (mode := values.get("mode")) is not None:
            said["sampler"] = dataclasses.replace(base.sampler, mode=mode)
        if place := values.get("sampler"):
            sampler = said.get("sampler", base.sampler)
            own = SamplerConfig(own=os.path.abspath(place))
            said["sampler"] = own.on_own(sampler)
        if (units := values.get("hidden_size")) is not None:
            said["hidden"] = hidden_sizes(units)
        if hidden is not None:
            said["hidden"] = hidden
        said = {name: value for name, value in said.items() if value is not None}
        return override(base, said, seed=seed, scene_gating=values.get("scene_gating"))


def training(*, without: Collection[str] = ()) -> Training:
    """Defines --recipe and all that may depart from it in training.

    Args:
      without: names of flags that the command does not have.
    """
    named, given = recipe(), _departures(without)

    def chosen() -> Recipe:
        of_terms = given["terms"].value and not flags.FLAGS["recipe"].present
        return load_recipe(TERMS) if of_terms else named()

    return Training(recipe=chosen, given=given)


@_subject("Training: what may depart from the recipe")
def _departures(without: Collection[str]) -> dict[str, flags.FlagHolder]:
    made: dict[str, flags.FlagHolder] = {}
    for name, (kind, text) in _TRAINING.items():
        if name in without:
            continue
        if isinstance(kind, type):
            made[name] = _DEFINE[kind](name, None, text + AS_SAID)
        else:
            made[name] = flags.DEFINE_enum(name, None, list(kind), text + AS_SAID)
    made["terms"] = flags.DEFINE_string(
        "terms",
        None,
        "FILE.py:NAME, your planner's own cost terms in the place of --features, with "
        "--recipe=terms unless it is given",
    )
    made["mode"] = flags.DEFINE_enum(
        "mode", None, list(MODES), "what the sampler varies" + AS_SAID
    )
    made["sampler"] = flags.DEFINE_string(
        "sampler",
        None,
        "FILE.py:FUNCTION, your planner's own candidates in the place of ours, offline "
        "and online",
    )
    made["margins"] = flags.DEFINE_list(
        "margins", None, "hinge: per metre from the human, collision, rule" + AS_SAID
    )
    if "hidden_size" not in without:
        made["hidden_size"] = flags.DEFINE_list(
            "hidden_size",
            None,
            "units per layer, 1 to 4096 each; 0: linear, easily read" + AS_SAID,
        )
    if "scene_gating" not in without:
        made["scene_gating"] = flags.DEFINE_bool(
            "scene_gating",
            None,
            "scale features by what the scene is like at t = 0" + AS_SAID,
        )
    if "data_weights" not in without:
        made["data_weights"] = flags.DEFINE_string(
            "data_weights",
            EQUAL,
            "share of each of several --data: equal, scenes (as many as it has), or "
            "numbers",
        )
    return made


# numbers of CollectConfig by their flag: field, help
_COLLECT = {
    "stride": (
        "stride_s",
        "s between scenes of a driver, above 0; longer: fewer and less alike",
    ),
    "min_future": ("min_future_s", "s of recording a scene needs"),
    "min_history": ("min_history_s", "s of recording before a planning frame"),
    "min_surroundings": (
        "min_surroundings_s",
        "s until someone whom the human reacts to leaves the record, at least",
    ),
    "min_life": ("min_life_s", "s, shorter tracks do not become obstacles"),
    "min_size": ("min_size_m", "m, nor do bodies whose longer side is below it"),
    "join_gap": (
        "join_gap_s",
        "s between fragments of one standing body that are joined, at most",
    ),
    "smoothing": ("smoothing_s", "s, window of the position filter"),
}
# filters of CollectConfig by the flag that turns them off: field, what they want
_FILTERS = {
    "keep_steady": ("require_speed_change", "speed change"),
    "keep_free_road": ("require_obstacles", "obstacles"),
}


@_subject("Importing: which scenes are kept of the logs, and how they are held out")
def importing() -> Callable[[ImportConfig], ImportConfig]:
    """Defines the flags of an import; returns what applies those given to a config."""
    numbers = {
        field: flags.DEFINE_float(name, None, text + AS_SAID)
        for name, (field, text) in _COLLECT.items()
    }
    filters = {
        field: flags.DEFINE_bool(
            name, None, f"keep scenes without {what} (the paper drops them){AS_SAID}"
        )
        for name, (field, what) in _FILTERS.items()
    }
    fraction = flags.DEFINE_float(
        "test_fraction",
        0.25,
        "share of scenes held out to judge by, of other vehicles, 0 to below 1; 0: to "
        "train only",
    )
    seed = flags.DEFINE_integer("split_seed", 0, "order in which groups are dealt")
    leave_out = flags.DEFINE_string(
        "leave_out",
        "0",
        "recordings that may be refused, for large releases: a count such as 3, or 5%",
    )

    def applied(config: ImportConfig) -> ImportConfig:
        given = {n: f.value for n, f in numbers.items() if f.value is not None}
        given |= {n: not f.value for n, f in filters.items() if f.value is not None}
        count, share = left_out(leave_out.value)
        return dataclasses.replace(
            config,
            collect=dataclasses.replace(config.collect, **given),
            test_fraction=fraction.value,
            split_seed=seed.value,
            leave_out=count,
            leave_out_share=share,
        )

    return applied


def left_out(text: str) -> tuple[int, float]:
    """A count, or a share of all recordings, of --leave_out.

    Raises:
      InputError: neither "3" nor "5%".
    """
    number = text.strip().removesuffix("%")
    try:
        if number == text.strip():
            count = int(number)
            if count >= 0:
                return count, 0.0
        elif 0.0 <= (share := float(number) / 100.0) < 1.0:
            return 0, share
    except ValueError:
        pass
    raise InputError(f"--leave_out: {text}: expected a count such as 3, or 5%")


@_subject("Traffic lights: which written ones an import uses")
def signals() -> flags.FlagHolder[str | None]:
    """Defines --signals."""
    return flags.DEFINE_enum(
        "signals",
        None,
        ["pooled"],
        "ask the drivers of all files about the written lights",
    )


def pooled_signals(parts: Sequence[InputFile], places: Executor) -> SignalChecks:
    """Asks the drivers of all files about the lights; printed (--signals=pooled)."""
    phases = check_written(parts, executor=places)
    print(format_phases(phases))
    return signal_checks({check.name: check.verdict for check in phases})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Suite:
    """Closed-loop cases as flags name them."""

    suite: flags.FlagHolder[str]
    cases: flags.FlagHolder[int | None]
    duration_s: flags.FlagHolder[float | None]
    catalogue_seed: flags.FlagHolder[int]
    plan_every: flags.FlagHolder[int]

    def settings(self) -> dict[str, Any]:
        """The values, by the names of `gate_job` and `TuneConfig`."""
        return {name: flag.value for name, flag in vars(self).items()}


@_subject("Closed loop: which cases are driven, and how often is planned")
def suite(default: str = "full") -> Suite:
    """Defines --suite, --cases, --duration, --catalogue_seed, --plan_every."""
    return Suite(
        suite=flags.DEFINE_string(
            "suite",
            default,
            "full, smoke (one case of each family), or families with commas",
        ),
        cases=flags.DEFINE_integer(
            "cases",
            None,
            "cases per family, 1 or more; fewer are quicker and prove less (default: "
            "as the suite says)",
        ),
        duration_s=flags.DEFINE_float(
            "duration", None, "s per case at most, 1 to 120 (default: 120, smoke 20)"
        ),
        catalogue_seed=flags.DEFINE_integer("catalogue_seed", 0, "seed of the cases"),
        plan_every=flags.DEFINE_integer(
            "plan_every", 1, "steps of 0.1 s between two plans"
        ),
    )


def idm_left_out(path: str | None) -> str:
    """Returns the line for a missing --tuned_idm; "" where it is given."""
    return "" if path else f"left out: {TUNED_IDM_ROW}: --tuned_idm is not given"


@_subject("The gate: what it takes for a loss and for a gain")
def margins() -> Callable[[], GateConfig]:
    """Defines the gate's margins, --primary and --accept; returns what reads them."""
    usual = GateConfig()
    primary = flags.DEFINE_list(
        "primary",
        list(usual.primary),
        "metrics of which one has to gain; docs/gate.md lists them",
    )
    accept = flags.DEFINE_list(
        "accept",
        [],
        f"ids of cases whose new fault a person has looked at, as cut_in/017@0; "
        f"{MAX_ACCEPTED} at most",
    )
    texts = {
        "collision": "more cases with a preventable at-fault collision, share",
        "vulnerable": "with a pedestrian or cyclist hit",
        "red_light": "with a red light run",
        "stop_sign": "with a stop sign run",
        "collision_free": "largest loss of fault-free cases, share",
        "impact": "harder at-fault impacts, one of 10 m/s counts as one case, share",
        "min_ttc": "of cases above 0.95 s to collision",
        "speed_limit": "of cases within the limit",
        "on_road": "of cases on the road",
        "family_clean": "of the clean drives in one family",
        "progress": "of the incumbent's progress",
        "family_progress": "of its progress in one family",
        "likeness": "farther from the human, share of the incumbent's distance",
        "recorded": "vehicles of held-out drives with more of a fault, share",
        "headway": "more time with a headway below 1 s on held-out drives, share",
        "gain": "of one primary metric, whatever is gained in another",
    }
    numbers = {
        name: flags.DEFINE_float(f"{name}_margin", getattr(usual, name), text)
        for name, text in texts.items()
    }
    return lambda: dataclasses.replace(
        usual,
        primary=tuple(primary.value or ()),
        accept=tuple(accept.value or ()),
        **{name: flag.value for name, flag in numbers.items()},
    )


@_subject("Which scenes of a dataset are held out")
def holdout() -> Callable[[Demonstrations], tuple[list[Demonstrations], str]]:
    """Defines --holdout, --folds, --split_seed, --recording.

    Returns:
      What splits a dataset as they say, once or by --folds, and says so in words.
    """
    holdout = flags.DEFINE_enum(
        "holdout", "groups", HOLDOUTS, "what is held out, see above"
    )
    folds = flags.DEFINE_integer(
        "folds",
        0,
        "instead: the recordings in so many parts, each held out once; 0: not",
        0,
    )
    seed = flags.DEFINE_integer(
        "split_seed", 0, "draws the vehicles of --holdout=vehicles or validation", 0
    )
    recording = flags.DEFINE_list(
        "recording", ["0"], "numbers of those of --holdout=recording, from 0"
    )
    read_by = {"recording": ("recording",), "split_seed": ("vehicles", "validation")}

    def splits(dataset: Demonstrations) -> tuple[list[Demonstrations], str]:
        if folds.value:
            mutually_exclusive("folds", "holdout", "recording", "split_seed")
            words = f"{folds.value} parts of the recordings, each held out once"
            return list(folds_by_recording(dataset, folds.value)), words
        for flag in (recording, seed):
            if flag.present and holdout.value not in read_by[flag.name]:
                raise InputError(
                    f"--{flag.name}: {flag.value}: expected with --holdout="
                    f"{' or '.join(read_by[flag.name])}, not {holdout.value}"
                )
        try:
            named = [int(number) for number in recording.value]
        except ValueError as error:
            raise InputError(f"--recording: {recording.value}: {error}") from error
        one, words = held_out(dataset, holdout.value, seed=seed.value, recordings=named)
        return [one], words

    return splits


@functools.cache
def recipes_default(name: str) -> str:
    """The value of the default recipe where a flag is not given, for its help."""
    said = load_recipe(DEFAULT)
    train, collect = said.train, said.collect
    values: dict[str, Any] = {**vars(train.reward), **vars(train)}
    values |= {flag: getattr(collect, field) for flag, (field, _) in _COLLECT.items()}
    values |= {f: not getattr(collect, field) for f, (field, _) in _FILTERS.items()}
    values |= {
        "hidden_size": train.reward.hidden or 0,
        "scene_gating": bool(train.reward.scene_gating),
        "mode": train.sampler.mode,
        "margins": (train.margin_distance, train.margin_collision, train.margin_rule),
        "learning_rates": train.learning_rate,
        "expert": said.simulated.expert,
        "seeds": said.seeds,
    }
    value = values[name]
    if isinstance(value, bool):
        value = str(value).lower()
    if isinstance(value, tuple):
        value = ",".join(map(str, value))
    return f" (default: {value}, of the recipe)" if value != "" else ""
