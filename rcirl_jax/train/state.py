"""What training carries: state, batch, configuration."""

import dataclasses
import inspect
from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax

from rcirl_jax.errors import InputError, did_you_mean
from rcirl_jax.reward import (
    LOSSES,
    LossConfig,
    Normaliser,
    Parameters,
    RewardConfig,
    RewardParams,
)
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

    # feature preset, data_specs/features/<name>.toml
    features: str = "paper21"
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
        """What decides candidates, features and facts; all else at its default."""
        return TrainConfig(
            features=self.features,
            # the only loss that asks for densities
            loss="listwise" if self.loss == "listwise" else "rank",
            positive=self.positive,
            futures=self.futures,
            admissible_in=self.admissible_in,
            train_horizon=self.train_horizon,
            hard_negatives=self.hard_negatives,
            hard_pool=self.hard_pool,
            sampler=self.sampler,
        )

    @property
    def for_step(self) -> "TrainConfig":
        """What decides the program of a step: a state and batches bring the rest."""
        return dataclasses.replace(self, seed=0, epochs=1)

    @property
    def loss_config(self) -> LossConfig:
        """Constants of the losses."""
        names = [field.name for field in dataclasses.fields(LossConfig)]
        return LossConfig(**{name: getattr(self, name) for name in names})


class TrainState(flax.struct.PyTreeNode, kw_only=True):
    """All that a step changes or needs besides its batch; what a checkpoint holds.

    Flax's own TrainState would carry `apply` and the optimiser too: here the
    configuration makes them (`make_train_step`).
    """

    step: jax.Array  # [] int32, steps taken, refused ones included
    params: Parameters  # raw: pin and constraints are applied where they are used
    opt_state: optax.OptState  # of `make_optimizer`
    key: jax.Array  # typed PRNG key; folded with step and row, never split away
    normaliser: Normaliser  # frozen


class Facts(flax.struct.PyTreeNode, kw_only=True):
    """What losses know about the trajectories besides their values."""

    human_distance: jax.Array  # [B] m, the positive's mean distance to the human
    human_collides: jax.Array  # [B] bool, of the positive; a recorded curve's is False
    distance: jax.Array  # [B, K] m, the candidates'
    collides: jax.Array  # [B, K] bool, meets a body at a valid time
    breaks_rule: jax.Array  # [B, K] share of times over the limit; 1: ran a line
    human_density: jax.Array  # [B] log of the proposal's density
    density: jax.Array  # [B, K]


class FeatureBatch(flax.struct.PyTreeNode, kw_only=True):
    """The same with features already made (a feature cache)."""

    human: jax.Array  # [B, T, F] of the positive
    candidates: jax.Array  # [B, F, T, K]: points run along the long axes
    feasible: jax.Array  # [B, K] bool
    time_valid: jax.Array  # [B, T] bool
    facts: Facts
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


class Batch(flax.struct.PyTreeNode, kw_only=True):
    """Scenes of one step; candidates and features are made on the device."""

    demonstrations: Demonstration  # [B, ...]
    weight: jax.Array  # [B] 1, or 0 for padding
    index: jax.Array  # [B] int32, row in the dataset; seeds the sampler


def weight_decay(config: TrainConfig) -> optax.GradientTransformation:
    """The pull on kernels and biases; time weights, context and prior stay free."""
    if config.weight_decay == 0.0:
        return optax.identity()

    def pulled(params: Parameters) -> Parameters:
        free = jax.tree.map(lambda _: False, params)
        if not isinstance(params, RewardParams):
            return {**free, "point": jax.tree.map(lambda _: True, params["point"])}
        yes = jax.tree.map(lambda _: True, (params.kernels, params.biases))
        return free.replace(kernels=yes[0], biases=yes[1])

    return optax.add_decayed_weights(config.weight_decay, mask=pulled)


def make_rule(
    config: TrainConfig, rate: optax.ScalarOrSchedule
) -> optax.GradientTransformation:
    """The optimiser with a step size, after clipping and weight decay as configured."""
    parts = [weight_decay(config), OPTIMIZERS[config.optimizer](rate)]
    if config.clip_norm:
        parts.insert(0, optax.clip_by_global_norm(config.clip_norm))
    return optax.chain(*parts)


def make_optimizer(config: TrainConfig) -> optax.GradientTransformation:
    """The optimiser named in the configuration, its step size halved as asked."""
    rate: optax.ScalarOrSchedule = config.learning_rate
    if config.halve_every:
        rate = optax.exponential_decay(rate, config.halve_every, 0.5)
    return make_rule(config, rate)
