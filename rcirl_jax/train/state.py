"""What training carries: state, batch, configuration."""

import dataclasses
from collections.abc import Callable

import flax.struct
import jax
import optax

from rcirl_jax.errors import InputError
from rcirl_jax.reward import LOSSES, Normaliser, RewardConfig, RewardParams
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.types import Demonstration

OPTIMIZERS: dict[
    str, Callable[[optax.ScalarOrSchedule], optax.GradientTransformation]
] = {
    "sgd": lambda rate: optax.sgd(rate, momentum=0.9),
    "adam": optax.adam,
    "rmsprop": optax.rmsprop,
}


POSITIVES = ("human", "nearest")


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Everything that decides the result of training; hashable, in provenance."""

    # feature preset, data_specs/features/<name>.toml
    features: str = "paper21"
    # key of reward.LOSSES
    loss: str = "rank"
    # a of the rank loss (the paper: 0.05)
    leaky_rate: float = 0.05
    # optimiser; the paper found no substantial difference between these
    optimizer: str = "adam"
    # 1/step
    learning_rate: float = 3e-3
    # steps after which the step size has halved, smoothly (0: it stays)
    halve_every: int = 0
    # L2 pull on kernels and biases, per step
    weight_decay: float = 0.0
    # scenes per step, over all devices
    batch_size: int = 64
    # passes over the training scenes
    epochs: int = 20
    # what is ranked above the candidates: the "human" curve itself, or the
    # "nearest" feasible candidate to it (what a planner could have driven)
    positive: str = "human"
    # offline negatives near the human per scene (0: none)
    hard_negatives: int = 0
    seed: int = 0
    reward: RewardConfig = dataclasses.field(default_factory=RewardConfig)
    sampler: SamplerConfig = dataclasses.field(default_factory=SamplerConfig)

    def __post_init__(self) -> None:
        """Reject values out of range with the flag's name."""
        if self.loss not in LOSSES:
            raise InputError(f"--loss: {self.loss}: expected one of {sorted(LOSSES)}")
        if self.optimizer not in OPTIMIZERS:
            raise InputError(
                f"--optimizer: {self.optimizer}: expected one of {sorted(OPTIMIZERS)}"
            )
        if self.positive not in POSITIVES:
            raise InputError(
                f"--positive: {self.positive}: expected one of {POSITIVES}"
            )
        for name, low in (("leaky_rate", 0.0), ("learning_rate", 0.0)):
            if not low < getattr(self, name) < 1.0:
                found = getattr(self, name)
                raise InputError(f"--{name}: {found}: expected between 0 and 1")
        if self.halve_every < 0:
            raise InputError(f"--halve_every: {self.halve_every}: expected >= 0")
        for name in ("batch_size", "epochs"):
            if getattr(self, name) < 1:
                raise InputError(f"--{name}: {getattr(self, name)}: expected >= 1")


class TrainState(flax.struct.PyTreeNode, kw_only=True):
    """Step counter, parameters, optimiser state, PRNG key, frozen normaliser."""

    step: jax.Array  # [] int32
    params: RewardParams
    opt_state: optax.OptState
    key: jax.Array  # typed PRNG key; folded, never split away
    normaliser: Normaliser


class Batch(flax.struct.PyTreeNode, kw_only=True):
    """Scenes of one step; candidates and features are made on the device."""

    demonstrations: Demonstration  # [B, ...]
    weight: jax.Array  # [B] 1, or 0 for padding
    index: jax.Array  # [B] int32, row in the dataset; seeds the sampler


class FeatureBatch(flax.struct.PyTreeNode, kw_only=True):
    """The same with features already made (a feature cache)."""

    human: jax.Array  # [B, T, F]
    candidates: jax.Array  # [B, K, T, F]
    feasible: jax.Array  # [B, K] bool
    time_valid: jax.Array  # [B, T] bool
    weight: jax.Array  # [B]
    index: jax.Array  # [B] int32


def make_optimizer(config: TrainConfig) -> optax.GradientTransformation:
    """The optimiser named in the configuration, its step size halved as asked."""
    decay = optax.add_decayed_weights(config.weight_decay)
    rate: optax.ScalarOrSchedule = config.learning_rate
    if config.halve_every:
        rate = optax.exponential_decay(rate, config.halve_every, 0.5)
    return optax.chain(decay, OPTIMIZERS[config.optimizer](rate))
