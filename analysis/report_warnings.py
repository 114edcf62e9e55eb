"""What a reader of a study has to be warned of, from what is known of it: each warning with its numbers."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from analysis.report_facts import Facts, Rows, span
from sweep.messages import counted

FEWEST_SEEDS = 10
"""Below this many runs, bootstrap intervals cover clearly less than they promise."""

UNEQUAL = 2.0
"""A normalizer weighs environments unequally if the spread of its scores differs by more than this factor."""

#: Kind of warning → its heading, the gravest first.
KINDS = {
    "no-runs": "No run is finished",
    "seeds-overlap": "Evaluation seeds are tuning seeds",
    "tuning-shown": "Tuning runs are shown as performance",
    "failed": "Trials failed",
    "missing": "Trials are missing",
    "diverged": "Runs diverged",
    "no-score": "Runs without a score",
    "few-seeds": "Few seeds",
    "boundary": "Chosen settings on the boundary of what was swept",
    "ties": "Ties",
    "left-out": "Settings that were not compared",
    "normalizer": "The normalizer",
    "budgets": "Unequal tuning budgets",
    "commits": "The code",
    "versions": "Versions",
}


@dataclass(frozen=True)
class ReportWarning:
    """Something to know before the results are read. `kind` is one of KINDS; `numbers` are those in `text`, by name."""

    kind: str
    text: str
    numbers: dict[str, Any]

    @property
    def heading(self) -> str:
        """A few words for the kind."""
        return KINDS[self.kind]


def find_warnings(facts: Facts) -> list[ReportWarning]:
    """Return the warnings, the gravest first."""
    found = [
        warning
        for find in (_runs, _seeds, _tuning_shown, _scores, _choices, _normalizer, _budgets, _code)
        for warning in find(facts)
    ]
    return sorted(found, key=lambda warning: list(KINDS).index(warning.kind))


def _runs(facts: Facts) -> Iterator[ReportWarning]:
    planned, done = facts.count("planned"), facts.count("finished") + facts.count("diverged")
    if not done:
        yield ReportWarning(
            "no-runs",
            f"None of {counted(planned, 'trial')} is in the store: there is nothing to report yet.",
            {"planned": planned},
        )
    for kind, text in (
        ("missing", "are not in the store. What is shown is partial, and may change"),
        ("failed", "could not be trained (see the failures below). Nothing is shown of them"),
    ):
        number = facts.count(kind)
        if number and done:
            now = f", of which {facts.running:,} are being trained now" if kind == "missing" and facts.running else ""
            yield ReportWarning(
                kind,
                f"{number:,} of {counted(planned, 'trial')} {text}{now}. {_where(facts.progress, kind)}",
                {kind: number, "planned": planned},
            )
    diverged = facts.count("diverged")
    if diverged:
        rule = {
            "worst": "counts as the worst return of the study's tuning runs on its environment",
            "drop": "is left out of its setting's mean, which favors settings that diverge often",
        }[facts.rules["diverged"]]
        everything = " All runs diverged: scores say nothing." if not facts.count("finished") else ""
        yield ReportWarning(
            "diverged",
            f"{diverged:,} of {counted(done, 'run')} diverged; in the choice of settings, such a run {rule}.{everything} "
            f"{_where(facts.progress, 'diverged')}",
            {"diverged": diverged, "done": done},
        )


def _where(progress: Rows, name: str) -> str:
    groups = [f"{row['agent']} on {row['environment']} ({row['stage']}) {row[name]:,}" for row in progress if row[name]]
    return f"By group: {_some(groups, ', ')}."


def _some(texts: Sequence[str], separator: str, most: int = 8) -> str:
    more = f"{separator}and {len(texts) - most:,} more" if len(texts) > most else ""
    return separator.join(texts[:most]) + more


def _seeds(facts: Facts) -> Iterator[ReportWarning]:
    if facts.overlap:
        yield ReportWarning(
            "seeds-overlap",
            f"{counted(len(facts.overlap), 'seed')} of the evaluation had a part in the choice of settings: scores are too high.",
            {"seeds": facts.overlap},
        )
    for stage, what in (("tune", "tuning"), ("evaluate", "evaluation")):
        seeds = len(facts.seeds.get(stage, []))
        if 0 < seeds < FEWEST_SEEDS:
            consequence = (
                "there are no intervals at all"
                if seeds == 1
                else f"intervals from fewer than {FEWEST_SEEDS} runs cover less than they promise, bootstrap intervals above all"
            )
            yield ReportWarning(
                "few-seeds", f"{counted(seeds, f'{what} seed')} a setting: {consequence}.", {"stage": stage, "seeds": seeds}
            )
    done: dict[str, list[int]] = {}
    for row in facts.shown:
        done.setdefault(row["stage"], []).append(row["done"])
    for stage, counts in done.items():
        seeds = len(facts.seeds.get(stage, []))
        if min(counts) < FEWEST_SEEDS <= seeds:
            text = f"Chosen settings have {span(counts)} finished runs of {seeds} that are planned."
            yield ReportWarning("few-seeds", text, {"stage": stage, "seeds": seeds, "fewest_done": min(counts)})


def _tuning_shown(facts: Facts) -> Iterator[ReportWarning]:
    chosen = {(row["by"], row["agent"], row["environment"], row["for_each"]): row["num_settings"] for row in facts.choices}
    shown = [
        row
        for row in facts.shown
        if row["stage"] == "tune" and chosen.get((row["by"], row["agent"], row["environment"], row["for_each"]), 1) > 1
    ]
    if not shown:
        return
    settings = [chosen[row["by"], row["agent"], row["environment"], row["for_each"]] for row in shown]
    why = (
        "the evaluation stage has no run yet"
        if facts.plans_evaluation
        else "the study has no evaluation stage (`seeds.evaluate` in its grid)"
    )
    yield ReportWarning(
        "tuning-shown",
        f"Learning curves and performance are those of the runs that the settings were chosen by, out of {span(settings)} "
        f"settings: they are too high, as a maximum is, and more so the more settings there were; {why}.",
        {"choices": len(shown), "most_settings": max(settings)},
    )


def _scores(facts: Facts) -> Iterator[ReportWarning]:
    number = facts.totals["without_score"]
    if number:
        text = f"{counted(number, 'run')} completed no episode and have no score; settings with such a run are not compared."
        yield ReportWarning("no-score", text, {"without_score": number})


def _choices(facts: Facts) -> Iterator[ReportWarning]:
    edges = [row for row in facts.choices if row["on_edge"]]
    if edges:
        lines = [f"{describe_choice(row)}: {', '.join(row['on_edge'])}" for row in edges]
        yield ReportWarning(
            "boundary",
            f"{len(edges):,} of {counted(len(facts.choices), 'chosen setting')} have a hyperparameter at the lowest or the "
            f"highest of at least three swept values: something better may lie beyond. {_some(lines, '; ', 12)}.",
            {"on_edge": len(edges), "choices": len(facts.choices)},
        )
    tied = [row for row in facts.choices if row["num_tied"]]
    if tied:
        lines = [f"{describe_choice(row)}: {row['num_tied']:,} others" for row in tied]
        text = f"{counted(len(tied), 'choice')} had exactly as good alternatives; the lowest hash decided. {_some(lines, '; ')}."
        yield ReportWarning("ties", text, {"tied": len(tied)})
    left_out = [row for row in facts.choices if row["num_left_out"]]
    if left_out:
        lines = [f"{describe_choice(row)}: {row['num_left_out']:,}" for row in left_out]
        text = (
            "Settings with a missing run or one without a score took no part in "
            f"{counted(len(left_out), 'choice')}. {_some(lines, '; ')}."
        )
        yield ReportWarning(
            "left-out", text, {"choices": len(left_out), "settings": sum(row["num_left_out"] for row in left_out)}
        )


def describe_choice(row: dict[str, Any]) -> str:
    """Return which choice a row is: `SAC on Pendulum-CA (per-environment)`."""
    values = json.loads(row["for_each"] or "{}")
    each = "".join(f", {name} = {value}" for name, value in values.items())
    return f"{row['agent']} on {row['environment']} ({row['by']}{each})"


def _normalizer(facts: Facts) -> Iterator[ReportWarning]:
    name = facts.rules["normalizer"]
    undefined = [row["environment"] for row in facts.spreads if row["low"] is None and row["best_return"] is not None]
    if undefined:
        why = "G* is 0" if name == "thesis" else "settings do not differ"
        text = f"The normalizer {name} has no value on {', '.join(undefined)}: {why} there."
        yield ReportWarning("normalizer", text, {"normalizer": name, "undefined": undefined})
    spreads = {row["environment"]: row["high"] - row["low"] for row in facts.spreads if row["low"] is not None}
    spreads = {environment: spread for environment, spread in spreads.items() if spread > 0}
    if len(spreads) < 2 or max(spreads.values()) <= UNEQUAL * min(spreads.values()):
        return
    total = sum(spreads.values())
    shares = ", ".join(f"{environment} {spread / total:.0%}" for environment, spread in spreads.items())
    widest, narrowest = max(spreads, key=lambda one: spreads[one]), min(spreads, key=lambda one: spreads[one])
    floors = [(row["environment"], _floor(row)) for row in facts.spreads] if name == "thesis" else []
    worst = ", ".join(f"{environment} {floor:.3g}" for environment, floor in floors if floor is not None)
    yield ReportWarning(
        "normalizer",
        f"The normalizer {name} weighs environments unequally: normalized scores of settings spread "
        f"{spreads[widest] / spreads[narrowest]:.3g} times as far on {widest} as on {narrowest}, which counts for that much "
        f"less in choices and scores across environments. Shares of the spread: {shares}."
        + (f" The worst return of an episode has the score: {worst}." if worst else ""),
        {"normalizer": name, "spreads": spreads, "worst": dict(floors)},
    )


def _floor(row: dict[str, Any]) -> float | None:
    """Return the thesis' normalized score of the worst return on an environment."""
    best, worst = row["best_return"], row["worst_return"]
    return None if not best or worst is None else 1 - (best - worst) / abs(best)


