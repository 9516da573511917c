"""Adam over a set of Gaussians that grows and shrinks, and over what is learnt beside it."""

from collections.abc import Callable, Mapping, Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from extrap_train.gaussians.gaussian_model import GaussianParameters
from extrap_train.gaussians.gaussian_options import Schedule, exponential

_MOMENTS = ("exp_avg", "exp_avg_sq")


class GaussianOptimiser:
    """Owns the parameters; one learning rate a kind, and moments that follow the rows."""

    def __init__(self, start: GaussianParameters, rates: Mapping[str, float]) -> None:
        groups = [
            {"params": [nn.Parameter(tensor.detach().clone())], "lr": rates[name], "name": name}
            for name, tensor in start.tensors().items()
        ]
        self._adam = torch.optim.Adam(groups, eps=1e-15, fused=True)

    @property
    def parameters(self) -> GaussianParameters:
        """The parameters as they are now: the graph's leaves."""
        groups = self._adam.param_groups
        return GaussianParameters(**{group["name"]: group["params"][0] for group in groups})

    def __len__(self) -> int:
        return len(self.parameters)

    def set_rate(self, name: str, rate: float) -> None:
        """Another learning rate for one kind of parameter."""
        for group in self._adam.param_groups:
            if group["name"] == name:
                group["lr"] = rate

    def step(self, means_factor: Float[Tensor, "n 1"] | None = None) -> None:
        """One step along the gradients, which are then forgotten.

        `means_factor` multiplies each Gaussian's step of its mean. Parameters without a gradient
        stay, and so do their moments.
        """
        means = self.parameters.means.detach()
        before = means.clone()
        self._adam.step()
        if means_factor is not None:
            means.copy_(before + means_factor * (means - before))
        self._adam.zero_grad(set_to_none=True)

    def keep(self, rows: Bool[Tensor, " n"] | Int[Tensor, " m"]) -> None:
        """Only these Gaussians are left, with their moments."""
        for group in self._adam.param_groups:
            self._replace(group, group["params"][0].detach()[rows], lambda moment: moment[rows])

    def append(self, new: GaussianParameters) -> None:
        """More Gaussians; their moments start at zero."""
        added = new.tensors()

        def longer(moment: Tensor) -> Tensor:
            return torch.cat([moment, moment.new_zeros(len(new), *moment.shape[1:])])

        for group in self._adam.param_groups:
            old = group["params"][0].detach()
            self._replace(group, torch.cat([old, added[group["name"]].detach().to(old)]), longer)

    def overwrite(self, name: str, value: Tensor) -> None:
        """Set one kind of parameter; its moments restart at zero."""
        for group in self._adam.param_groups:
            if group["name"] == name:
                self._replace(group, value.detach(), torch.zeros_like)

    def _replace(self, group: dict, value: Tensor, moment: Callable[[Tensor], Tensor]) -> None:
        state = self._adam.state.pop(group["params"][0], None)
        group["params"] = [nn.Parameter(value.clone())]
        if state is not None:
            moments = {key: moment(state[key]).contiguous() for key in _MOMENTS}
            self._adam.state[group["params"][0]] = state | moments


class ModuleOptimiser:
    """Adam for what is learnt beside the Gaussians, at rates that fall exponentially."""

    def __init__(
        self, modules: Sequence[tuple[nn.Module, float, float]], schedule: Schedule
    ) -> None:
        self._rates = [
            (start * schedule.rate_factor, end * schedule.rate_factor) for _, start, end in modules
        ]
        self._learnt = [value for module, _, _ in modules for value in module.parameters()]
        groups = [{"params": list(module.parameters())} for module, _, _ in modules]
        self._adam = torch.optim.Adam(groups, eps=1e-15, fused=True) if groups else None

    def is_finite(self) -> bool:
        """Whether no number that is learnt is NaN or infinite."""
        return all(is_finite(value.detach()) for value in self._learnt)

    def step(self, progress: float) -> None:
        """One step along the gradients, which are then forgotten."""
        if self._adam is None:
            return
        for group, (start, end) in zip(self._adam.param_groups, self._rates, strict=True):
            group["lr"] = exponential(start, end, progress)
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)


def is_finite(values: Float[Tensor, "..."]) -> bool:
    """Whether no number is NaN or infinite, or so large that their sum is: one pass, where asking
    every number took half the time of an iteration with a hash grid.
    """
    return bool(values.sum().isfinite())
