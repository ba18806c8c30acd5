"""Training for proof: a policy that does the same and is easier to prove, from one that is there.

The size of a proof is decided when the policy is trained: bounds see every hidden unit's bend, whether the closed loop
needs it or not. Flattening lowers

    fit + GAIN * gain + weight * departure

where fit is the mean squared change of the input on states that the closed loops of both policies visit, relative to
the mean square of the inputs, gain that of the Jacobian at 0, and `departure` is what bounds see of the hidden units on
a box. Without the gain's term a policy that must be flat copies the old inputs far out by smaller gains at the origin,
where what is proved begins: it then costs more and is harder to prove, both. First the best of the
policies between the old one and its linearisation is taken (`contraction`), then Adam goes on from there; both have to
stay within bounds on what counts, the settled share and the median cost of simulated runs, and the best iterate that
does is the result. It has the same layers, squash, centring, scale, offset and clip, and what enters the squash at the
origin is what did.

A policy whose gain at the origin is the trouble is another matter: bounds cannot be large where the loop saturates at a
hundredth of its box. With `gain` "lqr" the policy to be copied is the old one with the gain that minimises the
judged cost near the origin (`gain`), and the bounds are still those of the old one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from certify.errors import InputError
from certify.loop.plants import System, shipped_system
from certify.loop.policies import Policy, TanhNetwork, require_centred
from controllers.contraction import contracted, with_value_at_origin
from controllers.departure import departure, departure_of, linearised
from controllers.evaluate import MONITORING, curvature, discrete_linearisation, settle
from controllers.gain import regained
from controllers.lqr import riccati_gain
from controllers.options import Plant, get_plant, held_over
from controllers.simulation import held_loop, initial_states, mean_action

Array = NDArray[np.float64]
Ended = Literal["steps", "time limit"]
Gain = Literal["kept", "lqr"]

FACTORS = tuple(2.0**-k for k in range(7))
"""Contractions that are tried: powers of two, which round no weight. Beyond the last one nothing is left to gain."""

GAIN = 100.0
"""Weight of the Jacobian's change at 0 beside the fit: one per cent of it counts like inputs that are off by ten."""

CHECKS = 8
"""How often the iterate is judged by simulation while Adam runs; as often the states that it visits are added."""

_RUNS, _EVERY = 64, 10  # runs that give states to fit on, of which every tenth state is taken, in discrete time each
_NEAR = 1e-12  # relative: below it a mean square counts as zero


@dataclass(frozen=True, slots=True, kw_only=True)
class FlattenOptions:
    """What a run of `flatten` may choose.

    Parameters
    ----------
    weight : of the departure beside the fit; 1 says that hidden units which could add as much as the linear part count
        like an input that is off by as much as it is large.
    box : half-widths (n,) of the box on which the departure is taken; None means the plant's box of initial states.
    steps, batch, rate : gradient steps, states in each, and the first step of Adam relative to a layer's weights.
    time_limit : seconds after which no more gradient steps are taken, those before them included.
    max_cost_change : bound on the relative rise of the median cost; a fall is no harm.
    states : initial states of the runs that judge a policy.
    gain : the Jacobian at 0 that is aimed at: `kept` is the policy's own, `lqr` that of the LQR at the time step of the
        runs that judge, in discrete time the plant's own.
    Q, R : diagonals (n,) and (m,) of the LQR's weights, for `gain` "lqr"; None means those of the runs that judge.
    seed, threads : of everything random; of torch.

    Raises
    ------
    InputError : a number is out of its range; the message names it.
    """

    weight: float = 1.0
    box: tuple[float, ...] | None = None
    steps: int = 2000
    batch: int = 512
    rate: float = 0.01
    time_limit: float = 180.0
    max_cost_change: float = 0.05
    states: int = 200
    gain: Gain = "kept"
    Q: tuple[float, ...] | None = None
    R: tuple[float, ...] | None = None
    seed: int = 0
    threads: int = 1

    def __post_init__(self) -> None:
        for name in ("weight", "batch", "rate", "time_limit", "states", "threads"):
            self._require(name, 0 < getattr(self, name) < math.inf, "positive and finite")
        for name in ("steps", "max_cost_change"):
            self._require(name, 0 <= getattr(self, name) < math.inf, "at least 0 and finite")
        self._require("seed", 0 <= self.seed < 2**63, "at least 0 and below 2^63")
        self._require("gain", self.gain in get_args(Gain), f"one of {get_args(Gain)}")
        if self.box is not None:
            self._require("box", all(0 < width < math.inf for width in self.box), "positive and finite half-widths")
        for name, weights in (("Q", self.Q), ("R", self.R)):
            if weights is not None:
                self._require(name, all(0 < weight < math.inf for weight in weights), "positive and finite weights")
                self._require(name, self.gain == "lqr", 'left out unless `gain` is "lqr", whose weights these are')

    def _require(self, name: str, holds: bool, requirement: str) -> None:
        if not holds:
            raise InputError(f"`{name}` must be {requirement}; found {getattr(self, name)!r}.")


