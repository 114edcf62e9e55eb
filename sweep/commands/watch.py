"""`sweep status` and `sweep failures`: how a store's studies are, also while they run, from any terminal."""

import json
from typing import Annotated, Any

import typer

from sweep.options import DEFAULT_STORE, JsonOption, ReadStoreOption

StudyArgument = Annotated[str | None, typer.Argument(metavar="STUDY", help="A study of the store; default: all of them.")]


def status(study: StudyArgument = None, store: ReadStoreOption = DEFAULT_STORE, as_json: JsonOption = False) -> None:
    """Say how far studies are: planned, finished, running, failed trials, and the time left of launches under way."""
    from rich.console import Console

    from sweep.status import status as read
    from sweep.status_report import show
    from sweep.store import Store
    from sweep.studies import named

    opened = Store.open(store)
    found = read(opened, named(opened, study))
    if as_json:
        typer.echo(json.dumps({"studies": [one.to_json() for one in found]}))
    else:
        show(found, Console())


def failures(
    study: StudyArgument = None,
    store: ReadStoreOption = DEFAULT_STORE,
    tracebacks: Annotated[bool, typer.Option("--tracebacks", help="Print each different traceback as well.")] = False,
    as_json: JsonOption = False,
) -> None:
    """List the trials that failed: why, where, and the command that trains just that one again."""
    from rich.console import Console

    from sweep.status_report import show_failures
    from sweep.store import Store
    from sweep.studies import named

    opened = Store.open(store)
    wanted: set[str] = set()
    for name in named(opened, study):
        wanted |= opened.study_trials(name)
    found: dict[str, dict[str, Any]] = {}  # of a trial that failed several times, the last time
    for failure in opened.failures():
        found |= {
            trial["trial"]: {
                **{name: trial.get(name) for name in ("trial", "agent", "environment", "seed")},
                "reason": failure.reason,
                "host": failure.host,
                "attempts": failure.attempts,
                "at": failure.at,
                "error": failure.error,
                "reproduce": f"sweep run {trial['trial']} --store {store}",
            }
            for trial in failure.trials
            if study is None or trial["trial"] in wanted
        }
    listed = sorted(found.values(), key=lambda one: (str(one["agent"]), str(one["environment"]), one["seed"] or 0, one["trial"]))
    if as_json:
        typer.echo(json.dumps(listed))
    else:
        show_failures(listed, Console(), tracebacks)