def settings_of_agents(facts: Facts) -> dict[str, dict[str, int]]:
    """Return environment → agent → number of settings tuned there."""
    found: dict[str, dict[str, int]] = {}
    for row in facts.grids:
        found.setdefault(row["environment"], {})[row["agent"]] = row["num_settings"]
    return found


def _budgets(facts: Facts) -> Iterator[ReportWarning]:
    unequal = {place: agents for place, agents in settings_of_agents(facts).items() if len(set(agents.values())) > 1}
    if unequal:
        lines = [
            f"{place}: {', '.join(f'{agent} {number:,}' for agent, number in agents.items())}"
            for place, agents in unequal.items()
        ]
        yield ReportWarning(
            "budgets",
            "Agents were tuned over different numbers of settings; the more there are, the more the best one owes to luck, and "
            f"the more chances an agent had. {_some(lines, '; ')}.",
            {"settings": unequal},
        )


def _code(facts: Facts) -> Iterator[ReportWarning]:
    rows = facts.provenance["commit"]
    dirty = sum(row["trials"] for row in rows if (row["value"] or "").endswith("+dirty"))
    if dirty:
        text = (
            f"{counted(dirty, 'trial')} were trained with local changes that no commit has: they cannot be reproduced from one."
        )
        yield ReportWarning("commits", text, {"dirty_trials": dirty})
    unknown = sum(row["trials"] for row in rows if row["value"] is None)
    if unknown:
        text = f"Of {counted(unknown, 'trial')} the commit is not known (trained outside a git checkout)."
        yield ReportWarning("commits", text, {"unknown_trials": unknown})
    for name, kind, what in (
        ("commit", "commits", "commits"),
        ("versions", "versions", "sets of versions"),
        ("engine", "versions", "engines"),
    ):
        values = facts.provenance[name]
        if len(values) > 1:
            counts = [f"{_brief(row['value'])} ({counted(row['trials'], 'trial')})" for row in values]
            yield ReportWarning(
                kind, f"Trials are of {len(values)} different {what}: {_some(counts, ', ')}.", {name: len(values)}
            )


def _brief(value: str | None) -> str:
    """Return a commit's first digits, versions as words, or the value."""
    if value is None:
        return "unknown"
    if value.startswith("{"):
        return versions_text(value)
    return value[:10] + ("+dirty" if value.endswith("+dirty") else "") if len(value) >= 40 else value


def versions_text(versions: str) -> str:
    """Return the column `versions` in words: `numpy 2.4.6, torch 2.13.0`."""
    try:
        known = json.loads(versions)
        return ", ".join(f"{name} {version}" for name, version in sorted(known.items()))
    except (ValueError, AttributeError):
        return versions
