"""The training step of the rank loss in PyTorch: the rival of `benchmarks.training`.

Same network (F-H-1, tanh), normaliser, masks, pin, loss and Adam as
`rcirl_jax.train.step` with its defaults, in two forms:

* "plain": points before features, [B (1 + K) T, F]; normalise, then the layers;
* "tuned": as ours, features before points, [F, B T (1 + K)]; the normaliser's shift
  and scale go into the first layer, which saves it a pass.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from rcirl_jax.train.state import FeatureBatch
from rcirl_jax.types import Normaliser, RewardParams

FORMS = ("plain", "tuned")


class Inputs(NamedTuple):
    """A batch in the layout of one form."""

    features: torch.Tensor  # the human first, then the K candidates
    feasible: torch.Tensor  # [B, K] bool
    time_valid: torch.Tensor  # [B, T] bool
    weight: torch.Tensor  # [B]


def inputs_of(batch: FeatureBatch, form: str) -> Inputs:
    """The batch as contiguous tensors."""
    human = np.asarray(batch.human).swapaxes(1, 2)[..., None]
    both = np.concatenate([human, np.asarray(batch.candidates)], axis=3)  # [B, F, T, K]
    size = both.shape[1]
    if form == "plain":
        features = both.transpose(0, 3, 2, 1).reshape(-1, size)
    else:
        features = both.transpose(1, 0, 2, 3).reshape(size, -1)
    rest = (batch.feasible, batch.time_valid, batch.weight)
    return Inputs(*(_tensor(x) for x in (features, *rest)))


def parameters_of(params: RewardParams) -> list[torch.nn.Parameter]:
    """Own copies of gamma [T], kernel [F, H], bias [H] and output kernel [H, 1]."""
    leaves = (params.gamma, params.kernels[0], params.biases[0], params.kernels[1])
    return [torch.nn.Parameter(_tensor(leaf)) for leaf in leaves]


def loss_of(
    form: str, normaliser: Normaliser, leaky_rate: float
) -> Callable[..., torch.Tensor]:
    """`loss(parameters, inputs)`: mean rank loss over feasible pairs.

    L(y) = y if y >= 0 else a y,  y = V(candidate) - V(human)
    """
    fields = (normaliser.lower, normaliser.upper, normaliser.location, normaliser.scale)
    lower, upper, location, scale = (_tensor(x) for x in fields)

    def plain(gamma: torch.Tensor, rest: list, inputs: Inputs) -> torch.Tensor:
        kernel, bias, out = rest
        x = (torch.clamp(inputs.features, lower, upper) - location) / scale
        rewards = torch.tanh(torch.addmm(bias, x, kernel)) @ _unit(out)
        shape = (gamma.shape[0], -1, gamma.shape[1])
        return torch.sum(rewards.view(shape) * gamma[:, None], dim=2)

    def tuned(gamma: torch.Tensor, rest: list, inputs: Inputs) -> torch.Tensor:
        kernel, bias, out = rest
        first = kernel / scale[:, None]
        shift = (bias - location @ first)[:, None]
        x = torch.clamp(inputs.features, lower[:, None], upper[:, None])
        rewards = _unit(out).T @ torch.tanh(torch.addmm(shift, first.T, x))
        return torch.sum(rewards.view(*gamma.shape, -1) * gamma[:, :, None], dim=1)

    values_of = {"plain": plain, "tuned": tuned}[form]

    def loss(parameters: list, inputs: Inputs) -> torch.Tensor:
        gamma = torch.where(inputs.time_valid, _unit(parameters[0]), 0.0)
        values = values_of(gamma, parameters[1:], inputs)
        y = values[:, 1:] - values[:, :1]
        share = inputs.feasible * inputs.weight[:, None]
        terms = torch.where(y >= 0.0, y, leaky_rate * y) * share
        return torch.sum(terms) / torch.sum(share)

    return loss


def make_step(
    loss: Callable[..., torch.Tensor],
    parameters: list[torch.nn.Parameter],
    learning_rate: float,
) -> Callable[[Inputs], torch.Tensor]:
    """`step(inputs) -> loss`: gradient and Adam, its fused form; in place."""
    optimizer = torch.optim.Adam(parameters, lr=learning_rate, fused=True)

    def step(inputs: Inputs) -> torch.Tensor:
        optimizer.zero_grad(set_to_none=True)
        value = loss(parameters, inputs)
        value.backward()
        optimizer.step()
        return value.detach()

    return step


def compiled(loss: Callable[..., torch.Tensor]) -> Callable[..., torch.Tensor]:
    """The loss, forward and backward, under torch.compile with fixed shapes."""
    return torch.compile(loss, fullgraph=True, dynamic=False)


def _unit(x: torch.Tensor) -> torch.Tensor:
    return x / torch.sqrt(torch.sum(x**2) + 1e-12)


def _tensor(x: object) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(np.array(x)))