@dataclass(frozen=True, slots=True)
class Figures:
    """One policy before or after: `departure` is what the hidden units may add, `bend` what they add on the box.

    `bend` is the root mean square of net(x) - net(0) - J x over states of the box, relative to that of J x; settled,
    states and cost are those of runs with the action held, and cost is infinite where half of the runs diverge.
    """

    departure: float
    bend: float
    settled: int
    states: int
    cost: float


@dataclass(frozen=True, slots=True)
class Flattened:
    """The result: the policy, what it was and is, and how much the input changed on the states that were visited.

    `rms` and `largest` are (m,), in the input's units, over the states that both closed loops visit; `gain_change` is
    the Jacobian's change at 0 on the box, relative to what it was; `factor` is the contraction that training began
    with.
    """

    policy: Policy
    before: Figures
    after: Figures
    rms: tuple[float, ...]
    largest: tuple[float, ...]
    gain_change: float
    factor: float
    steps: int
    ended: Ended
    seconds: float

    def as_json(self) -> dict[str, Any]:
        """Plain values; what is not finite becomes None."""

        def figures(found: Figures) -> dict[str, Any]:
            return {name: _finite(value) for name, value in asdict(found).items()}

        return {
            "system": self.policy.system,
            "sha256": self.policy.network.sha256(),
            "layers": list(self.policy.network.layers),
            "before": figures(self.before),
            "after": figures(self.after),
            "cost_change": _finite(self.after.cost / self.before.cost - 1) if self.before.cost else None,
            "input_change": {"rms": list(self.rms), "max": list(self.largest)},
            "gain_change": self.gain_change,
            "factor": self.factor,
            "steps": self.steps,
            "ended": self.ended,
            "seconds": {"total": self.seconds},
        }


def flatten(
    policy: Policy,
    options: FlattenOptions | None = None,
    own: tuple[System, Plant] | None = None,
    report: Callable[[int, float, float], None] | None = None,
) -> Flattened:
    """A policy that does what `policy` does and is easier to prove.

    Parameters
    ----------
    own : the plant and how it is judged, where it is not the one that ships under the policy's name.
    report : called as training goes with the steps done, the fit and the departure.

    Raises
    ------
    InputError : policy, box and plant do not fit each other; the policy has no hidden units; its closed loop has no
        finite cost to compare with; there is no LQR gain, or the policy cannot have it, where that is asked for; or no
        iterate has a lower departure within the bounds.
    """
    options = options or FlattenOptions()
    torch.set_num_threads(options.threads)
    run = _Run(policy, options, own)
    return run.flattened(report)


