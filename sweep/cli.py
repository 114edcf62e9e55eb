"""The command line: the commands, and what becomes of their errors. Imports lazily, so that `sweep --help` answers at once.

Exit codes: 0 done, 1 usage or bad input, 2 some trials failed, 3 incomplete or interrupted.
"""

import os
import re
import sys
from typing import Annotated, Any

import typer

from sweep import without_pandas
from sweep.commands import init, launch, plan, reporting, results, retry, upkeep, watch
from sweep.messages import UserError

app = typer.Typer(
    help="Hyperparameter sweeps and sensitivity analysis for reinforcement-learning research.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(version("sweep-rl"))
        raise typer.Exit


@app.callback()
def _root(
    _version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


# in the order in which a study is lived with
for command in (
    init.init,
    plan.plan,
    launch.launch,
    watch.status,
    watch.failures,
    retry.retry,
    retry.run,
    results.sql,
    results.analyze,
    reporting.report,
    reporting.export,
    upkeep.verify,
    upkeep.compact,
    upkeep.merge,
    plan.doctor,
):
    app.command()(command)


# What typer raises for a mistake in the arguments: click's exception, or that of the copy of click that typer carries.
_UsageMistake: Any = next(base for base in typer.BadParameter.__mro__ if base.__name__ == "ClickException")


# Packages that a machine which only trains does without, and what to do there instead of installing them.
_WITHOUT = {
    "ray": "train in this process: --executor in-process",
    **dict.fromkeys(
        ("duckdb", "jinja2", "matplotlib", "pandas", "scipy", "seaborn"), "copy the store, a folder, to a machine that has it"
    ),
}


_INTERRUPTED = 130  # what typer makes of a keyboard interrupt


def _exit_for(error: OSError) -> None:
    """Exit quietly when the reader of our output has had enough, such as head; else say what the system refused."""
    if isinstance(error, BrokenPipeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    place = f"{error.filename}: " if error.filename else ""
    typer.echo(f"error: {place}{error.strerror or error}", err=True)
    sys.exit(1)


_COMMENT = re.compile(r"--[^=]*\s")  # an option's name has no blank in it


def _prepare_for_sql() -> None:
    """Let a query begin with a comment in SQL, which looks like an option; and import what queries need without pandas."""
    sys.argv[2:] = [f" {word}" if _COMMENT.match(word) else word for word in sys.argv[2:]]
    if "--help" not in sys.argv:
        without_pandas.import_query()


def main() -> None:
    """Run the command line: a mistake of the user's becomes a message and exit code 1."""
    try:
        if sys.argv[1:2] == ["sql"]:
            _prepare_for_sql()
        code = app(standalone_mode=False)
        if code == _INTERRUPTED:
            raise KeyboardInterrupt
        sys.exit(code if isinstance(code, int) else 0)
    except OSError as error:
        _exit_for(error)
    except ModuleNotFoundError as error:
        if error.name not in _WITHOUT:
            raise
        typer.echo(f"error: {error.name} is not installed here: pip install {error.name}, or {_WITHOUT[error.name]}", err=True)
    except UserError as error:
        typer.echo(f"error: {error}" if "\n" not in str(error) else str(error), err=True)
    except _UsageMistake as error:
        error.show()
    except (typer.Abort, KeyboardInterrupt):
        typer.echo("Interrupted.", err=True)
        sys.exit(3)
    sys.exit(1)
