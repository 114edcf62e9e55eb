"""The methods paragraph of a paper, written from what was planned and trained."""

import math
from collections.abc import Iterator, Sequence

from analysis.report_facts import Facts, seed_list, span
from analysis.report_warnings import settings_of_agents, versions_text
from sweep.messages import counted

_SCORES = {
    "episode_mean": "the mean undiscounted return over its completed episodes",
    "step_mean": "the mean over environment steps of the undiscounted return of the completed episode that the step belongs to",
    "final_mean": "the mean over the last tenth of environment steps of the undiscounted return of the completed episode that "
    "the step belongs to",
}
_NORMALIZERS = {
    "thesis": "N(p) = 1 − (G* − p) / |G*|, where G* is the highest return of a completed episode of any tuning run on the "
    "environment",
    "minmax": "(p − low) / (high − low), where low and high are the lowest and the highest mean score of a setting of any "
    "agent on the environment",
    "percentile": "(p − low) / (high − low), where low and high are the 5th and the 95th percentile of the mean scores "
    "of the settings of all agents on the environment",
    "cdf": "the mean over agents of the share of the agent's tuning runs on the environment with a lower score",
}
_DIVERGED = {
    "worst": "A run whose numbers stopped being finite (diverged) counts as the lowest return of a completed episode of the "
    "tuning runs on its environment",
    "drop": "A run whose numbers stopped being finite (diverged) is left out of the mean of its setting",
}


def methods(facts: Facts, resamples_seed: int) -> str:
    """Return one paragraph of plain text that says how the study was done."""
    sentences = [*_training(facts), *_tuning(facts), *_scoring(facts), *_choosing(facts), *_evaluating(facts)]
    return " ".join([*sentences, *_intervals(facts, resamples_seed), *_effort(facts)])


def _listed(texts: Sequence[str]) -> str:
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}" if texts else "none"


def _training(facts: Facts) -> Iterator[str]:
    steps = span([row[name] for row in facts.conditions for name in ("fewest_steps", "most_steps")])
    cutoffs = [cutoff for row in facts.conditions for cutoff in row["cutoffs"] if cutoff is not None]
    discounts = [discount for row in facts.conditions for discount in row["discounts"] if discount is not None]
    details = [f"episodes were truncated after {span(cutoffs)} steps"] if cutoffs else []
    details += [f"the discount was γ = {span(discounts)}"] if discounts else []
    yield (
        f"We trained {_listed(facts.agents)} on {_listed(facts.environments)} for {steps} environment steps a run"
        + (f"; {' and '.join(details)}" if details else "")
        + "."
    )


def _tuning(facts: Facts) -> Iterator[str]:
    seeds = facts.seeds.get("tune", [])
    if not facts.has_choice:
        yield f"Hyperparameters were not tuned; each agent was run with {counted(len(seeds), 'seed')} ({seed_list(seeds)})."
        return
    yield f"Hyperparameters were tuned by grid search with {counted(len(seeds), 'seed')} ({seed_list(seeds)}) a setting."
    for agent in facts.agents:
        swept = [row for row in facts.hyperparameters if row["agent"] == agent and row["is_swept"]]
        if not swept:
            continue
        numbers = [known[agent] for known in settings_of_agents(facts).values() if agent in known]
        product = math.prod(len(row["values"]) for row in swept)
        form = "" if max(numbers) == product else ", not all combinations"
        values = "; ".join(f"{row['hyperparameter']} ∈ {{{', '.join(map(_short, row['values']))}}}" for row in swept)
        yield f"{agent}: {values} ({span(numbers)} settings an environment{form})."
    fixed: dict[str, set[tuple[str, ...]]] = {}
    for row in facts.hyperparameters:
        fixed.setdefault(row["hyperparameter"], set()).add(tuple(row["values"]))
    same = [
        f"{name} = {_short(next(iter(values))[0])}"
        for name, values in sorted(fixed.items())
        if values == {next(iter(values))[:1]}
    ]
    if same:
        yield f"Every agent that has them used {', '.join(same)}."


def _short(value: str) -> str:
    """Return a number as short as it can be said; a text as it is."""
    try:
        return f"{float(value):g}"
    except ValueError:
        return value


def _scoring(facts: Facts) -> Iterator[str]:
    yield (
        f"The score of a run is {_SCORES[facts.rules['score']]}; the last episode, cut off when the steps of the run were used "
        "up, has no part in it."
    )
    yield f"{_DIVERGED[facts.rules['diverged']]}."


def _choosing(facts: Facts) -> Iterator[str]:
    if not facts.has_choice:
        return
    regimes = {row["by"] for row in facts.choices}
    if "per-environment" in regimes:
        yield (
            "Tuned per environment: for each agent and environment, the setting with the highest mean score over the "
            "tuning seeds."
        )
    if "across-environments" in regimes and len(facts.environments) > 1:
        name = facts.rules["normalizer"]
        yield (
            "Tuned across environments: for each agent, the setting with the highest mean over its environments of the mean "
            f"normalized score, where a score p is normalized as {_NORMALIZERS[name]} ({name} normalizer)."
        )


def _evaluating(facts: Facts) -> Iterator[str]:
    seeds = facts.seeds.get("evaluate", [])
    stages = {row["stage"] for row in facts.shown}
    if seeds:
        apart = (
            "which had no part in the choice"
            if not facts.overlap
            else f"of which {len(facts.overlap):,} had a part in the choice"
        )
        yield f"The chosen settings were trained anew on {counted(len(seeds), 'seed')} ({seed_list(seeds)}), {apart}."
    if stages == {"evaluate"}:
        yield "Performance and learning curves are those of these runs alone; sensitivity is that of the tuning runs."
    elif "tune" in stages and facts.has_choice:
        yield "Performance is that of the tuning runs, which the settings were chosen by, and thus too high."
    yield "All agents and settings were run with the same seeds."


def _intervals(facts: Facts, seed: int) -> Iterator[str]:
    if max((len(seeds) for seeds in facts.seeds.values()), default=0) < 2:
        yield "With one seed there are no intervals."
        return
    yield (
        "Intervals of means over seeds are 95 % Student intervals, bands around learning curves one standard error, unless a "
        f"caption says otherwise; bootstrap intervals and permutation tests draw from random streams with seed {seed}."
    )


def _effort(facts: Facts) -> Iterator[str]:
    done, diverged = facts.totals["trials"], facts.count("diverged")
    left = [f"{facts.count(name):,} {name}" for name in ("failed", "missing") if facts.count(name)]
    yield (
        f"Of {counted(facts.count('planned'), 'planned run')}, {facts.count('finished') + diverged:,} were completed"
        f"{f', {diverged:,} of which diverged' if diverged else ', and none diverged'}"
        f"{f' ({_listed(left)})' if left else ''}."
    )
    if not done:
        return
    machines = _listed([f"{value}" for value in facts.values("device")])
    engines = _listed(facts.values("engine"))
    yield (
        f"They took {facts.totals['agent_steps']:,} environment steps and {facts.totals['core_hours']:,.3g} core-hours"
        + (f" on {machines}" if machines != "none" else "")
        + (f" (engine {engines})" if engines != "none" else "")
        + "."
    )
    versions = [versions_text(value) for value in facts.values("versions")]
    commits = facts.values("commit")
    if versions:
        yield f"Software: {'; '.join(versions)}{f'; commit {_listed(commits)}' if commits else ''}."
