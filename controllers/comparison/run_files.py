"""The files in the folder of a trained run, `<runs>/<kind>/seed-<k>/`.

`curve.csv` has a row for each evaluation; `checkpoint.pt` is there from the beginning of a run until it is over, then
`course.json`, which gives its plan and the reason of its end. `policy.pt` is the mean action as `controllers train`
writes it; beside it lie in `sac` the whole actor, `actor.pt`, and in `sb3-sac` and `sb3-ppo` the library's own file,
`model.zip`.
"""

from __future__ import annotations

from pathlib import Path

from controllers.comparison.methods import Run
from controllers.options import TrainingOptions

CURVE, CHECKPOINT, ENDED = "curve.csv", "checkpoint.pt", "course.json"
POLICY, ACTOR, MODEL = "policy.pt", "actor.pt", "model.zip"

POLICY_FILES: dict[Run, str] = {
    "ours": POLICY,
    "sac": ACTOR,
    "before": POLICY,
    "uncentred": POLICY,
    "sb3-sac": MODEL,
    "sb3-ppo": MODEL,
}
"""The file from which the policy of a kind of run is read."""


def run_folder(runs: Path, run: Run, training: TrainingOptions) -> Path:
    """The folder of a run among `runs`."""
    return runs / run / f"seed-{training.seed}"


def files_of(run: Run) -> tuple[str, ...]:
    """The files of a run that is over; the one that says so comes last."""
    return tuple(dict.fromkeys((POLICY_FILES[run], POLICY, CURVE, ENDED)))
