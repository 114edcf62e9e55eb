"""What a report says of a study follows from its rows: warnings, the methods paragraph, the checklist."""

import math

import pytest
from report_study import COMMIT, PROVENANCE, facts_of, write
from synthetic_store import SyntheticStore

from analysis.report_checklist import checklist
from analysis.report_facts import seed_list
from analysis.report_methods import methods
from analysis.report_warnings import find_warnings
from sweep.failures import Failure
from sweep.store import Store


@pytest.fixture(scope="module")
def facts(tmp_path_factory):
    return facts_of(write(tmp_path_factory.mktemp("report") / "store").write_studies())


def warnings_of(facts):
    found = {}
    for warning in find_warnings(facts):
        found.setdefault(warning.kind, []).append(warning)
    return found


def test_counts_seeds_and_hours_are_those_of_the_rows(facts):
    assert (facts.count("planned"), facts.count("finished"), facts.count("planned", "evaluate")) == (18, 18, 6)
    assert facts.seeds == {"tune": [0, 1], "evaluate": [2, 3, 4]}
    assert facts.overlap == []
    assert (facts.totals["agent_steps"], facts.totals["core_hours"], facts.totals["episodes"]) == (18_000, 18.0, 30)
    assert facts.values("commit") == [COMMIT]
    assert [(row["agent"], row["num_settings"], row["fewest_seeds"], row["agent_steps"]) for row in facts.grids] == [
        ("SAC", 3, 2, 6_000)
    ] * 2
    swept = {row["hyperparameter"]: row["values"] for row in facts.hyperparameters if row["is_swept"]}
    assert swept == {"critic_step_size": ["0.001", "0.01", "0.1"]}


def test_a_trial_of_two_studies_is_shared_and_counted_in_both(tmp_path):
    store = SyntheticStore(tmp_path)
    for study in ("one", "two"):
        trial = store.plan(study, "SAC", "Pendulum-CA", 0)
    store.finish(trial, [1.0])
    store.finish(store.plan("one", "SAC", "Pendulum-CA", 1), [1.0])
    path = store.write_studies()
    assert [facts_of(path, study).totals["trials"] for study in ("one", "two")] == [2, 1]
    assert [facts_of(path, study).totals["shared"] for study in ("one", "two")] == [1, 1]


@pytest.mark.parametrize(
    ("seeds", "text"), [([], ""), ([3], "3"), ([2, 0, 1], "0–2"), ([0, 1, 5, 7, 8], "0–1, 5, 7–8"), ([4, 4], "4")]
)
def test_seeds_are_written_as_ranges(seeds, text):
    assert seed_list(seeds) == text


# warnings


def test_the_normalizer_that_weighs_environments_unequally_is_named_with_hand_computed_numbers(facts):
    (warning,) = warnings_of(facts)["normalizer"]
    assert warning.numbers["spreads"] == pytest.approx({"MountainCar-CA": 10.0, "Pendulum-CA": 0.5})
    assert warning.numbers["worst"] == pytest.approx({"MountainCar-CA": -9.0, "Pendulum-CA": 0.5})
    assert "20 times as far on MountainCar-CA as on Pendulum-CA" in warning.text
    assert "MountainCar-CA 95%, Pendulum-CA 5%" in warning.text


def test_one_environment_cannot_weigh_unequally(tmp_path):
    path = write(tmp_path, environments=["Pendulum-CA"]).write_studies()
    assert "normalizer" not in warnings_of(facts_of(path))


def test_choices_on_the_boundary_are_named(facts):
    (warning,) = warnings_of(facts)["boundary"]
    assert warning.numbers == {"on_edge": 4, "choices": 4}
    assert "SAC on Pendulum-CA (per-environment): critic_step_size" in warning.text


def test_fewer_than_ten_seeds_are_warned_of_in_each_stage_and_ten_are_not(facts, tmp_path):
    assert [warning.numbers for warning in warnings_of(facts)["few-seeds"]] == [
        {"stage": "tune", "seeds": 2},
        {"stage": "evaluate", "seeds": 3},
    ]
    path = write(tmp_path, tune=10, evaluate=10, environments=["Pendulum-CA"]).write_studies()
    assert set(warnings_of(facts_of(path))) == {"boundary"}


