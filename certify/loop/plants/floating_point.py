"""A plant's equations in floating point, for simulation and search: nothing is proved with them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from certify.errors import InputError
from certify.loop.expressions import Expression, Symbol, numerical
from certify.loop.expressions.numerical import Module
from certify.loop.plants.ode import rk4_step

if TYPE_CHECKING:
    from certify.loop.plants.system import System

_SUBSTEPS = 2  # of a sampling period, in simulation


def function_of(
    system: System, expressions: Sequence[Expression], more: Sequence[Symbol], module: Module
) -> Callable[[Any, Any, Sequence[Any]], Any]:
    """Equations over states, inputs and `more`, as a function of arrays x (..., n), u (..., m) and values of `more`."""
    stack: Any
    broadcast: Any
    number: Callable[[Any, Any], Any]
    if module == "numpy":
        stack, broadcast, number = np.stack, np.broadcast_arrays, _as_it_is
    elif module == "torch":
        import torch

        stack, broadcast, number = torch.stack, torch.broadcast_tensors, _as_tensor
    else:
        raise InputError(f"`module` must be 'numpy' or 'torch'; found {module!r}.")
    raw = numerical(expressions, [*system.states, *system.inputs, *more], module)
    n, m = system.n, system.m

    def f(x: Any, u: Any, values: Sequence[Any]) -> Any:
        columns: list[Any] = [x[..., i] for i in range(n)] + [u[..., j] for j in range(m)]
        zero = 0.0 * (columns[0] + columns[n])  # constant components take the batch's shape
        held = [number(value, x) for value in values]
        return stack(tuple(broadcast(*[value + zero for value in raw(*columns, *held)])), -1)

    return f


def mean_rate(system: System, f: Callable[[Any, Any], Any], x: Any, u: Any, step: Any) -> Any:
    """G (..., n) of `x+ = x + h G` in floating point, from this plant's f, with the input held over the step h.

    f itself where h is the number 0; in discrete time h = 1 and G = f - x; else h may be an array (..., 1) of
    positive numbers.
    """
    if system.time == "discrete":
        return f(x, u) - x
    if isinstance(step, float | int) and step == 0:
        return f(x, u)
    after = x
    for _ in range(_SUBSTEPS):
        after = rk4_step(lambda y: f(y, u), after, step / _SUBSTEPS)
    return (after - x) / step


def _as_it_is(value: Any, _: Any) -> Any:
    return value


def _as_tensor(value: Any, like: Any) -> Any:
    """A number as a tensor: torch has no power, and no function, of a plain one."""
    import torch

    return torch.as_tensor(value, dtype=like.dtype, device=like.device)
