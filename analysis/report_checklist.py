"""What reviewers ask of an empirical study, answered from its data: each item with yes or no, and the number.

The items are those of Eimer et al. (Hyperparameters in Reinforcement Learning and How To Tune Them, checklist) and of Patterson
et al. (Empirical Design in Reinforcement Learning), as far as data can answer them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from analysis.report_facts import Facts, seed_list, span
from analysis.report_warnings import FEWEST_SEEDS, ReportWarning, settings_of_agents
from sweep.messages import counted


@dataclass(frozen=True)
class Item:
    """A question, its answer ("yes", "no" or "does not apply"), and the numbers that it is drawn from."""

    question: str
    answer: str
    numbers: str


def checklist(facts: Facts, warnings: Sequence[ReportWarning], num_exhibits: int) -> list[Item]:
    """Return the items in the order of a paper: design, tuning, results, reproduction."""
    kinds = {warning.kind for warning in warnings}
    return [*_seeds(facts), *_tuning(facts, kinds), *_results(facts, kinds), *_reproduction(facts, num_exhibits)]


def _yes(true: bool, applies: bool = True) -> str:
    return "does not apply" if not applies else "yes" if true else "no"


def _seeds(facts: Facts) -> list[Item]:
    tune, evaluate = facts.seeds.get("tune", []), facts.seeds.get("evaluate", [])
    listed = f"tuning {seed_list(tune) or 'none'}; evaluation {seed_list(evaluate) or 'none'}"
    shown = evaluate or tune
    both = bool(tune and evaluate)
    return [
        Item("Are the seeds of every stage reported?", _yes(True), listed),
        Item(
            "Are evaluation seeds other ones than tuning seeds?",
            _yes(not facts.overlap, both),
            f"{len(facts.overlap):,} in common" if both else "there are no two stages",
        ),
        Item(
            f"Are there at least {FEWEST_SEEDS} seeds behind the results?",
            _yes(len(shown) >= FEWEST_SEEDS),
            counted(len(shown), "evaluation seed" if evaluate else "tuning seed"),
        ),
        Item(
            "Was every setting tuned with more than one seed?", _yes(len(tune) > 1, facts.has_choice), counted(len(tune), "seed")
        ),
    ]


def _tuning(facts: Facts, kinds: set[str]) -> list[Item]:
    by_environment = settings_of_agents(facts)
    numbers = [number for agents in by_environment.values() for number in agents.values()]
    several = any(len(agents) > 1 for agents in by_environment.values())
    steps = [row[name] for row in facts.conditions for name in ("fewest_steps", "most_steps")]
    same_steps = all(row["fewest_steps"] == row["most_steps"] for row in facts.conditions)
    swept = {row["hyperparameter"] for row in facts.hyperparameters if row["is_swept"]}
    edges = sum(1 for row in facts.choices if row["on_edge"])
    return [
        Item("Is the search space reported?", _yes(True), f"{counted(len(swept), 'hyperparameter')} swept"),
        Item(
            "Were agents tuned over equally many settings on each environment?",
            _yes("budgets" not in kinds, several),
            f"{span(numbers)} settings" if numbers else "no setting",
        ),
        Item(
            "Did all runs on an environment learn for equally many steps?",
            _yes(same_steps),
            f"{span(steps)} steps" if steps else "none",
        ),
        Item("Are the chosen settings reported?", _yes(bool(facts.choices)), counted(len(facts.choices), "choice")),
        Item(
            "Do the chosen settings lie within what was swept?",
            _yes(not edges, facts.has_choice and bool(facts.choices)),
            f"{edges:,} of {len(facts.choices):,} on the boundary",
        ),
        Item(
            "Do environments weigh equally in what is chosen across them?",
            _yes(
                "normalizer" not in kinds,
                "across-environments" in facts.by and len(facts.environments) > 1 and bool(facts.spreads),
            ),
            f"normalizer {facts.rules['normalizer']}",
        ),
    ]


def _results(facts: Facts, kinds: set[str]) -> list[Item]:
    planned, done = facts.count("planned"), facts.count("finished") + facts.count("diverged")
    stages = [row["stage"] for row in facts.shown]
    return [
        Item(
            "Are results from runs that had no part in the choice of settings?",
            _yes("tuning-shown" not in kinds and not facts.overlap, bool(stages) and facts.has_choice),
            f"{stages.count('evaluate'):,} of {len(stages):,} chosen settings shown by evaluation runs",
        ),
        Item(
            "Is every run that was planned among the results?",
            _yes(done == planned),
            f"{done:,} of {planned:,}; {facts.count('failed'):,} failed, {facts.count('missing'):,} missing",
        ),
        Item(
            "Do runs that diverged count, by a rule that is declared?",
            _yes(facts.rules["diverged"] == "worst"),
            f"{facts.count('diverged'):,} diverged; rule {facts.rules['diverged']}",
        ),
        Item(
            "Is there more than one environment?",
            _yes(len(facts.environments) > 1),
            counted(len(facts.environments), "environment"),
        ),
    ]


def _reproduction(facts: Facts, num_exhibits: int) -> list[Item]:
    commits, versions = facts.provenance["commit"], facts.provenance["versions"]
    done = bool(facts.totals["trials"])
    clean = len(commits) == 1 and bool(commits[0]["value"]) and not commits[0]["value"].endswith("+dirty")
    return [
        Item("Are all runs of one commit, without local changes?", _yes(clean, done), counted(len(commits), "commit")),
        Item(
            "Were all runs trained with the same versions of libraries?",
            _yes(len(versions) == 1 and versions[0]["value"] is not None, done),
            f"{len(versions):,} sets of versions",
        ),
        Item(
            "Is the cost of computation reported?",
            _yes(done, done),
            f"{facts.totals['agent_steps']:,} environment steps, {facts.totals['core_hours']:,.3g} core-hours",
        ),
        Item(
            "Is there a checksum of the data behind each figure and table?",
            _yes(bool(num_exhibits), bool(num_exhibits)),
            f"{num_exhibits:,} SHA-256",
        ),
    ]
