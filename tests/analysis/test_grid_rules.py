"""Table `grid_rules`: the rules of a study as its grid has them, and the view that takes them until a selection is frozen."""

import json
import subprocess
import sys
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from synthetic_store import SyntheticStore

from analysis import connect
from sweep import schema, study_files

GRID = """
[seeds]
tune = 2
evaluate = 3
[select]
by = ["per-environment"]
score = "step_mean"
diverged = "drop"
[[agent]]
derive = { elite_fraction = "3 / num_action_samples" }
"""
NOTHING = (None, None, None, None)


@pytest.mark.parametrize(
    ("grid", "overrides", "expected"),
    [
        (GRID, None, (["per-environment"], "step_mean", None, "drop")),
        (
            GRID,
            [
                "study.steps=5",
                "select.score=final_mean",
                'select.by=["per-environment", "across-environments"]',
                "agent[1].name=SAC",
            ],
            (["across-environments", "per-environment"], "final_mean", None, "drop"),
        ),
        (GRID.replace("evaluate = 3", ""), None, (None, "step_mean", None, "drop")),
        (GRID.replace("evaluate = 3", ""), ["seeds.evaluate=2"], (["per-environment"], "step_mean", None, "drop")),
        ("[study]", ["select.normalizer=cdf"], (None, None, "cdf", None)),
        (GRID.replace("step_mean", "no such").replace('"per-environment"', "3"), None, (None, None, None, "drop")),
        ("select = 5\nagent = 5\nseeds = [1]", ["select.score=step_mean"], NOTHING),
        ("[select", None, NOTHING),
        (None, None, NOTHING),
    ],
)
def test_rules_of_a_study_are_those_of_its_grid_until_a_selection_is_frozen(tmp_path, grid, overrides, expected):
    store = SyntheticStore(tmp_path)
    store.plan("demo", "SAC", "Pendulum-CA", 0)
    folder = store.write_studies() / "studies" / "demo"
    if grid is not None:
        (folder / "grid.toml").write_text(grid)
    if overrides:
        (folder / "overrides.json").write_text(json.dumps(overrides))
    names = '"by", score, normalizer, diverged'
    assert connect(tmp_path).execute(f"SELECT study, {names} FROM grid_rules").fetchall() == [("demo", *expected)]
    defaults = (["across-environments", "per-environment"], "episode_mean", "thesis", "worst")
    rules = tuple(default if rule is None else rule for rule, default in zip(expected, defaults, strict=True))
    assert connect(tmp_path).execute(f"SELECT {names} FROM study_rules").fetchall() == [rules]
    row = dict.fromkeys(schema.SELECTIONS.names) | {"by": "across-environments", "score": "final_mean", "normalizer": "minmax"}
    frozen = pa.Table.from_pylist([row | {"study": "demo", "diverged": "worst"}], schema.SELECTIONS)
    pq.write_table(frozen, folder / "selections.parquet")
    found = connect(tmp_path).execute(f"SELECT {names} FROM study_rules").fetchall()
    assert found == [(["across-environments"], "final_mean", "minmax", "worst")]


def test_grids_are_read_only_when_they_are_asked_for(tmp_path, monkeypatch):
    store = SyntheticStore(tmp_path)
    store.plan("demo", "SAC", "Pendulum-CA", 0)
    (store.write_studies() / "studies" / "demo" / "grid.toml").write_text(GRID)
    read = []
    monkeypatch.setattr(study_files, "source", lambda folder: read.append(folder) or (GRID, ()))
    connection = connect(tmp_path)
    connection.execute("SELECT count(*) FROM trials").fetchall()
    assert read == []
    for _ in range(2):
        assert connection.execute("SELECT derived FROM grid_rules").fetchall() == [(["elite_fraction"],)]
    assert len(read) == 1


def test_a_connection_does_not_load_what_checks_grids():
    code = "import sys, analysis.database\nprint([name for name in ('pydantic', 'sweep.grid') if name in sys.modules])"
    root = Path(__file__).resolve().parents[2]
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=True, capture_output=True).stdout == b"[]\n"