def test_tuning_runs_that_stand_for_performance_are_warned_of(facts, tmp_path):
    assert "tuning-shown" not in warnings_of(facts)
    path = write(tmp_path, evaluate=0).write_studies()
    (warning,) = warnings_of(facts_of(path))["tuning-shown"]
    assert "out of 3 settings" in warning.text
    assert "has no evaluation stage" in warning.text


def test_a_single_setting_is_performance_though_it_is_of_the_tuning_stage(tmp_path):
    store = SyntheticStore(tmp_path)
    for seed in range(2):
        store.finish(store.plan("demo", "SAC", "Pendulum-CA", seed), [1.0 + seed])
    facts = facts_of(store.write_studies())
    assert "tuning-shown" not in warnings_of(facts)
    assert not facts.has_choice


def test_missing_failed_and_diverged_trials_are_counted_and_located(tmp_path):
    store = write(tmp_path, environments=["Pendulum-CA"])
    store.plan("demo", "SAC", "Pendulum-CA", 90)
    store.finish(store.plan("demo", "SAC", "Pendulum-CA", 91), [1.0, math.nan])
    path = store.write_studies()
    failed = Store.open(path)
    trial = {
        "trial": store.plan("demo", "SAC", "Pendulum-CA", 92)["trial"],
        "agent": "SAC",
        "environment": "Pendulum-CA",
        "seed": 92,
    }
    store.write_studies()
    failed._failures.write("s", Failure((trial,), "memory", "box", "Traceback\nMemoryError: 3 GiB", 2, "2026-01-01T00:00:00"))
    found = facts_of(path)
    warnings = warnings_of(found)
    assert warnings["missing"][0].numbers == {"missing": 1, "planned": 12}
    assert warnings["failed"][0].numbers == {"failed": 1, "planned": 12}
    assert warnings["diverged"][0].numbers == {"diverged": 1, "done": 10}
    assert "SAC on Pendulum-CA (tune) 1" in warnings["missing"][0].text
    (failure,) = found.failures
    assert (failure["reason"], failure["attempts"], failure["error"]) == ("memory", 2, "Traceback\nMemoryError: 3 GiB")


@pytest.mark.parametrize(
    ("columns", "kind", "text"),
    [
        ({"commit": COMMIT + "+dirty"}, "commits", "18 trials were trained with local changes"),
        ({"commit": None}, "commits", "18 trials the commit is not known"),
    ],
)
def test_code_that_no_commit_has_is_warned_of(columns, kind, text, facts, tmp_path):
    assert kind not in warnings_of(facts)
    assert text in warnings_of(facts_of(write(tmp_path, **columns).write_studies()))[kind][0].text


def test_mixed_commits_versions_and_engines_are_warned_of(tmp_path):
    store = write(tmp_path)
    other = {"commit": "f" * 40, "versions": '{"torch": "2.8"}', "engine": "torch"}
    store.finish(store.plan("demo", "SAC", "Pendulum-CA", 90), [1.0], **PROVENANCE | other)
    warnings = warnings_of(facts_of(store.write_studies()))
    assert "0123456789 (18 trials), ffffffffff (1 trial)" in warnings["commits"][0].text
    assert "sweep-rl 0.1.0, torch 2.13.0 (18 trials), torch 2.8 (1 trial)" in warnings["versions"][0].text
    assert "native (18 trials), torch (1 trial)" in warnings["versions"][1].text


def test_unequal_tuning_budgets_are_warned_of(facts, tmp_path):
    assert "budgets" not in warnings_of(facts)
    store = write(tmp_path, environments=["Pendulum-CA"])
    store.finish(store.plan("demo", "GreedyAC", "Pendulum-CA", 0), [1.0])
    warning = warnings_of(facts_of(store.write_studies()))["budgets"][0]
    assert warning.numbers == {"settings": {"Pendulum-CA": {"GreedyAC": 1, "SAC": 3}}}


def test_evaluation_seeds_that_were_tuning_seeds_are_the_first_warning(tmp_path):
    store = write(tmp_path)
    store.finish(store.plan("demo", "SAC", "Pendulum-CA", 1, "evaluate", critic_step_size=1e-1), [1.0])
    facts = facts_of(store.write_studies())
    assert find_warnings(facts)[0].kind == "seeds-overlap"
    assert facts.overlap == [1]


ONE_RULE = """
[study]
name = "demo"
[seeds]
tune = 2
evaluate = 3
[select]
by = ["{}"]
score = "final_mean"
normalizer = "cdf"
diverged = "drop"
"""


