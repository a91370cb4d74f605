"""The flags that decide the result of one training run."""

from absl import flags

from experiments.common import floats, hidden_sizes
from rcirl_jax.errors import InputError
from rcirl_jax.features import feature_map
from rcirl_jax.reward import LOSSES, RewardConfig
from rcirl_jax.reward.network import CONSTRAINTS
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.train.state import POSITIVES, TrainConfig

_FEATURES = flags.DEFINE_string("features", "paper21", "preset in data_specs/features")
_MODE = flags.DEFINE_enum(
    "mode", "speed", ["speed", "path_speed"], "what the sampler varies"
)
_LOSS = flags.DEFINE_enum("loss", "rank", sorted(LOSSES), "loss on value differences")
_MARGINS = flags.DEFINE_list(
    "margins", ["0.2", "4", "2"], "hinge: per metre from the human, collision, rule"
)
_SOFT = flags.DEFINE_float("soft_distance", 1.0, "m, temperature of soft labels")
_LEAKY = flags.DEFINE_float("leaky_rate", 0.05, "a of the rank loss")
_HIDDEN = flags.DEFINE_list("hidden_size", ["15"], "units per layer; 0 is linear")
_ACTIVATION = flags.DEFINE_enum(
    "activation", "tanh", ["tanh", "relu", "leaky_relu"], "of the hidden layers"
)
_CONSTRAINT = flags.DEFINE_enum(
    "constraint", "none", CONSTRAINTS, "nonnegative costs (linear), monotone in safety"
)
_BY_CONTEXT = flags.DEFINE_bool(
    "by_context", False, "scale the features by what the scene is like at t = 0"
)
_PIN = flags.DEFINE_enum("pin", "unit", ["unit", "none"], "scale pinning")
_OPTIMIZER = flags.DEFINE_enum(
    "optimizer", "adam", ["sgd", "adam", "rmsprop"], "gradient method"
)
_RATE = flags.DEFINE_float("learning_rate", 3e-3, "step size")
_HALVE = flags.DEFINE_integer("halve_every", 0, "steps per halving; 0: never")
_DECAY = flags.DEFINE_float("weight_decay", 0.0, "L2 pull on the weights")
_BATCH = flags.DEFINE_integer("batch_size", 64, "scenes per step, all devices")
_EPOCHS = flags.DEFINE_integer("epochs", 20, "passes over the training scenes")
POSITIVE = flags.DEFINE_enum(
    "positive",
    "human",
    POSITIVES,
    "ranked first: the human curve or its nearest candidate",
)
_HORIZON = flags.DEFINE_float("train_horizon", 8.0, "s that are compared")
_NEGATIVES = flags.DEFINE_integer("hard_negatives", 0, "near negatives per scene")
_POOL = flags.DEFINE_integer(
    "hard_pool", 1, "near negatives drawn for each that the present reward keeps"
)
PREFERENCES = flags.DEFINE_string(
    "preferences", None, "JSON Lines: in a scene, A is better than B"
)
_PREFERENCE_WEIGHT = flags.DEFINE_float(
    "preference_weight", 1.0, "of their mean loss beside that of the demonstrations"
)


def training_config(*, preferences: str = "", seed: int = 0) -> TrainConfig:
    """The run that the flags describe.

    Args:
      preferences: hash of the file of --preferences; empty without one.
      seed: of initial weights, batches, candidates.
    """
    if len(_MARGINS.value) != 3:
        raise InputError(f"--margins: {_MARGINS.value}: expected three numbers")
    margins = floats(_MARGINS.value, "margins")
    features = feature_map(_FEATURES.value)
    return TrainConfig(
        features=_FEATURES.value,
        loss=_LOSS.value,
        leaky_rate=_LEAKY.value,
        margin_distance=margins[0],
        margin_collision=margins[1],
        margin_rule=margins[2],
        soft_distance=_SOFT.value,
        optimizer=_OPTIMIZER.value,
        learning_rate=_RATE.value,
        halve_every=_HALVE.value,
        weight_decay=_DECAY.value,
        batch_size=_BATCH.value,
        epochs=_EPOCHS.value,
        positive=POSITIVE.value,
        train_horizon=_HORIZON.value,
        hard_negatives=_NEGATIVES.value,
        hard_pool=_POOL.value,
        preferences=preferences,
        preference_weight=_PREFERENCE_WEIGHT.value,
        seed=seed,
        reward=RewardConfig(
            hidden=hidden_sizes(_HIDDEN.value),
            activation=_ACTIVATION.value,
            pin=_PIN.value,
            constraint=_CONSTRAINT.value,
            context=features.context if _BY_CONTEXT.value else (),
            signs=features.signs if _CONSTRAINT.value == "monotone" else (),
        ),
        sampler=SamplerConfig(mode=_MODE.value),
    )
