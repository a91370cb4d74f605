"""Linen modules of somebody else's, as R_theta."""

import flax.linen as nn
import jax


class Residual(nn.Module):
    """r = out(tanh(h + W softplus(h))),  h = V x."""

    width: int = 6

    @nn.compact
    def __call__(self, x):
        h = nn.Dense(self.width)(x)
        h = nn.tanh(h + nn.Dense(self.width)(jax.nn.softplus(h)))
        return nn.Dense(1, name="out")(h)[..., 0]


class Nameless(nn.Module):
    """Its last layer has Flax's own name."""

    @nn.compact
    def __call__(self, x):
        return nn.Dense(1)(x)[..., 0]


class Wide(nn.Module):
    """Three numbers a point."""

    @nn.compact
    def __call__(self, x):
        return nn.Dense(3, name="out")(x)


class Stateful(nn.Module):
    """More than parameters."""

    @nn.compact
    def __call__(self, x):
        x = nn.BatchNorm(use_running_average=False)(x)
        return nn.Dense(1, name="out")(x)[..., 0]
