"""The actor: a Gaussian policy behind tanh, and the terms of its loss that concern its shape."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import cast

import torch
from torch import Tensor, nn

from certify.loop.policies import PolicyNetwork
from controllers.options import Activation, Centre, GainNorm
from controllers.training.departure import departure
from controllers.training.device import CPU, exact
from controllers.training.interface import Interface
from controllers.training.units import Units, begin_away, keep_away


def squashed_log_likelihood(w: Tensor, mean: Tensor, log_std: Tensor, scale: Tensor) -> Tensor:
    """Log density of `u = scale * tanh(w) + offset` with w ~ N(mean, exp(log_std)^2), summed over inputs.

    The change of variables subtracts `log |du/dw| = log scale + log(1 - tanh(w)^2)`, here in the form
    `2 (log 2 - w - softplus(-2 w))`, which does not cancel for large w.
    """
    gaussian = -0.5 * ((w - mean) * torch.exp(-log_std)) ** 2 - log_std - 0.5 * math.log(2 * math.pi)
    stretch = torch.log(scale) + 2 * (math.log(2) - w - nn.functional.softplus(-2 * w))
    return (gaussian - stretch).sum(-1)


class Actor(nn.Module):
    """Gaussian policy behind tanh; the network's mean head alone is the policy that ships.

    Parameters
    ----------
    interface : the action's scale and offset, u_eq, and the states' factors.
    widths : hidden widths.
    centre : how the mean will be centred, if at all; decides which Jacobian is compared with -K.
    log_std : lower and upper bound of the log standard deviation, or none.
    activation : the function between the layers.
    """

    scale: Tensor
    offset: Tensor
    u_eq: Tensor
    factors: Tensor
    rest: Tensor

    def __init__(
        self,
        interface: Interface,
        widths: Sequence[int],
        centre: Centre,
        log_std: Sequence[float],
        activation: Activation = "tanh",
    ) -> None:
        super().__init__()
        n, m = len(interface.state_factors), len(interface.scale)
        sizes = [n, *widths]
        self.hidden = nn.ModuleList(nn.Linear(a, b, device=CPU) for a, b in pairwise(sizes))
        self.mean = nn.Linear(sizes[-1], m, device=CPU)
        self.log_std = nn.Linear(sizes[-1], m, device=CPU)
        self.centre, self.bounds, self.units = centre, tuple(log_std), Units(activation)
        begin_away(self._arrays(), self.units)
        for name, numbers in (
            ("scale", interface.scale),
            ("offset", interface.offset),
            ("u_eq", interface.u_eq),
            ("factors", interface.state_factors),
            ("rest", interface.to_normalised(interface.u_eq)),
        ):
            self.register_buffer(name, torch.from_numpy(numbers).float())

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation of w, before the squash."""
        h = x * self.factors
        for layer in self.hidden:
            h = self.units(layer(h))
        log_std = self.log_std(h)
        return self.mean(h), log_std.clamp(*self.bounds) if self.bounds else log_std

    def sample(self, x: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """`tanh(w)` and the log-likelihood of the physical input, with `noise` ~ N(0, 1)."""
        mean, log_std = self(x)
        w = mean + torch.exp(log_std) * noise
        return torch.tanh(w), squashed_log_likelihood(w, mean, log_std, self.scale)

    def at_origin(self) -> tuple[Tensor, Tensor]:
        """mu(0), shape (m,), and J_mu(0), shape (m, n), of the mean action; both can be differentiated.

        Notes
        -----
        The Jacobian is the one of the mean as it ships. With preactivation centring its last slope
        is taken at u_eq and not at mu(0); the two agree once mu(0) = u_eq.
        """
        h = torch.zeros_like(self.factors)
        jacobian = torch.diag(self.factors)
        for layer in self._layers():
            h, slope = self.units.pair(layer(h))
            jacobian = slope[:, None] * (layer.weight @ jacobian)
        normalised = torch.tanh(self.mean(h))
        last = self.rest if self.centre == "preactivation" else normalised
        jacobian = (self.scale * (1 - last * last))[:, None] * (self.mean.weight @ jacobian)
        return self.scale * normalised + self.offset, jacobian

    def jacobian(self, x: Tensor) -> Tensor:
        """J_mu at states x (batch, n), shape (batch, m, n), of the mean action as it ships; can be differentiated."""
        h, rest = x * self.factors, torch.zeros_like(self.factors)
        jacobian = torch.diag(self.factors).expand(len(x), -1, -1)
        for layer in self._layers():
            (h, slope), rest = self.units.pair(layer(h)), self.units(layer(rest))
            jacobian = slope[..., None] * (layer.weight @ jacobian)
        w = self.mean(h)
        if self.centre == "preactivation":
            w = w - self.mean(rest) + torch.atanh(self.rest)
        slope = 1 - torch.tanh(w) ** 2
        result: Tensor = (self.scale * slope)[..., None] * (self.mean.weight @ jacobian)
        return result

    def curvature_loss(self, x: Tensor) -> Tensor:
        """Mean of `||J_mu(x) - J_mu(0)|| / ||x||` over states x (batch, n), none of them 0; Frobenius norm."""
        change = self.jacobian(x) - self.jacobian(torch.zeros_like(x[:1]))
        quotients: Tensor = torch.linalg.vector_norm(change, dim=(1, 2)) / torch.linalg.vector_norm(x, dim=1)
        return quotients.mean()

    def rest_loss(self) -> Tensor:
        """Sum over the hidden layers of ||h(0)||_2, h the layer's tanh units; 0 of other units.

        Where all of them are 0, so is every second derivative of the mean before its last tanh, unit by unit and not
        only in sum: bounds that add magnitudes find no curvature there either. Units far from 0 are also nearly
        saturated, which slows learning down.
        """
        h = torch.zeros_like(self.factors)
        if self.units.name != "tanh":  # their second derivatives are not 0 where they are
            return h.sum()
        norms = []
        for layer in self._layers():
            h = torch.tanh(layer(h))
            norms.append(torch.linalg.vector_norm(h))
        return torch.stack(norms).sum()

    def departure(self, box: Tensor) -> Tensor:
        """`departure.departure` of the mean on the box with half-widths (n,), in the states' units."""
        layers = [*self._layers(), self.mean]
        weights = [layer.weight for layer in layers]
        biases = [layer.bias for layer in layers]
        return departure([weights[0] * self.factors, *weights[1:]], biases, box, self.units)

    def keep_corners_away(self, box: Tensor) -> None:
        """Move biases so that no unit passes its corner in the box with half-widths (n,), in the states' units."""
        keep_away(self._arrays(), self.units, box * self.factors)

    def gain_loss(self, K: Tensor, norm: GainNorm = "frobenius") -> Tensor:
        """`||J_mu(0) + K|| + ||mu(0) - u_eq||`, the first norm as chosen; the sign is that of u = u_eq - K x.

        The spectral norm is never larger than the Frobenius norm, and its gradient has rank 1: it pulls at the one
        direction in which the Jacobian is furthest from -K. With one input the two norms are the same.
        """
        mean, jacobian = self.at_origin()
        difference = jacobian + K
        distance = torch.linalg.vector_norm(difference) if norm == "frobenius" else _largest_singular(difference)
        loss: Tensor = distance + torch.linalg.vector_norm(mean - self.u_eq)
        return loss

    @torch.no_grad()
    def distance(self, K: Tensor | None) -> tuple[float, float]:
        """||J_mu(0) + K||, NaN without a gain, and ||mu(0) - u_eq||."""
        mean, jacobian = self.at_origin()
        offset = float(torch.linalg.vector_norm(mean - self.u_eq))
        return math.nan if K is None else float(torch.linalg.vector_norm(jacobian + K)), offset

    def network(self) -> PolicyNetwork:
        """The mean action as an exact network with its centring; the states' factors are folded in exactly."""
        layers = [*self._layers(), self.mean]
        weights = [exact(layer.weight) for layer in layers]
        weights[0] = weights[0] * exact(self.factors)
        return PolicyNetwork.of_layers(
            weights=tuple(weights),
            biases=tuple(exact(layer.bias) for layer in layers),
            scale=exact(self.scale),
            offset=exact(self.offset),
            squash="tanh",
            centre=self.centre,
            activation=self.units.name,
        )

    def _layers(self) -> list[nn.Linear]:
        return cast(list[nn.Linear], list(self.hidden))

    def _arrays(self) -> list[tuple[Tensor, Tensor]]:
        return [(layer.weight, layer.bias) for layer in self._layers()]


def _largest_singular(matrix: Tensor) -> Tensor:
    value: Tensor = torch.linalg.matrix_norm(matrix, 2)
    return value
