"""Soft actor-critic with a value network, and an actor that is tied to an LQR gain.

The algorithm of Haarnoja et al. (2018, first version: a value network V with an exponentially averaged
target, twin Q networks, temperature 1, rewards scaled), as Algorithm 1 of "Stochastic Reinforcement Learning
with Stability Guarantees for Control of Unknown Nonlinear Systems" uses it. One gradient step minimises

    V:      (V(x) - [min_i Q_i(x, u~) - log pi(u~|x)])^2,     u~ sampled from the actor
    Q_i:    (Q_i(x, u) - [scale * r + gamma * V_target(x+)])^2
    actor:  log pi(u~|x) - min_i Q_i(x, u~)  +  weight * (||J_mu(0) + K|| + ||mu(0) - u_eq||)

where the last term is there once a gain K is known, unless its weight is 0; mu is the mean action in
physical units. Three more terms are there for the sake of proofs. Two hold down the curvature near the origin:
`Actor.curvature_loss` lowers what it is, `Actor.rest_loss` what a bound of it sees. `Actor.departure` is what a bound
sees of the hidden units on the box where the policy is used. Everything is float32, as is the exported policy; the
states' factors are powers of two, so that folding them into the first layer rounds nothing and the exported network is
the trained one bit for bit.

Networks, replay table and batches live on one device. Random numbers are drawn on the CPU wherever the
networks live, so that a device changes the rounding of a run and not its random stream.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from certify.errors import InputError
from certify.loop.plants import System
from certify.loop.policies import TanhNetwork
from controllers.departure import departure
from controllers.options import Centre, GainNorm, TrainingOptions

Array = NDArray[np.float64]

CURVATURE_POINTS = 8  # states of the ball in the curvature's term, new ones in each gradient step
CPU = torch.device("cpu")


def find_device(name: str) -> torch.device:
    """The device `name`, cpu or cuda.

    Raises
    ------
    InputError : it is neither, or this machine or this torch has none.
    """
    if name not in ("cpu", "cuda"):
        raise InputError(f"`device` must be cpu or cuda; found {name!r}.")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("`device` is cuda, but torch finds no CUDA device here.")
    return torch.device(name)


def squashed_log_likelihood(w: Tensor, mean: Tensor, log_std: Tensor, scale: Tensor) -> Tensor:
    """Log density of `u = scale * tanh(w) + offset` with w ~ N(mean, exp(log_std)^2), summed over inputs.

    The change of variables subtracts `log |du/dw| = log scale + log(1 - tanh(w)^2)`, here in the form
    `2 (log 2 - w - softplus(-2 w))`, which does not cancel for large w.
    """
    gaussian = -0.5 * ((w - mean) * torch.exp(-log_std)) ** 2 - log_std - 0.5 * math.log(2 * math.pi)
    stretch = torch.log(scale) + 2 * (math.log(2) - w - nn.functional.softplus(-2 * w))
    return (gaussian - stretch).sum(-1)


class Interface:
    """What the learner is told of the plant: its input bounds, u_eq and the ranges of its states.

    `u = scale * tanh(w) + offset`; `state_factors` bring the states to order one, `reach` is how far each may go.
    """

    def __init__(self, system: System) -> None:
        u_lo, u_hi = np.array(system.input_bounds, dtype=np.float64).T
        lo, hi = np.array(system.domain, dtype=np.float64).T
        u_eq = np.array([float(u) for u in system.exact_u_eq()])
        if not np.all((u_lo < u_eq) & (u_eq < u_hi)):
            raise InputError(f"u_eq of {system.name} must lie inside the input bounds; found {u_eq}.")
        self.scale, self.offset, self.u_eq = (u_hi - u_lo) / 2, (u_hi + u_lo) / 2, u_eq
        self.reach = np.minimum(-lo, hi)
        self.state_factors = 0.5 ** np.round(np.log2(np.maximum(-lo, hi)))

    def to_action(self, normalised: Array) -> Array:
        """Physical input of `tanh(w)`."""
        return np.asarray(self.scale * normalised + self.offset)

    def to_normalised(self, u: Array) -> Array:
        """`tanh(w)` of a physical input."""
        return np.asarray((u - self.offset) / self.scale)


class Actor(nn.Module):
    """Tanh Gaussian policy; the network's mean head alone is the policy that ships.

    Parameters
    ----------
    interface : the action's scale and offset, u_eq, and the states' factors.
    widths : hidden widths.
    centre : how the mean will be centred, if at all; decides which Jacobian is compared with -K.
    log_std : lower and upper bound of the log standard deviation, or none.
    """

    scale: Tensor
    offset: Tensor
    u_eq: Tensor
    factors: Tensor
    rest: Tensor

    def __init__(self, interface: Interface, widths: Sequence[int], centre: Centre, log_std: Sequence[float]) -> None:
        super().__init__()
        n, m = len(interface.state_factors), len(interface.scale)
        sizes = [n, *widths]
        self.hidden = nn.ModuleList(nn.Linear(a, b, device=CPU) for a, b in pairwise(sizes))
        self.mean = nn.Linear(sizes[-1], m, device=CPU)
        self.log_std = nn.Linear(sizes[-1], m, device=CPU)
        self.centre, self.bounds = centre, tuple(log_std)
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
            h = torch.tanh(layer(h))
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
            h = torch.tanh(layer(h))
            jacobian = (1 - h * h)[:, None] * (layer.weight @ jacobian)
        normalised = torch.tanh(self.mean(h))
        last = self.rest if self.centre == "preactivation" else normalised
        jacobian = (self.scale * (1 - last * last))[:, None] * (self.mean.weight @ jacobian)
        return self.scale * normalised + self.offset, jacobian

    def jacobian(self, x: Tensor) -> Tensor:
        """J_mu at states x (batch, n), shape (batch, m, n), of the mean action as it ships; can be differentiated."""
        h, rest = x * self.factors, torch.zeros_like(self.factors)
        jacobian = torch.diag(self.factors).expand(len(x), -1, -1)
        for layer in self._layers():
            h, rest = torch.tanh(layer(h)), torch.tanh(layer(rest))
            jacobian = (1 - h * h)[..., None] * (layer.weight @ jacobian)
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
        """Sum over the hidden layers of ||h(0)||_2, h the layer's tanh units.

        Where all of them are 0, so is every second derivative of the mean before its last tanh, unit by unit and not
        only in sum: bounds that add magnitudes find no curvature there either. Units far from 0 are also nearly
        saturated, which slows learning down.
        """
        h = torch.zeros_like(self.factors)
        norms = []
        for layer in self._layers():
            h = torch.tanh(layer(h))
            norms.append(torch.linalg.vector_norm(h))
        return torch.stack(norms).sum()

    def departure(self, box: Tensor) -> Tensor:
        """`departure.departure` of the mean on the box with half-widths (n,), in the states' units."""
        layers = [*self._layers(), self.mean]
        weights = [layer.weight for layer in layers]
        return departure([weights[0] * self.factors, *weights[1:]], [layer.bias for layer in layers], box)

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

    def network(self) -> TanhNetwork:
        """The mean action as an exact tanh network with its centring; the states' factors are folded in exactly."""
        layers = [*self._layers(), self.mean]
        weights = [_exact(layer.weight) for layer in layers]
        weights[0] = weights[0] * _exact(self.factors)
        return TanhNetwork(
            weights=tuple(weights),
            biases=tuple(_exact(layer.bias) for layer in layers),
            scale=_exact(self.scale),
            offset=_exact(self.offset),
            squash="tanh",
            centre=self.centre,
        )

    def _layers(self) -> list[nn.Linear]:
        return cast(list[nn.Linear], list(self.hidden))


