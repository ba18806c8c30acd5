"""`controllers evaluate`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from controllers.commands.shared import ChosenPlant, Json, PolicyFile, beside_a_gain, emit, errors, span

if TYPE_CHECKING:
    from controllers.evaluation.evaluation import Evaluation
    from controllers.evaluation.proved_set import Covered
    from controllers.evaluation.settling import EvaluationOptions, Settling


def evaluate(
    context: typer.Context,
    policy: PolicyFile,
    states: Annotated[int, typer.Option(help="Number of initial states.")] = 1000,
    seed: Annotated[int, typer.Option(help="Seed of the initial states.")] = 0,
    duration: Annotated[
        float | None, typer.Option(help="Seconds simulated, or steps in discrete time; default: 60 s or 3000 steps.")
    ] = None,
    system: ChosenPlant = None,
    certificate: Annotated[
        Path | None, typer.Option(help="A certificate of this policy: counts the states in its proved set.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Simulate a policy from random initial states and compare it with its learned gain."""
    with errors(context, as_json):
        from certify.certificates.membership import proved_set
        from certify.loop.policies import load_policy
        from controllers.evaluation.evaluation import evaluate as judge
        from controllers.evaluation.settling import EvaluationOptions
        from controllers.plants.choice import chosen_plant, plant_of

        stored = load_policy(policy)
        chosen = plant_of(stored, None if system is None else chosen_plant(system))
        options = EvaluationOptions(states=states, seed=seed, **span(duration, chosen[0]))
        proved = None if certificate is None else proved_set(certificate)
        result = judge(stored, options, chosen, proved)
        emit(result.as_json() if as_json else _table(result, options), as_json)


def _table(result: Evaluation, options: EvaluationOptions) -> dict[str, Any]:
    def settling(s: Settling) -> str:
        span = f"{options.duration_steps} steps" if result.time == "discrete" else f"step {s.step:.4g} s"
        return (
            f"{s.settled} of {s.states} settled ({span}), {s.left_domain} left the domain, "
            f"largest final norm {s.largest:.1e}, median cost {s.cost:.4g}"
        )

    errors = (result.A_relative_error, result.B_relative_error, result.K_relative_error)
    A_error, B_error, K_error = ("?" if math.isnan(error) else f"{100 * error:.2g} %" for error in errors)
    covered = result.covered
    learned = not math.isnan(result.gain_relative)
    eigenvalues = ", ".join(f"{e:.4g}" for e in result.eigenvalues)
    if result.continuous is None:
        largest = max(map(abs, result.eigenvalues))
        stable = "below 1: stable" if largest < 1 else "not below 1: not stable"
        runs = {
            "eigenvalues": f"{eigenvalues} of a step; largest modulus {largest:.4g}, {stable}",
            "step by step": settling(result.held),
        }
    else:
        runs = {
            "eigenvalues": eigenvalues,
            "continuous": settling(result.continuous),
            "held": settling(result.held),
        }
    return {
        "system": result.system,
        "sha256": result.sha256,
        "||J+K||/||K||": f"{100 * result.gain_relative:.3g} %" if learned else None,
        "learned A, B, K": f"off by {A_error}, {B_error} and {K_error}" if learned else None,
        "curvature": None if math.isnan(result.curvature) else f"{result.curvature:.4g}",
        "linear part": None if result.nonlinearity is None else beside_a_gain(result.nonlinearity),
        **({} if math.isinf(result.corner) else {"nearest corner": f"at {result.corner:.3g} of the domain"}),
        **runs,
    } | ({} if covered is None else {"in the proved set": _share(covered)})


def _share(covered: Covered) -> str:
    return (
        f"{covered.inside} of {covered.states} initial states ({100 * covered.inside / covered.states:.3g} %), "
        f"claim {covered.claim}"
    )
