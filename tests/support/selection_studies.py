"""Studies to choose settings in, and scores of their trials that need no training."""

from sweep.grid import parse
from sweep.selection import TrialScores
from sweep.trials import expand

STUDY = """
[study]
name = "study"
environments = [{environments}]
steps = 1000
[seeds]
tune = {tune}
[select]
{select}
"""
SAC = '[[agent]]\nname = "SAC"\nsweep = { critic_step_size = [0.1, 0.01, 0.001] }\n'
GREEDY = '[[agent]]\nname = "GreedyAC"\nsweep = { critic_step_size = [0.1, 0.01], entropy_scale = [0.1, 1.0, 10.0] }\n'


def grid(agents, *environments, tune=2, select=""):
    head = STUDY.format(environments=", ".join(f'"{name}"' for name in environments), tune=tune, select=select)
    return parse(head + agents, "grid.toml")


def score(study, returns, best=None, **changes):
    """Scores of all tuning trials: `returns(trial)` gives a number, None (no completed episode), "diverged" or "missing"."""
    scores = {}
    for trial in expand(study):
        value = returns(trial)
        if value == "missing":
            continue
        best_here = best(trial) if best else 1000.0
        diverged = value == "diverged"
        scores[trial.id] = TrialScores("diverged" if diverged else "finished", None if diverged else value, best_here)
    return scores


def winners(selection, by="per-environment", name="critic_step_size"):
    return {choice.environment: getattr(choice.hypers, name) for choice in selection if choice.by == by}
