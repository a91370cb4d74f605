"""State, batch and configuration of training."""

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax.training import train_state
from jax.typing import ArrayLike

from rcirl_jax.errors import InputError, did_you_mean
from rcirl_jax.reward import (
    LOSSES,
    CandidateInfo,
    LossConfig,
    Normaliser,
    RewardConfig,
    RewardParams,
)
from rcirl_jax.runtime.user_code import is_python, python_sha256
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.types import Demonstration

Optimizer = Callable[[optax.ScalarOrSchedule], optax.GradientTransformation]


# the first asks for the loss again, the second for a key, the third is deprecated, the
# others take no schedule
OTHERWISE = ("lbfgs", "noisy_sgd", "optimistic_adam", "rprop", "sm3")


def _of_optax() -> dict[str, Optimizer]:
    """Optax's functions of a learning rate alone, by their names."""
    found = {}
    for name, function in inspect.getmembers(optax, inspect.isfunction):
        arguments = inspect.signature(function).parameters.values()
        needed = {x.name for x in arguments if x.default is x.empty}
        first = next((x.name for x in arguments), "")
        if first == "learning_rate" and needed <= {first} and name not in OTHERWISE:
            found[name] = function
    return {n: f for n, f in found.items() if not n.startswith("scale_by")}


# those of the paper, then the others of optax
PAPER_OPTIMIZERS: dict[str, Optimizer] = {
    "sgd": lambda rate: optax.sgd(rate, momentum=0.9),
    "adam": optax.adam,
    "rmsprop": optax.rmsprop,
}
OPTIMIZERS = PAPER_OPTIMIZERS | (_of_optax() | PAPER_OPTIMIZERS)

NEVER = 2**31 - 1  # refused updates in a row after which one is taken all the same
POSITIVES = ("human", "nearest")
# what the learner sees of the others' future: the planner's prediction, or the record
FUTURES = ("predicted", "recorded")
LEARNED_FUTURES = (*FUTURES, "both")
ADMISSIBLE_IN = ("none", "simulated", "all")


