"""What is asked of `sweep analyze` is checked before anything is drawn, and each mistake named."""

import math

import pytest
from synthetic_store import SyntheticStore

from analysis.analyze import analyze, find
from analysis.figures.options import Options
from sweep.messages import UserError


def refused(store, out, figures=(), tables=(), formats=(), study=None, **options):
    with pytest.raises(UserError) as refusal:
        analyze(store, find(figures, tables), study, out, formats, Options(**options))
    return str(refusal.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"agents": ("GreedyAc",)}, '--agent: no agent "GreedyAc" in the store: did you mean "GreedyAC"'),
        ({"environments": ("Mars*",)}, '--environment: no environment "Mars*" in the store: Known: MountainCar-CA, Pendulum-CA'),
        ({"x": "critic_stepsize"}, '--x: unknown hyperparameter "critic_stepsize": did you mean "critic_step_size"'),
        ({"over": "nope"}, '--over: unknown hyperparameter "nope"'),
    ],
)
def test_a_name_that_no_study_has_is_answered_with_those_there_are(options, message, small_store, tmp_path):
    assert refused(small_store, tmp_path / "out", ["sensitivity-region"], **options).startswith(message)
    assert not (tmp_path / "out").exists()


def test_a_glob_that_something_matches_is_no_mistake(small_store, tmp_path):
    (result,) = analyze(small_store, find(["7.1"], []), None, tmp_path, ["csv"], Options(agents=("Greedy*",)))
    assert {line.split(",")[1] for line in result.files[0].read_text().splitlines()[1:]} == {"GreedyAC"}


def test_a_numbered_figure_shows_one_regime_and_says_which_number_the_other_has(small_store, tmp_path):
    message = refused(small_store, tmp_path, ["6.2"], by="across-environments")
    assert message.startswith("figure 6.2 shows settings tuned per-environment; figure 6.5 shows the other")


def test_a_format_that_applies_to_nothing_is_refused(small_store, tmp_path):
    assert refused(small_store, tmp_path, ["7.1"], formats=["json"]).startswith(
        "figure 7.1 is not written as json; there is: csv"
    )
    assert refused(small_store, tmp_path, (), ["6.1"], formats=["png"]).startswith("table 6.1 is not written as png")
    assert refused(small_store, tmp_path, ["2.1"], formats=["sql"]).startswith("figure 2.1 is not written as sql")
    assert refused(small_store, tmp_path, ["7.1", "6.1"], formats=["json"]).startswith(
        "nothing that was asked for is written as json"
    )


def test_nothing_is_written_into_the_store_or_over_a_file(small_store, tmp_path):
    assert "is in the store" in refused(small_store, small_store / "figures", ["7.1"])
    (tmp_path / "file").write_text("mine")
    assert refused(small_store, tmp_path / "file", ["7.1"]).endswith("is a file; --out names a folder")
    assert (tmp_path / "file").read_text() == "mine"


def test_a_choice_all_of_whose_runs_diverged_says_that_its_score_says_nothing(tmp_path):
    store = SyntheticStore(tmp_path / "store")
    for seed in range(3):
        store.finish(store.plan("demo", "SAC", "Pendulum-CA", seed), [1.0, math.nan])
    (result,) = analyze(store.write_studies(), find([], ["A.4"]), None, tmp_path / "out")
    assert "SAC on Pendulum-CA: 3 of 3 tuning runs of the chosen setting diverged; its score says nothing" in result.notes


def test_where_the_best_return_is_zero_the_table_across_environments_says_so(tmp_path):
    store = SyntheticStore(tmp_path / "store")
    for environment, score in (("Pendulum-CA", 0.0), ("MountainCar-CA", -5.0)):
        for seed in range(2):
            store.finish(store.plan("demo", "SAC", environment, seed), [score])
    message = refused(store.write_studies(), tmp_path / "out", (), ["A.1"])
    assert "undefined on Pendulum-CA, where G* is 0" in message