class Critic(nn.Module):
    """`copies` independent tanh networks of one shape, evaluated together by batched products.

    Returns shape (copies, batch) for inputs of shape (batch, inputs). Values are `scale` times the last layer's output:
    returns of some hundreds, learned with steps of 3e-4, would otherwise be reached only by saturating every tanh.
    """

    def __init__(self, inputs: int, widths: Sequence[int], copies: int, scale: float = 1.0) -> None:
        super().__init__()
        self.scale = scale
        sizes = [inputs, *widths, 1]
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for a, b in pairwise(sizes):
            bound = 1 / math.sqrt(a)
            self.weights.append(nn.Parameter(torch.empty(copies, a, b, device=CPU).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(torch.empty(copies, 1, b, device=CPU).uniform_(-bound, bound)))
        self.copies = copies

    def forward(self, x: Tensor) -> Tensor:
        """Values, shape (copies, batch)."""
        h = x.expand(self.copies, *x.shape)
        last = len(self.weights) - 1
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            h = torch.baddbmm(bias, h, weight)
            if k < last:
                h = torch.tanh(h)
        return self.scale * h.squeeze(-1)


class Replay:
    """A ring of transitions (x, tanh(w), reward, x+, terminated) in one float32 table."""

    def __init__(self, capacity: int, n: int, m: int, device: torch.device = CPU) -> None:
        self.table = torch.empty(capacity, 2 * n + m + 2, device=device)
        self._sizes = [n, m, 1, n, 1]
        self.count = 0

    def __len__(self) -> int:
        return min(self.count, len(self.table))

    def add(self, x: Array, normalised: Array, reward: float, x_next: Array, terminated: bool) -> None:
        """Store one transition over the oldest."""
        row = np.concatenate([x, normalised, [reward], x_next, [terminated]])
        self.table[self.count % len(self.table)].copy_(torch.from_numpy(row))
        self.count += 1

    def sample(self, size: int, generator: torch.Generator) -> tuple[Tensor, ...]:
        """`size` transitions, uniformly with replacement; `generator` lives on the CPU."""
        index = torch.randint(len(self), (size,), generator=generator, device=CPU)
        return torch.split(self.table[index.to(self.table.device)], self._sizes, dim=1)


class SAC:
    """The learner: networks, optimisers, one gradient step.

    Parameters
    ----------
    interface : what the learner is told of the plant.
    options : hyperparameters.
    generator : source of the actor's noise, on the CPU; initial weights come from torch's global generator.
    device : where the networks live and where batches come from.
    """

    def __init__(
        self,
        interface: Interface,
        options: TrainingOptions,
        generator: torch.Generator,
        device: torch.device = CPU,
    ) -> None:
        n, m = len(interface.state_factors), len(interface.scale)
        self.options, self.generator, self.device = options, generator, device
        self.actor = Actor(interface, options.actor, options.centre, options.log_std).to(device)
        self.value = Critic(n, options.critic, 1, options.critic_scale).to(device)
        self.value_target = Critic(n, options.critic, 1, options.critic_scale).to(device)
        self.value_target.load_state_dict(self.value.state_dict())
        self.q = Critic(n + m, options.critic, 2, options.critic_scale).to(device)
        self.box = torch.tensor(options.proof_box or options.start * interface.reach, device=device)
        self._actor_weights = list(self.actor.parameters())
        self._critic_weights = [*self.value.parameters(), *self.q.parameters()]
        self._fresh: list[Tensor] = list(self.value.parameters())
        self._averaged: list[Tensor] = list(self.value_target.parameters())
        # `fused` is one call for all parameters; the critics share an optimiser but no parameter.
        self.actor_optimiser = torch.optim.Adam(self._actor_weights, options.learning_rate, fused=True)
        self.critic_optimiser = torch.optim.Adam(self._critic_weights, options.learning_rate, fused=True)

    def act(self, x: Array) -> Array:
        """A sampled action as `tanh(w)`, shape (m,)."""
        with torch.no_grad():
            noise = self._noise(*self.actor.scale.shape)
            normalised, _ = self.actor.sample(torch.from_numpy(x).float().to(self.device), noise)
        return _exact(normalised)

    def update(self, batch: tuple[Tensor, ...], K: Tensor | None, actor_step: float) -> None:
        """One gradient step of every network.

        Parameters
        ----------
        batch : x, tanh(w), reward, x+, terminated, each with the batch first.
        K : learned gain, or None as long as there is none.
        actor_step : share of the learning rate that the actor uses, in [0, 1].
        """
        x, action, reward, x_next, terminated = batch
        options, scaled = self.options, x * self.actor.factors
        noise = self._noise(len(x), len(self.actor.scale))
        fresh, log_likelihood = self.actor.sample(x, noise)
        q_fresh = self.q(torch.cat((scaled, fresh), 1)).amin(0)
        actor_loss = (log_likelihood - q_fresh).mean()
        if K is not None and options.gain_weight > 0:
            actor_loss = actor_loss + options.gain_weight * self.actor.gain_loss(K, options.gain_norm)
        if options.rest_weight > 0:
            actor_loss = actor_loss + options.rest_weight * self.actor.rest_loss()
        if options.curvature_weight > 0:
            actor_loss = actor_loss + options.curvature_weight * self.actor.curvature_loss(self._ball())
        if options.proof_weight > 0:
            actor_loss = actor_loss + options.proof_weight * self.actor.departure(self.box)
        actor_gradients = torch.autograd.grad(actor_loss, self._actor_weights)

        with torch.no_grad():
            value_goal = q_fresh - log_likelihood
            ahead = (1 - terminated.squeeze(1)) * self.value_target(x_next * self.actor.factors)
            q_goal = options.reward_scale * reward.squeeze(1) + options.gamma * ahead
        value_error = self.value(scaled) - value_goal
        q_error = self.q(torch.cat((scaled, action), 1)) - q_goal
        critic_loss = 0.5 * (value_error.square().sum() + q_error.square().sum()) / len(x)
        critic_gradients = torch.autograd.grad(critic_loss, self._critic_weights)

        self.actor_optimiser.param_groups[0]["lr"] = options.learning_rate * actor_step
        _apply(self.actor_optimiser, self._actor_weights, actor_gradients)
        _apply(self.critic_optimiser, self._critic_weights, critic_gradients)
        with torch.no_grad():
            torch._foreach_lerp_(self._averaged, self._fresh, options.tau)

    def state(self) -> dict[str, Any]:
        """Tensors and plain values for a checkpoint."""
        return {name: getattr(self, name).state_dict() for name in _PARTS}

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()`."""
        for name in _PARTS:
            getattr(self, name).load_state_dict(state[name])

    def _ball(self) -> Tensor:
        """States that are uniform in ||x|| <= eta, shape (CURVATURE_POINTS, n), none of them 0."""
        n = len(self.actor.factors)
        x = self._noise(CURVATURE_POINTS, n)
        share = torch.rand((CURVATURE_POINTS, 1), generator=self.generator, device=CPU)  # a multiple of 2^-24, 0 too
        length = share.clamp(min=2.0**-24).to(self.device) ** (1 / n)
        norm: Tensor = torch.linalg.vector_norm(x, dim=1, keepdim=True)
        return x * (self.options.eta * length / norm)

    def _noise(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator, device=CPU).to(self.device)


_PARTS = ("actor", "value", "value_target", "q", "actor_optimiser", "critic_optimiser")


def _apply(optimiser: torch.optim.Adam, weights: list[nn.Parameter], gradients: Sequence[Tensor]) -> None:
    for weight, gradient in zip(weights, gradients, strict=True):
        weight.grad = gradient
    optimiser.step()


def _largest_singular(matrix: Tensor) -> Tensor:
    value: Tensor = torch.linalg.matrix_norm(matrix, 2)
    return value


def _exact(tensor: Tensor) -> Array:
    return tensor.detach().cpu().double().numpy()