class _Run:
    """One run: the old policy, the goal that is copied, the states visited so far, the best iterate in the bounds."""

    def __init__(self, policy: Policy, options: FlattenOptions, own: tuple[System, Plant] | None) -> None:
        self.began = time.monotonic()
        self.policy, self.options = policy, options
        if own is None:
            self.system = shipped_system(policy.system).with_parameters(policy.parameters)
            self.plant = get_plant(policy.system)
        else:
            self.system, self.plant = own
        self.plant.check(self.system)
        self.old = policy.network
        self._require_sizes()
        self.u_eq = self.system.exact_u_eq()
        self.dt, self.Q, self.R = self._judge()
        self.box = np.array(options.box if options.box is not None else self.plant.initial_states)
        self.old_J = self.old.jacobian_at_origin(self.u_eq)
        self.K = None if options.gain == "kept" else self._lqr_gain()
        self.goal = self.old if self.K is None else regained(self.old, self.u_eq, -self.K, self.box)
        self.folded = self.goal.folded(self.u_eq)
        self.value = np.asarray(self.folded.net(np.zeros(self.system.n)))  # what enters the squash at the origin
        self.exactly_centred = self._is_exact()
        self.generator = torch.Generator().manual_seed(options.seed)
        self.x0 = initial_states(self.system, _RUNS, options.seed, self.plant)
        self.states = self.first = self._visited(self.goal)
        self.scale_of_inputs = self._size_of_inputs()
        self.J = self.goal.jacobian_at_origin(self.u_eq)
        self.before = self._figures(self.old)
        if not math.isfinite(self.before.cost):
            raise InputError(
                f"the policy must have a finite median cost to compare with; half of {options.states} runs of "
                f"{self.system.name} or more diverge. Choose smaller `initial_states`, or train it further."
            )
        self.best: tuple[TanhNetwork, Figures] | None = None
        self.objective = math.inf

    def flattened(self, report: Callable[[int, float, float], None] | None) -> Flattened:
        factor, network = self._contracted()
        steps, ended = self._train(network, report)
        if self.best is None:
            raise InputError(
                f"no policy within the bounds is easier to prove: as many of {self.before.states} runs must settle as "
                f"before, {self.before.settled}, and the median cost may rise from {self.before.cost:.4g} by "
                f"{100 * self.options.max_cost_change:g} % at most. Nothing is written. Allow more with "
                "--max-cost-change, or ask for less with a smaller --weight."
            )
        network, after = self.best
        states = self.states if self.goal is self.old else np.concatenate([self.states, self._visited(self.old)])
        change = self._actions(network, states) - self._actions(self.old, states)
        return Flattened(
            policy=replace(self.policy, network=network, training=self._record(network, after, factor, steps)),
            before=self.before,
            after=after,
            rms=tuple(np.sqrt((change**2).mean(axis=0)).tolist()),
            largest=tuple(np.abs(change).max(axis=0).tolist()),
            gain_change=self._gain_change(network, self.old_J),
            factor=factor,
            steps=steps,
            ended=ended,
            seconds=time.monotonic() - self.began,
        )

    def _contracted(self) -> tuple[float, TanhNetwork]:
        """The best contraction within the bounds; the goal itself if there is none."""
        candidates = [contracted(self.goal, factor) for factor in FACTORS]
        ranked = sorted(range(len(FACTORS)), key=lambda k: self._objective(candidates[k]))
        for k in ranked:
            as_it_was = k == 0 and self.goal is self.old  # no result, though rounded to float32 it may look flatter
            if as_it_was or self._keep(candidates[k]):
                return FACTORS[k], candidates[k]
        return FACTORS[0], candidates[0]

    def _train(self, start: TanhNetwork, report: Callable[[int, float, float], None] | None) -> tuple[int, Ended]:
        """Gradient steps from `start`; what is judged on the way and is within the bounds is kept if it is better."""
        options, every = self.options, max(1, self.options.steps // CHECKS)
        student = _Student(start, self.value, self.folded, trains_biases=not self.exactly_centred)
        groups = student.groups(self.states, options.rate)
        optimiser = torch.optim.Adam(groups)
        rates = [group["lr"] for group in groups]
        box = torch.from_numpy(self.box)
        J, size = torch.from_numpy(self.J * self.box), torch.from_numpy(self.scale_of_inputs).float()
        largest = J.square().sum().clamp_min(_NEAR)
        slope = torch.from_numpy(self._slope())
        self._add(self._visited(start))
        states, wanted = self._data()
        for step in range(options.steps):
            if time.monotonic() - self.began > options.time_limit:
                if step % every:  # not judged yet
                    self._keep(self._exported(student))
                return step, "time limit"
            for group, rate in zip(groups, rates, strict=True):
                group["lr"] = rate * (1 - step / options.steps)
            rows = torch.randint(len(states), (options.batch,), generator=self.generator)
            change = (student(states[rows]) - wanted[rows]) / size
            fit = change.square().sum(1).mean()
            gain = ((slope[:, None] * student.jacobian()) * box - J).square().sum() / largest
            bends = departure(student.weights, student.biases, box)
            loss = fit + GAIN * gain + options.weight * bends
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            if report is not None:
                report(step + 1, fit.item(), bends.item())
            if (step + 1) % every == 0 or step + 1 == options.steps:
                network = self._exported(student)
                self._keep(network)
                self._add(self._visited(network))
                states, wanted = self._data()
        return options.steps, "steps"

    def _keep(self, network: TanhNetwork) -> bool:
        """Whether a policy is within the bounds and flatter; the best of them so far is remembered."""
        if not all(np.all(np.isfinite(a)) for a in (*network.weights, *network.biases)):
            return False
        objective = self._objective(network)
        if self.best is not None and objective >= self.objective:
            return False
        figures = self._figures(network)
        allowed = (1 + self.options.max_cost_change) * self.before.cost
        if not (
            figures.departure < self.before.departure
            and figures.settled >= self.before.settled
            and figures.cost <= allowed
        ):
            return False
        if self.exactly_centred and self.old.centre == "none":
            require_centred(network, self.u_eq)
        self.best, self.objective = (network, figures), objective
        return True

    def _objective(self, network: TanhNetwork) -> float:
        """What training lowers, in double precision, on the states that the goal visits: the same for all."""
        change = (self._actions(network, self.first) - self._actions(self.goal, self.first)) / self.scale_of_inputs
        fit = float((change**2).sum(axis=1).mean())
        gain = self._gain_change(network, self.J) ** 2
        return fit + GAIN * gain + self.options.weight * departure_of(network, self.box.tolist())

    def _gain_change(self, network: TanhNetwork, J: Array) -> float:
        size = max(float(np.linalg.norm(J * self.box)), _NEAR)
        return float(np.linalg.norm((network.jacobian_at_origin(self.u_eq) - J) * self.box)) / size

    def _lqr_gain(self) -> Array:
        """K (m, n) of `u = u_eq - K x`, for the plant's linearisation at the time step of the runs that judge."""
        Q, R = self._lqr_weights()
        return riccati_gain(*discrete_linearisation(self.system, self.dt), np.diag(Q), np.diag(R))

    def _lqr_weights(self) -> tuple[Array, Array]:
        asked = zip((self.options.Q, self.options.R), (self.Q, self.R), strict=True)
        Q, R = (judging if given is None else np.array(given) for given, judging in asked)
        if (len(Q), len(R)) != (self.system.n, self.system.m):
            raise InputError(
                f"`Q` and `R` must have {self.system.n} and {self.system.m} weights for {self.system.name}; "
                f"found {len(Q)} and {len(R)}."
            )
        if not np.all(R > 0):
            raise InputError(
                f"the LQR gain needs input weights that are positive; the policy's record says {R.tolist()}. Give "
                "others with --R, or keep the policy's own gain."
            )
        return Q, R

    def _figures(self, network: TanhNetwork) -> Figures:
        judged = replace(MONITORING, states=self.options.states, seed=self.options.seed)
        found = settle(network, self.system, self.dt, self.Q, self.R, judged, self.plant)
        return Figures(
            departure=departure_of(network, self.box.tolist()),
            bend=bend(network, self.box),
            settled=found.settled,
            states=found.states,
            cost=found.cost,
        )

    def _visited(self, network: TanhNetwork) -> Array:
        """States (N, n) on the way from the box of initial states, over an episode's horizon, inside the domain."""
        loop = held_loop(self.system, self.dt, mean_action(network, self.system), self.Q, self.R)
        preset, every = self.plant.preset, 1 if self.system.time == "discrete" else _EVERY
        runs = loop.run(self.x0, preset.horizon * preset.dt)
        found = [x for k, (x, _) in enumerate(runs) if k % every == 0]
        states = np.concatenate(found)
        lo, hi = np.array(self.system.domain, dtype=np.float64).T
        return np.asarray(states[((states >= lo) & (states <= hi)).all(axis=1)])  # NaN, a run that diverged, is not

    def _add(self, states: Array) -> None:
        self.states = np.concatenate([self.states, states])

    def _data(self) -> tuple[Tensor, Tensor]:
        """The states visited so far and the goal's inputs there, in single precision."""
        return torch.from_numpy(self.states).float(), torch.from_numpy(self._actions(self.goal, self.states)).float()

    def _actions(self, network: TanhNetwork, states: Array) -> Array:
        return mean_action(network, self.system)(states)

    def _size_of_inputs(self) -> Array:
        """Root mean square (m,) of the goal's deviations from u(0): one share of each input's scale for all."""
        at_0 = self._actions(self.goal, np.zeros((1, self.system.n)))
        relative = (self._actions(self.goal, self.states) - at_0) / np.abs(self.goal.scale)
        mean = float((relative**2).sum(axis=1).mean())
        if not mean > _NEAR:
            raise InputError(
                "the policy must act on the states from its box of initial states; its inputs never leave u(0) there."
            )
        return np.asarray(math.sqrt(mean) * np.abs(self.goal.scale))

    def _slope(self) -> Array:
        """d u / d net (m,) at the origin."""
        squashed = self.folded.squashed(self.value)
        return np.asarray(self.folded.scale * self.folded.squash_slope(squashed) * np.ones(self.system.m))

    def _exported(self, student: _Student) -> TanhNetwork:
        weights, biases = (
            tuple(p.detach().double().numpy() for p in parameters) for parameters in (student.weights, student.biases)
        )
        network = replace(self.old, weights=weights, biases=biases)
        return with_value_at_origin(network, np.asarray(self.old.net(np.zeros(self.system.n))))

    def _record(self, network: TanhNetwork, after: Figures, factor: float, steps: int) -> Mapping[str, Any]:
        """The old record, with what changed since: how it was flattened, from which policy, with which figures."""
        record = dict(self.policy.training)
        if self.K is not None and "K" in record:
            record["K"] = self.K.tolist()
        if "K" in record:
            record["distance"] = float(np.linalg.norm(network.jacobian_at_origin(self.u_eq) + np.asarray(record["K"])))
        if "curvature" in record and isinstance(record.get("eta"), float):
            record["curvature"] = curvature(network, self.system, record["eta"])
        options = self.options
        record["flattened"] = {
            "sha256": self.old.sha256(),
            "gain": options.gain,
            "weight": options.weight,
            "box": self.box.tolist(),
            "steps": steps,
            "batch": options.batch,
            "rate": options.rate,
            "seed": options.seed,
            "max_cost_change": options.max_cost_change,
            "factor": factor,
            "departure": [self.before.departure, after.departure],
            "cost": [self.before.cost, after.cost],
        }
        if self.K is not None:
            Q, R = self._lqr_weights()
            record["flattened"] |= {"K": self.K.tolist(), "Q": Q.tolist(), "R": R.tolist()}
        return record

    def _judge(self) -> tuple[float, Array, Array]:
        """dt, Q and R of the runs that judge: the policy's record, and the plant's preset where it has none.

        dt is one over which the plant holds its inputs, in discrete time 1.
        """
        preset, record = self.plant.preset, self.policy.training
        wanted = (("dt", ()), ("state_weights", (self.system.n,)), ("input_weights", (self.system.m,)))
        found = []
        for name, shape in wanted:
            try:
                value = np.array(record.get(name, getattr(preset, name)), dtype=np.float64)
            except (TypeError, ValueError) as error:
                raise InputError(f"`training.{name}` of the policy must hold numbers.") from error
            if value.shape != shape or not np.all(np.isfinite(value)) or np.any(value < 0):
                raise InputError(f"`training.{name}` must hold finite numbers of shape {shape}, none of them negative.")
            found.append(value)
        dt = float(found[0])
        if not dt > 0:
            raise InputError(f"`training.dt` of the policy must be positive; found {dt}.")
        return held_over(self.system, dt), found[1], found[2]

    def _require_sizes(self) -> None:
        network, system, box = self.old, self.system, self.options.box
        if (network.n, network.m) != (system.n, system.m):
            raise InputError(
                f"the policy must map {system.n} states to {system.m} inputs for {system.name}; "
                f"it maps {network.n} to {network.m}."
            )
        if len(network.weights) < 2:
            raise InputError("a policy to flatten must have hidden units; this one is a single layer, already flat.")
        if box is not None and len(box) != system.n:
            raise InputError(f"`box` must have {system.n} half-widths for {system.name}; found {len(box)}.")

    def _is_exact(self) -> bool:
        """Whether pi(0) = u_eq rests on the biases' own numbers, which must then stay as they are."""
        if self.old.centre != "none":
            return False
        try:
            require_centred(self.old, self.u_eq)
        except InputError:
            return False
        return True


class _Student(torch.nn.Module):
    """The policy as it is trained: float32, `scale * squash(net(x) - net(0) + value) + offset`, then the clip."""

    def __init__(self, start: TanhNetwork, value: Array, folded: TanhNetwork, trains_biases: bool) -> None:
        super().__init__()
        self._weights = torch.nn.ParameterList(torch.tensor(W, dtype=torch.float32) for W in start.weights)
        self._biases = torch.nn.ParameterList(
            torch.nn.Parameter(torch.tensor(b, dtype=torch.float32), requires_grad=trains_biases) for b in start.biases
        )
        self.value, self.scale, self.offset = (
            torch.tensor(a, dtype=torch.float32) for a in (value, folded.scale, folded.offset)
        )
        self.folded = folded
        self.n = start.n

    @property
    def weights(self) -> list[Tensor]:
        return list(self._weights)

    @property
    def biases(self) -> list[Tensor]:
        return list(self._biases)

    def forward(self, x: Tensor) -> Tensor:
        """Inputs (batch, m) at states (batch, n)."""
        h = torch.cat([x, x.new_zeros(1, self.n)])
        for k, (W, b) in enumerate(zip(self._weights, self._biases, strict=True)):
            h = torch.addmm(b, torch.tanh(h) if k else h, W.T)
        y = self.folded.squashed(h[:-1] - h[-1] + self.value)
        u: Tensor = self.folded.clipped(self.scale * y + self.offset)
        return u

    def jacobian(self) -> Tensor:
        """The Jacobian (m, n) of net at the origin, in float64."""
        return linearised([W.double() for W in self._weights], [b.double() for b in self._biases]).jacobians[-1]

    def groups(self, states: Array, rate: float) -> list[dict[str, Any]]:
        """Parameters with their first steps: a share of a layer's weights, and of the values that a bias is added to.

        Layers differ by the contraction's factor, on purpose, so one step for all would tear down the first one.
        """
        groups: list[dict[str, Any]] = []
        h = torch.from_numpy(states).float()
        with torch.no_grad():
            for k, (W, b) in enumerate(zip(self._weights, self._biases, strict=True)):
                h = torch.addmm(b, torch.tanh(h) if k else h, W.T)
                groups.append({"params": [W], "lr": rate * _size(W)})
                if b.requires_grad:
                    groups.append({"params": [b], "lr": rate * _size(h)})
        return groups


def bend(network: TanhNetwork, box: Sequence[float] | Array, states: int = 1000) -> float:
    """Root mean square of net(x) - net(0) - J x, J its Jacobian at 0, over that of J x, for states uniform in a box.

    What `departure` adds up for each unit apart, as it is in sum; the same states in every call.

    Parameters
    ----------
    box : half-widths (n,), in the states' units.
    """
    half_widths = np.asarray(box, dtype=np.float64)
    x = np.random.default_rng(0).uniform(-half_widths, half_widths, (states, network.n))
    affine = TanhNetwork(network.weights, network.biases, np.ones(network.m), np.zeros(network.m), "identity", "none")
    J = affine.jacobian_at_origin(())
    linear = x @ J.T
    rest = affine.net(x) - affine.net(np.zeros(network.n)) - linear
    size = float(np.sqrt((linear**2).mean()))
    return float(np.sqrt((rest**2).mean())) / size if size > 0 else math.inf


def _size(tensor: Tensor) -> float:
    return float(tensor.square().mean().sqrt())


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