@pytest.mark.parametrize("rule", ["per-environment", "across-environments"])
def test_only_the_rule_that_the_grid_asks_for_is_reported(rule, tmp_path):
    path = write(tmp_path, evaluate=0).write_studies()
    (path / "studies" / "demo" / "grid.toml").write_text(ONE_RULE.format(rule))
    found = facts_of(path)
    assert found.by == [rule]
    assert found.rules == {"score": "final_mean", "normalizer": "cdf", "diverged": "drop"}
    assert {row["by"] for row in found.choices} == {row["by"] for row in found.shown} == {rule}
    assert warnings_of(found)["boundary"][0].numbers == {"on_edge": 2, "choices": 2}
    said = methods(found, 0)
    assert ("Tuned per environment:" in said, "Tuned across environments:" in said) == (
        rule == "per-environment",
        rule == "across-environments",
    )
    assert "the mean over the last tenth of environment steps" in said
    weigh = answers(found)["Do environments weigh equally in what is chosen across them?"][0]
    assert (weigh == "does not apply") == (rule == "per-environment")


# methods and checklist


def test_the_methods_paragraph_says_what_the_data_say(facts):
    text = methods(facts, resamples_seed=7)
    for said in (
        "We trained SAC on MountainCar-CA and Pendulum-CA for 1,000 environment steps a run; "
        "episodes were truncated after 500 steps and the discount was γ = 0.99.",
        "tuned by grid search with 2 seeds (0–1) a setting",
        "SAC: critic_step_size ∈ {0.001, 0.01, 0.1} (3 settings an environment)",
        "the mean undiscounted return over its completed episodes",
        "counts as the lowest return of a completed episode of the tuning runs",
        "N(p) = 1 − (G* − p) / |G*|",
        "trained anew on 3 seeds (2–4), which had no part in the choice",
        "with seed 7",
        "Of 18 planned runs, 18 were completed, and none diverged.",
        "18,000 environment steps and 18 core-hours on cpu (engine native)",
        f"sweep-rl 0.1.0, torch 2.13.0; commit {COMMIT}",
    ):
        assert said in text, said
    assert "batch_size = 32" in text
    assert "\n" not in text


def test_the_methods_paragraph_owns_up_to_tuning_runs_and_missing_ones(tmp_path):
    store = write(tmp_path, evaluate=0)
    store.plan("demo", "SAC", "Pendulum-CA", 90)
    text = methods(facts_of(store.write_studies()), 0)
    assert "Performance is that of the tuning runs, which the settings were chosen by, and thus too high." in text
    assert "Of 13 planned runs, 12 were completed, and none diverged (1 missing)." in text
    assert "had no part in the choice" not in text


def answers(facts):
    return {item.question: (item.answer, item.numbers) for item in checklist(facts, find_warnings(facts), 3)}


def test_the_checklist_answers_with_numbers(facts):
    found = answers(facts)
    assert found["Are the seeds of every stage reported?"] == ("yes", "tuning 0–1; evaluation 2–4")
    assert found["Are evaluation seeds other ones than tuning seeds?"] == ("yes", "0 in common")
    assert found["Are there at least 10 seeds behind the results?"] == ("no", "3 evaluation seeds")
    assert found["Is every run that was planned among the results?"] == ("yes", "18 of 18; 0 failed, 0 missing")
    assert found["Do the chosen settings lie within what was swept?"] == ("no", "4 of 4 on the boundary")
    assert found["Do environments weigh equally in what is chosen across them?"] == ("no", "normalizer thesis")
    assert found["Are results from runs that had no part in the choice of settings?"][0] == "yes"
    assert found["Are all runs of one commit, without local changes?"] == ("yes", "1 commit")
    assert found["Is there a checksum of the data behind each figure and table?"] == ("yes", "3 SHA-256")


def test_what_does_not_apply_is_neither_yes_nor_no(tmp_path):
    store = SyntheticStore(tmp_path)
    store.plan("demo", "SAC", "Pendulum-CA", 0)
    found = answers(facts_of(store.write_studies()))
    assert found["Are evaluation seeds other ones than tuning seeds?"][0] == "does not apply"
    assert found["Are all runs of one commit, without local changes?"][0] == "does not apply"
    assert found["Is every run that was planned among the results?"][0] == "no"
