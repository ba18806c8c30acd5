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

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from controllers.options import TrainingOptions
from controllers.training.actor import Actor
from controllers.training.critic import Critic
from controllers.training.device import CPU, exact
from controllers.training.interface import Interface

Array = NDArray[np.float64]
CURVATURE_POINTS = 8  # states of the ball in the curvature's term, new ones in each gradient step


class SAC:
    """The learner: networks, optimisers, one gradient step.

    Parameters
    ----------
    interface : the plant as the learner is told of it.
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
        shape = (options.actor, options.centre, options.log_std, options.activation)
        self.actor = Actor(interface, *shape).to(device)
        self.value = Critic(n, options.critic, 1, options.critic_scale).to(device)
        self.value_target = Critic(n, options.critic, 1, options.critic_scale).to(device)
        self.value_target.load_state_dict(self.value.state_dict())
        self.q = Critic(n + m, options.critic, 2, options.critic_scale).to(device)
        self.box = torch.tensor(options.proof_box or options.start * interface.reach, device=device)
        self._cornerless = torch.tensor(options.corner_margin * interface.reach, device=device).float()
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
        return exact(normalised)

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
        self.actor.keep_corners_away(self._cornerless)
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
