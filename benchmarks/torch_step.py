"""The training step in PyTorch: the baseline of `benchmarks.training`.

Same network (tanh layers, gains of the context), normaliser, masks, pin, loss (rank or
listwise) and Adam as `rcirl_jax.train.step`, in two forms:

* "plain": points before features, [B (1 + K) T, F]; normalise, then the layers;
* "tuned": as ours, features before points, [F, B T (1 + K)]; without a context the
  normaliser's shift and scale go into the first layer, which saves it a pass.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from rcirl_jax.reward.network import layers_of
from rcirl_jax.train.state import FeatureBatch, TrainConfig
from rcirl_jax.types import Normaliser, RewardParams

FORMS = ("plain", "tuned")


class Inputs(NamedTuple):
    """A batch in the layout of one form."""

    features: torch.Tensor  # the human first, then the K candidates
    feasible: torch.Tensor  # [B, K] bool
    time_valid: torch.Tensor  # [B, T] bool
    weight: torch.Tensor  # [B]
    density: torch.Tensor  # [B, 1 + K] log density of the proposal


class Weights(NamedTuple):
    """The trainable parameters, as in `RewardParams`."""

    gamma: torch.Tensor  # [T]
    kernels: list[torch.Tensor]  # [F, H1], ..., [H, 1]
    biases: list[torch.Tensor]  # [H1], ...
    context: torch.Tensor | None  # [F, F]

    @property
    def leaves(self) -> list[torch.Tensor]:
        """In the order of `leaves_of`."""
        more = [] if self.context is None else [self.context]
        return [self.gamma, *self.kernels, *self.biases, *more]


def inputs_of(batch: FeatureBatch, form: str) -> Inputs:
    """The batch as contiguous tensors."""
    human = np.asarray(batch.human).swapaxes(1, 2)[..., None]
    both = np.concatenate([human, np.asarray(batch.candidates)], axis=3)  # [B, F, T, K]
    size = both.shape[1]
    if form == "plain":
        features = both.transpose(0, 3, 2, 1).reshape(-1, size)
    else:
        features = both.transpose(1, 0, 2, 3).reshape(size, -1)
    own = np.asarray(batch.info.human_density)[:, None]
    density = np.concatenate([own, np.asarray(batch.info.density)], axis=1)
    rest = (batch.feasible, batch.time_valid, batch.weight, density)
    return Inputs(*(_tensor(x) for x in (features, *rest)))


def leaves_of(params: RewardParams) -> list[np.ndarray]:
    """Gamma, kernels, biases and the context, if there is one."""
    kernels, biases = layers_of(params["point"])
    more = [params["scene_gating"]] if "scene_gating" in params else []
    leaves = [params["gamma"], *kernels, *biases, *more]
    return [np.asarray(leaf) for leaf in leaves]


def parameters_of(params: RewardParams) -> Weights:
    """Own copies of a network's parameters."""
    own = lambda leaf: torch.nn.Parameter(_tensor(leaf))  # noqa: E731
    kernels, biases = layers_of(params["point"])
    return Weights(
        gamma=own(params["gamma"]),
        kernels=[own(kernel) for kernel in kernels],
        biases=[own(bias) for bias in biases],
        context=own(params["scene_gating"]) if "scene_gating" in params else None,
    )