# least, most, in words; constants of losses are >= 0 unless they are named
RANGES: dict[str, tuple[float, float, str]] = {
    **dict.fromkeys(
        [field.name for field in dataclasses.fields(LossConfig)], (0.0, np.inf, ">= 0")
    ),
    **dict.fromkeys(
        ("leaky_rate", "learning_rate"), (1e-12, 1.0 - 1e-6, "between 0 and 1")
    ),
    **dict.fromkeys(
        ("halve_every", "hard_negatives", "weight_decay", "clip_norm"),
        (0.0, np.inf, ">= 0"),
    ),
    **dict.fromkeys(("batch_size", "epochs", "hard_pool"), (1, np.inf, ">= 1")),
    "seed": (0, 2**31 - 1, "0 to 2147483647"),
    "soft_distance": (1e-6, np.inf, "> 0 m"),
    "train_horizon": (0.4, 8.0, "0.4 to 8 s"),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Everything that decides the result of training; hashable, in provenance."""

    # feature preset, data_specs/features/<name>.toml, or FILE.py:NAME of own terms
    features: str = "paper21"
    # sha256 of the file of own terms
    terms_sha256: str = ""
    # key of reward.LOSSES
    loss: str = "rank"
    # a of the rank loss (the paper: 0.05)
    leaky_rate: float = 0.05
    # hinge: margin per metre from the human, of a collision, of a broken rule
    margin_distance: float = 0.2
    margin_collision: float = 4.0
    margin_rule: float = 2.0
    # soft: m, temperature of the labels
    soft_distance: float = 1.0
    # key of OPTIMIZERS; the paper saw no difference between PAPER_OPTIMIZERS
    optimizer: str = "adam"
    # 1/step
    learning_rate: float = 3e-3
    # steps after which the step size has halved, smoothly (0: it stays)
    halve_every: int = 0
    # L2 pull on kernels and biases, per step
    weight_decay: float = 0.0
    # norm that the gradient is cut down to (0: as it is)
    clip_norm: float = 0.0
    # scenes per step, over all devices
    batch_size: int = 64
    # passes over the training scenes
    epochs: int = 20
    # what is ranked above the candidates: the "human" curve itself, or the
    # "nearest" feasible candidate to it (what a planner could have driven)
    positive: str = "human"
    # scenes in which the nearest candidate has to be one that the planner's safety
    # filter admits: "none", "simulated" ones (a planner drove there), or "all"
    admissible_in: str = "simulated"
    # the others' future: "predicted" as in closed loop, "recorded" as in the paper, or
    # "both": drawn anew for each scene and step, so that V can be asked about either
    futures: str = "predicted"
    # the cost that V is learned on: "" for none, "hand-set", the place of an own cost
    # (`planner.own_cost`), or in a recipe "own cost", the incumbent's
    residual_on: str = ""
    # its unit (`tuning.prior_cost.unit_of`), from which the learned gain starts
    own_unit: float = 1.0
    # with it: shares of the ego's speed at which half of the simulated scenes are shown
    slowed: tuple[float, ...] = ()
    # s, times after it are not compared, nor their weights learned
    train_horizon: float = 8.0
    # offline negatives near the human per scene (0: none)
    hard_negatives: int = 0
    # so many times more are drawn each time; those that the reward values most
    # just then are kept (1: all are)
    hard_pool: int = 1
    seed: int = 0
    reward: RewardConfig = dataclasses.field(default_factory=RewardConfig)
    sampler: SamplerConfig = dataclasses.field(default_factory=SamplerConfig)

    def __post_init__(self) -> None:
        """Reject values out of range."""
        if is_python(self.features):
            found = python_sha256(self.features, "terms")
            if self.terms_sha256 not in ("", found):
                raise InputError(
                    f"terms: {self.features}: they have changed since the training: "
                    "expected the same file, or a new training"
                )
            object.__setattr__(self, "terms_sha256", found)
        known = {"loss": LOSSES, "optimizer": OPTIMIZERS, "positive": POSITIVES}
        known |= {"futures": LEARNED_FUTURES, "admissible_in": ADMISSIBLE_IN}
        for name, values in known.items():
            if getattr(self, name) not in values:
                raise InputError(
                    f"{name}: {getattr(self, name)}: expected one of {sorted(values)}"
                    + did_you_mean(getattr(self, name), values)
                )
        for name, (low, high, text) in RANGES.items():
            if not low <= getattr(self, name) <= high:
                raise InputError(f"{name}: {getattr(self, name)}: expected {text}")
        if not all(0.0 <= share < 1.0 for share in self.slowed):
            raise InputError(
                f"slowed: {list(self.slowed)}: expected shares of the speed, each at "
                "least 0 and below 1"
            )
        if self.residual_on and self.positive != "nearest":
            raise InputError(
                f"positive: {self.positive}: expected nearest with residual_on: an own "
                "cost ranks what a planner could have driven"
            )
        if self.loss == "listwise" and self.hard_negatives and self.hard_pool > 1:
            raise InputError(
                f"hard_pool: {self.hard_pool}: expected 1 with loss=listwise: its "
                "proposal density is that of all candidates drawn"
            )

    @property
    def hard_drawn(self) -> int:
        """Hard negatives made per scene; they stand last among the candidates."""
        return self.hard_negatives * self.hard_pool

    @property
    def for_features(self) -> "TrainConfig":
        """Returns what decides candidates and features; the rest at its default."""
        return TrainConfig(
            features=self.features,
            terms_sha256=self.terms_sha256,
            # the only loss that asks for densities
            loss="listwise" if self.loss == "listwise" else "rank",
            positive=self.positive,
            futures=self.futures,
            admissible_in=self.admissible_in,
            train_horizon=self.train_horizon,
            hard_negatives=self.hard_negatives,
            hard_pool=self.hard_pool,
            residual_on=self.residual_on,
            own_unit=self.own_unit,
            slowed=self.slowed,
            sampler=self.sampler,
        )

    @property
    def for_step(self) -> "TrainConfig":
        """Returns what decides a step's program; state and batches bring the rest."""
        return dataclasses.replace(self, seed=0, epochs=1)

    @property
    def for_members(self) -> "TrainConfig":
        """Returns the fields that members of a sweep share (`train.sweep`)."""
        return dataclasses.replace(self, learning_rate=0.5, leaky_rate=0.5, seed=0)

    def loss_config(self, leaky_rate: ArrayLike | None = None) -> LossConfig:
        """Constants of the losses; a `leaky_rate` that is given may be traced."""
        names = [field.name for field in dataclasses.fields(LossConfig)]
        made = LossConfig(**{name: getattr(self, name) for name in names})
        if leaky_rate is None:
            return made
        return dataclasses.replace(made, leaky_rate=leaky_rate)


class TrainState(train_state.TrainState):
    """Flax's TrainState (step, params, opt_state, apply_fn, tx) and two more.

    `params` are raw (see `reward.network.effective_params`). A checkpoint holds the
    arrays; `apply_fn` and `tx` are static and come from the configuration.
    """

    key: jax.Array  # typed PRNG key; folded with step and row, never split away
    normaliser: Normaliser  # frozen


class Batch(flax.struct.PyTreeNode, kw_only=True):
    """Scenes of one step; candidates and features are made on the device."""

    demonstrations: Demonstration  # [B, ...]
    weight: jax.Array  # [B] 1, or 0 for padding
    index: jax.Array  # [B] int32, row in the dataset; seeds the sampler


class FeatureBatch(flax.struct.PyTreeNode, kw_only=True):
    """The same with features already made."""

    human: jax.Array  # [B, T, F] of the positive
    candidates: jax.Array  # [B, F, T, K]: points run along the long axes
    feasible: jax.Array  # [B, K] bool
    time_valid: jax.Array  # [B, T] bool
    info: CandidateInfo
    weight: jax.Array  # [B]
    index: jax.Array  # [B] int32

    @property
    def points(self) -> jax.Array:
        """The candidates as [B, K, T, F], the layout of `reward.value`."""
        return self.candidates.transpose(0, 3, 2, 1)

    @property
    def points_valid(self) -> jax.Array:
        """[B, K, T] bool, `time_valid` for every candidate."""
        shape = (*self.feasible.shape, self.time_valid.shape[-1])
        return jnp.broadcast_to(self.time_valid[:, None], shape)


@functools.lru_cache(maxsize=16)
def make_optimizer(config: TrainConfig) -> optax.GradientTransformation:
    """The optimiser of a configuration, after clipping and weight decay as configured.

    Its learning rate is an array of its state, so that the members of a sweep can
    differ in it. An update that is not finite is left out.
    """

    def rule(
        learning_rate: jax.Array, halved: ArrayLike = 1.0
    ) -> optax.GradientTransformation:
        parts = [OPTIMIZERS[config.optimizer](learning_rate * halved)]
        if config.weight_decay:
            parts.insert(0, optax.add_decayed_weights(config.weight_decay, _of_layers))
        if config.clip_norm:
            parts.insert(0, optax.clip_by_global_norm(config.clip_norm))
        return optax.chain(*parts)

    given: dict[str, Any] = {"learning_rate": config.learning_rate}
    if config.halve_every:
        given["halved"] = optax.exponential_decay(1.0, config.halve_every, 0.5)
    return optax.apply_if_finite(optax.inject_hyperparams(rule)(**given), NEVER)


def _of_layers(params: RewardParams) -> RewardParams:
    """Mask of weight decay: kernels and biases; gamma, gates and offset are free."""
    return {
        name: jax.tree.map(lambda _, name=name: name == "point", leaf)
        for name, leaf in params.items()
    }
