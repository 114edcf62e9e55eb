"""The table of claims: a row for each test, the statement and its verdict below it, and what no run can say yet."""

import math

import pytest
from synthetic_store import SyntheticStore

from analysis import connect
from analysis.claims.claims import thesis_claims
from analysis.figures.options import NoDataError, Options
from analysis.tables import claims

STUDY = "published-per-environment"


@pytest.fixture
def store(tmp_path):
    store = SyntheticStore(tmp_path)
    for agent, level in (("SAC", 900.0), ("GreedyAC", 870.0), ("VanillaAC", 600.0)):
        for seed in range(8):
            store.finish(store.plan(STUDY, agent, "Pendulum-CA", seed), [level + seed] * 10)
    store.finish(store.plan("another", "SAC", "Pendulum-CA", 99), [1.0])
    return connect(store.write_studies())


def test_each_test_has_a_row_and_each_statement_a_verdict(store):
    table = claims.build(store, STUDY, Options())
    rows = {(row.claim, row.d): row for row in table.data.itertuples()}
    faster = rows["6.1.1", "first half: SAC − GreedyAC, Pendulum-CA"]
    assert (faster.verdict, faster.value, faster.claimed, faster.num_runs) == ("confirmed", 30, "> 0", 8)
    assert faster.p_holm >= faster.p_value
    about = [claim for claim in thesis_claims().claims if claim.study == STUDY]
    lines = {line.split(" ")[0]: line for line in table.notes[:-1]}
    assert list(lines) == [claim.name for claim in about]
    assert lines["6.1.1"] == "6.1.1 confirmed: On Pendulum-CA, SAC learned faster than both GreedyAC and VanillaAC."
    assert lines["6.2.1"].startswith("6.2.1 not tested: GreedyAC learned faster than both baselines on Mountain Car-CA. (study ")
    assert table.notes[-1].startswith(f"study {STUDY}: {len(about)} statements: ")


def test_runs_that_are_missing_or_diverged_are_said(tmp_path):
    store = SyntheticStore(tmp_path)
    for agent in ("SAC", "GreedyAC"):
        for seed in range(3):
            trial = store.plan(STUDY, agent, "Pendulum-CA", seed)
            if (agent, seed) != ("SAC", 2):
                store.finish(trial, [5.0, math.nan] if (agent, seed) == ("GreedyAC", 0) else [1.0 + seed, 2.0])
    notes = claims.build(connect(store.write_studies()), STUDY, Options()).notes
    where = f"study {STUDY}: {{}} on Pendulum-CA (tune): "
    assert notes[-2:] == [
        where.format("GreedyAC") + "1 diverged, counted as the worst return of the environment",
        where.format("SAC") + "2 of 3 runs: verdicts may change",
    ]


def test_the_query_of_statements_about_widths_is_of_the_scores_behind_them(tmp_path):
    store, study = SyntheticStore(tmp_path), "entropy-gradient-sampled"
    for agent in ("SAC", "GreedyAC"):
        for x in (0.1, 0.01):
            for scale in (0.1, 1.0):
                for seed in range(2):
                    trial = store.plan(study, agent, "Pendulum-CA", seed, critic_step_size=x, entropy_scale=scale)
                    store.finish(trial, [100 * x + scale + seed])
    connection = connect(store.write_studies())
    table = claims.build(connection, study, Options())
    assert list(table.data["claim"]) == ["7.1.1", "7.1.3"]  # for 7.1.2 the step-size 1e-3 is missing
    rows = connection.execute(table.sql).df()
    assert len(rows) == 16 and set(rows["agent"]) == {"GreedyAC", "SAC"}


def test_its_query_has_the_mean_return_of_each_run_in_each_window(store):
    rows = store.execute(claims.build(store, STUDY, Options()).sql).df()
    assert len(rows) == 3 * 8 * 5  # all steps, the first quarter, the first half, 40% to 50%, the last tenth
    assert set(rows[rows["agent"] == "SAC"]["mean_return"]) == {900.0 + seed for seed in range(8)}


def test_the_correction_is_for_the_statements_that_are_tested(store):
    data = claims.build(store, STUDY, Options()).data
    tested = data.drop_duplicates("claim")
    most = tested.loc[tested["p_holm"].idxmin()]
    assert most["p_holm"] == pytest.approx(data[data["claim"] == most["claim"]]["p_value"].max() * len(tested), rel=1e-3)


def test_studies_are_those_that_claims_are_about(store):
    assert claims.studies(store, Options()) == [STUDY]
    with pytest.raises(NoDataError, match='no claim is about study "another"; there are some about published-per-environment, '):
        claims.build(store, "another", Options())
