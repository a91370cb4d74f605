"""What shapes a reward: layers, scale, signs, context, or another R_theta."""

import dataclasses

from rcirl_jax.errors import InputError
from rcirl_jax.reward.module import ACTIVATIONS

PINS = ("unit", "none")

CONSTRAINTS = ("none", "nonnegative", "monotone")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """Shape of the value network; hashable."""

    # units of each hidden layer; () is linear
    hidden: tuple[int, ...] = (15,)
    # key of ACTIVATIONS
    activation: str = "tanh"
    # "unit": output kernel and gamma have unit norm (see `pinned`); "none": free
    pin: str = "unit"
    # "nonnegative": weights of costs, `hidden` must be (); "monotone": `signs`
    constraint: str = "none"
    # per feature: 1 the reward may not fall with it, -1 may not rise, 0 free
    signs: tuple[int, ...] = ()
    # per feature: 1 if its value at t = 0 is part of the context that sets the
    # gains of all features (see `gains`); () for one reward in all scenes
    context: tuple[int, ...] = ()
    # "package.module:Class", a linen module [..., F] -> [...] that is R_theta in the
    # place of `hidden` and `activation` (see `point_module`); "": the package's own
    module: str = ""

    def __post_init__(self) -> None:
        """Reject unknown names."""
        if self.activation not in ACTIVATIONS:
            raise InputError(
                f"activation: {self.activation}: expected one of {sorted(ACTIVATIONS)}"
            )
        if self.pin not in PINS:
            raise InputError(f"pin: {self.pin}: expected one of {PINS}")
        if self.constraint not in CONSTRAINTS:
            raise InputError(
                f"constraint: {self.constraint}: expected one of {CONSTRAINTS}"
            )
        if self.constraint == "nonnegative" and self.hidden:
            raise InputError(
                f"hidden: {self.hidden}: expected 0 under "
                "constraint=nonnegative, which is linear in its costs"
            )
        if self.constraint != "none" and self.module:
            raise InputError(
                f"constraint: {self.constraint}: expected none with module, of "
                "whose weights nothing is known"
            )

    def check_own(self) -> None:
        """Check that R_theta is the package's own.

        Raises:
          InputError: it is another module, which weights.msgpack cannot hold.
        """
        if self.module:
            raise InputError(
                f"module: {self.module}: expected none: weights.msgpack, and all "
                "that reads it, holds the package's own network; for others there are "
                "`rcirl train` and `rcirl export --stablehlo`"
            )

    @property
    def hidden_activation(self) -> str:
        """Activation of the effective network (see `pinned`)."""
        if self.constraint == "nonnegative":
            return "relu"
        return self.activation if self.hidden else "identity"
