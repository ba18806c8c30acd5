"""`controllers theory`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from controllers.commands.shared import ChosenPlant, Json, PolicyFile, emit, errors

if TYPE_CHECKING:
    from controllers.evaluation.theory_constants import Constant, Theory


def theory(
    context: typer.Context,
    policy: PolicyFile,
    system: ChosenPlant = None,
    certificate: Annotated[
        Path | None, typer.Option(help="A certificate of this policy: bounds the change of the gain that its P allows.")
    ] = None,
    states: Annotated[int, typer.Option(help="Number of initial states of the estimate of a_V.")] = 200,
    seed: Annotated[int, typer.Option(help="Seed of the initial states.")] = 0,
    as_json: Json = False,
) -> None:
    """Show the constants on which the theory of the method rests, each proved or estimated, for one policy."""
    with errors(context, as_json):
        from certify.certificates.membership import proved_set
        from certify.loop.policies import load_policy
        from controllers.evaluation.theory_constants import theory as constants_of
        from controllers.plants.choice import chosen_plant

        stored, chosen = load_policy(policy), None if system is None else chosen_plant(system)
        proved = None if certificate is None else proved_set(certificate)
        result = constants_of(stored, chosen, proved, states, seed)
        emit(result.as_json() if as_json else _table(result), as_json)


def _table(result: Theory) -> dict[str, Any]:
    rows: dict[str, Any] = {"system": result.system, "sha256": result.sha256}
    rows |= {constant.name: _shown(constant) for constant in result.constants}
    rows["discount"] = _discount(result)
    rows["gain"] = _gain(result)
    return rows


def _shown(constant: Constant) -> str:
    if constant.value is None:
        return f"none  {constant.by}"
    return f"{constant.relation} {_digits(constant, constant.value)}  {constant.how}: {constant.by}"


def _digits(constant: Constant, value: float) -> str:
    """The digits of a bound are a bound too: rounded away from the true constant."""
    from certify.report.words import above, below

    return above(value) if constant.relation == "<=" else below(value) if constant.relation == ">=" else f"{value:g}"


def _discount(result: Theory) -> str:
    """The discount beside its bounds; a sampled one may take a proved word back, and never gives one."""
    gamma = result["gamma"].value or 0.0
    names = ("gamma_star", "gamma_star_at_gamma", "gamma_star_sampled")
    star, at_gamma, sampled = (result[name].value for name in names)
    if at_gamma is None or gamma <= at_gamma:
        return f"{gamma:g} is not shown to be above gamma*: this theory says nothing of the run"
    if star is None or gamma <= star:
        return f"{gamma:g} is above gamma* at gamma (proved, linear part), not above that for every discount"
    if sampled is None or gamma <= sampled:
        return f"{gamma:g} is above gamma* (proved, linear part), not above that of the simulated states"
    return f"{gamma:g} is above gamma* (proved, linear part), and above that of the simulated states"


def _gain(result: Theory) -> str:
    distance = result["distance"].value
    if distance is None:
        return "there is no gain to compare with"
    allowed = {name: result[name].value for name in ("epsilon_K", "epsilon_K_held")}
    within = [name for name, value in allowed.items() if value is not None and distance <= value]
    if not within:
        return "||J_mu(0) + K|| is not shown to be within epsilon_K"
    return f"||J_mu(0) + K|| is within {' and '.join(within)} (proved)"