def loss_of(
    form: str, normaliser: Normaliser, config: TrainConfig
) -> Callable[..., torch.Tensor]:
    """`loss(weights, inputs)`: the mean loss of a batch, "rank" or "listwise"."""
    fields = (normaliser.lower, normaliser.upper, normaliser.location, normaliser.scale)
    lower, upper, location, scale = (_tensor(x) for x in fields)
    shared = torch.tensor(config.reward.context, dtype=torch.float32)[:, None]
    pin = _unit if config.reward.scale_constraint == "unit" else lambda x: x
    of_values = {"rank": _rank(config.leaky_rate), "listwise": _listwise}[config.loss]

    def gains(context: torch.Tensor, start: torch.Tensor) -> torch.Tensor:
        return 2.0 * torch.sigmoid(start @ (shared * context))  # [B, F]

    def plain(gamma: torch.Tensor, weights: Weights, inputs: Inputs) -> torch.Tensor:
        scenes, times = gamma.shape
        x = (torch.clamp(inputs.features, lower, upper) - location) / scale
        if weights.context is not None:
            apart = x.view(scenes, -1, times, x.shape[1])
            gain = gains(weights.context, apart[:, 0, 0])
            x = (apart * gain[:, None, None]).view(x.shape)
        for kernel, bias in zip(weights.kernels[:-1], weights.biases, strict=True):
            x = torch.tanh(torch.addmm(bias, x, kernel))
        rewards = (x @ pin(weights.kernels[-1])).view(scenes, -1, times)
        return torch.sum(rewards * gamma[:, None], dim=2)

    def tuned(gamma: torch.Tensor, weights: Weights, inputs: Inputs) -> torch.Tensor:
        kernel, shift = weights.kernels[0], weights.biases[0]
        x = torch.clamp(inputs.features, lower[:, None], upper[:, None])
        if weights.context is None:
            kernel = kernel / scale[:, None]
            shift = shift - location @ kernel
        else:
            x = (x - location[:, None]) / scale[:, None]
            apart = x.view(x.shape[0], gamma.shape[0], -1)
            gain = gains(weights.context, apart[:, :, 0].T)
            x = (apart * gain.T[:, :, None]).view(x.shape)
        x = torch.tanh(torch.addmm(shift[:, None], kernel.T, x))
        layers = zip(weights.kernels[1:-1], weights.biases[1:], strict=True)
        for kernel, bias in layers:
            x = torch.tanh(torch.addmm(bias[:, None], kernel.T, x))
        rewards = pin(weights.kernels[-1]).T @ x
        return torch.sum(rewards.view(*gamma.shape, -1) * gamma[:, :, None], dim=1)

    values_of = {"plain": plain, "tuned": tuned}[form]

    def loss(weights: Weights, inputs: Inputs) -> torch.Tensor:
        gamma = torch.where(inputs.time_valid, pin(weights.gamma), 0.0)
        return of_values(values_of(gamma, weights, inputs), inputs)

    return loss


def _rank(leaky_rate: float) -> Callable[[torch.Tensor, Inputs], torch.Tensor]:
    """L(y) = y if y >= 0 else a y,  y = V(candidate) - V(human); mean over pairs."""

    def loss(values: torch.Tensor, inputs: Inputs) -> torch.Tensor:
        y = values[:, 1:] - values[:, :1]
        share = inputs.feasible * inputs.weight[:, None]
        terms = torch.where(y >= 0.0, y, leaky_rate * y) * share
        return torch.sum(terms) / torch.sum(share)

    return loss


def _listwise(values: torch.Tensor, inputs: Inputs) -> torch.Tensor:
    """-log of exp(V_h) / sum over all of exp(V) / q; mean over scenes."""
    counted = torch.cat(
        [torch.ones_like(inputs.feasible[:, :1]), inputs.feasible], dim=1
    )
    log_q = torch.where(counted, inputs.density, 0.0)
    mean = torch.sum(log_q, dim=1, keepdim=True) / torch.sum(
        counted, dim=1, keepdim=True
    )
    logits = torch.where(counted, values - (log_q - mean), -torch.inf)
    terms = torch.logsumexp(logits, dim=1) - values[:, 0]
    share = torch.where(torch.any(inputs.feasible, dim=1), inputs.weight, 0.0)
    return torch.sum(torch.where(share > 0.0, terms, 0.0) * share) / torch.sum(share)


def make_step(
    loss: Callable[..., torch.Tensor],
    weights: Weights,
    learning_rate: float,
) -> Callable[[Inputs], torch.Tensor]:
    """`step(inputs) -> loss`: gradient and Adam, its fused form; in place."""
    optimizer = torch.optim.Adam(weights.leaves, lr=learning_rate, fused=True)

    def step(inputs: Inputs) -> torch.Tensor:
        optimizer.zero_grad(set_to_none=True)
        value = loss(weights, inputs)
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
