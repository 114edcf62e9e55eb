"""What the sensitivity figure shows: the rows of `sensitivity_lines`, and what its study planned."""

from dataclasses import dataclass
from typing import Any

import duckdb
import pandas as pd

from sweep.messages import UserError

_IDENTITY = {"study", "stage", "trial", "setting", "agent", "environment", "seed", "steps"}
_CELL = ("critic_step_size", "entropy_scale")


@dataclass(frozen=True)
class Progress:
    """Trials of an agent on an environment: planned, done (diverged ones among them), diverged."""

    planned: int
    done: int
    diverged: int


@dataclass(frozen=True)
class SensitivityData:
    """Everything a sensitivity figure of one study says.

    `planned` has a row per (agent, environment, critic_step_size, entropy_scale) of the tuning stage, `lines` the rows
    of the view for those that have data; `seeds` is the number of seeds planned a setting.
    """

    study: str
    lines: pd.DataFrame
    planned: pd.DataFrame
    progress: dict[tuple[str, str], Progress]
    seeds: int
    steps: int
    maximized: list[str]

    @property
    def agents(self) -> list[str]:
        """Agents in alphabetical order."""
        return sorted({agent for agent, _ in self.progress})

    @property
    def environments(self) -> list[str]:
        """Environments in alphabetical order."""
        return sorted({environment for _, environment in self.progress})

    def values(self, name: str) -> list[float]:
        """Return the planned values of `critic_step_size` or `entropy_scale`, ascending."""
        return sorted(self.planned[name].unique())

    def panel(self, agent: str, environment: str, planned: bool = False) -> pd.DataFrame:
        """Return best means [critic_step_size, entropy_scale] of a panel, NaN where there is no data yet.

        With `planned`: how many settings each cell waits for (NaN where the study does not ask for the cell).
        """
        rows, column = (self.planned, "num_settings") if planned else (self.lines, "best_mean")
        chosen = rows[(rows["agent"] == agent) & (rows["environment"] == environment)]
        table = chosen.pivot(index=_CELL[0], columns=_CELL[1], values=column).astype(float)
        return table.reindex(index=self.values(_CELL[0]), columns=self.values(_CELL[1]))


def sensitivity_studies(connection: duckdb.DuckDBPyConnection) -> list[str]:
    """Return the studies with data that sweep the entropy scale, or, if there are none, all with data."""
    rows = connection.execute(
        """
        SELECT study, COUNT(DISTINCT entropy_scale) > 1
        FROM members
        WHERE stage = 'tune' AND study IN (SELECT study FROM sensitivity_lines)
        GROUP BY study
        ORDER BY study
        """
    ).fetchall()
    return [study for study, swept in rows if swept] or [study for study, _ in rows]


def load(connection: duckdb.DuckDBPyConnection, study: str) -> SensitivityData:
    """Return what the figure shows of `study`, finished or not; UserError if it has nothing of the kind."""
    members = connection.execute("SELECT * FROM members WHERE study = ? AND stage = 'tune'", [study]).df()
    if members[list(_CELL)].dropna().empty:
        raise UserError(f'study "{study}" has no tuning trial with both {" and ".join(_CELL)}')
    cells = members.dropna(subset=list(_CELL)).groupby(["agent", "environment", *_CELL])
    lines = connection.execute(
        "SELECT * FROM sensitivity_lines WHERE study = ? ORDER BY agent, environment, entropy_scale, critic_step_size",
        [study],
    ).df()
    progress = connection.execute(
        """
        SELECT agent, environment, planned, finished + diverged, diverged
        FROM study_progress
        WHERE study = ? AND stage = 'tune'
        """,
        [study],
    ).fetchall()
    return SensitivityData(
        study=study,
        lines=lines,
        planned=cells["setting"].nunique().reset_index(name="num_settings"),
        progress={(agent, environment): Progress(*counts) for agent, environment, *counts in progress},
        seeds=int(members.groupby(["environment", "setting"])["seed"].nunique().max()),
        steps=int(members["steps"].max()),
        maximized=_maximized(members),
    )


def _maximized(members: pd.DataFrame) -> list[str]:
    """Return the hyperparameters beside the two of the figure that differ between settings of an agent."""
    others = [name for name in members.columns if name not in _IDENTITY.union(_CELL)]
    per_panel = members.groupby(["agent", "environment"])
    return [name for name in others if int(per_panel[name].agg(_num_values).max()) > 1]


def _num_values(values: "pd.Series[Any]") -> int:
    return len({str(value) for value in values.dropna()})
