"""Selections in a store: what is frozen comes back, what selection reads is what was committed, damage is named."""

import json
import os
import random
import shutil
from dataclasses import fields

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from synthetic_store import SyntheticStore

from agents.hypers import GreedyACHypers
from sweep import selections
from sweep.grid import parse
from sweep.messages import UserError
from sweep.selection import Choice, TrialScores, select
from sweep.selections import basis, gather_scores, read_selection, table, write_selection
from sweep.store import Store
from sweep.trials import evaluation_trials, expand

STUDY = """
[study]
name = "study"
environments = ["Acrobot-CA", "Acrobot-DA"]
steps = 1000
[seeds]
tune = 2
{evaluate}
[select]
{select}
[[agent]]
name = "GreedyAC"
sweep = {{ critic_step_size = [0.1, 0.01], entropy_scale = {scales} }}
fixed = {{ hidden_layers = [8, 8] }}
"""
FUNCTIONS = '''
"""Two functions whose hyperparameters have names that columns have, and types that differ."""
def one(config, seed, report): ...
def two(config, seed, report): ...
'''


def study(evaluate="evaluate = 3", select="", scales="[0.1, 1.0, 10.0]"):
    return parse(STUDY.format(evaluate=evaluate, select=select, scales=scales), "grid.toml")


def choose(grid):
    """The highest critic step-size and entropy scale are the best."""
    scores = {t.id: TrialScores("finished", t.hypers.critic_step_size + t.hypers.entropy_scale / 1000, 7.0) for t in expand(grid)}
    return select(grid, scores, {})


def frozen_table(grid, selection):
    return table("study", selection, basis(grid, expand(grid)), selection.normalizer.constants())


@pytest.fixture
def store(tmp_path):
    return Store.create(tmp_path / "results")


def test_what_is_frozen_is_read_again_as_it_was_chosen(store):
    grid = study()
    selection = choose(grid)
    assert read_selection(store, "study") is None
    write_selection(store, "study", frozen_table(grid, selection))
    frozen = read_selection(store, "study")
    assert frozen.basis == basis(grid, expand(grid))
    assert [(row["by"], row["environment"], row["setting"], row["mean"], row["on_edge"]) for row in frozen.rows] == [
        (choice.by, choice.environment, choice.setting, choice.mean, list(choice.on_edge)) for choice in selection
    ]
    assert frozen.normalizer().constants() == {"Acrobot-CA": {"best_return": 7.0}, "Acrobot-DA": {"best_return": 7.0}}


def test_what_was_frozen_leads_to_the_same_evaluation_trials(store):
    grid = study()
    selection = choose(grid)
    write_selection(store, "study", frozen_table(grid, selection))
    direct = {trial.id for trial in evaluation_trials(grid, [(c.agent, c.environment, c.hypers) for c in selection])}
    again = {trial.id for trial in evaluation_trials(grid, read_selection(store, "study").chosen())}
    assert again == direct and len(direct) == 2 * 3  # both rules choose the same here


def test_a_hyperparameter_that_does_not_apply_has_no_value_in_its_column_and_survives(store):
    grid = study()
    write_selection(store, "study", frozen_table(grid, choose(grid)))
    rows = pq.read_table(store.path / "studies/study/selections.parquet").to_pylist()
    across = {row["environment"]: row for row in rows if row["by"] == "across-environments"}
    assert {name: row["entropy_scale"] for name, row in across.items()} == {"Acrobot-CA": 10.0, "Acrobot-DA": None}
    assert {json.loads(row["hypers"])["entropy_scale"] for row in across.values()} == {10.0}
    hypers = [hypers for _, _, hypers in read_selection(store, "study").chosen()]
    assert all(isinstance(known, GreedyACHypers) and known.hidden_layers == (8, 8) for known in hypers)


def test_hyperparameters_named_like_columns_or_of_different_types_come_back(store, tmp_path, monkeypatch):
    (tmp_path / "functions_of_this_test.py").write_text(FUNCTIONS)
    monkeypatch.syspath_prepend(tmp_path)
    text = '[study]\nname = "study"\nenvironments = ["Acrobot-CA"]\nsteps = 9\n[seeds]\ntune = 1\nevaluate = 1\n'
    for name, value in {"one": "3", "two": '"three"'}.items():
        text += f'[[agent]]\nname = "functions_of_this_test:{name}"\nfixed = {{ mean = 0.5, width = {value} }}\n'
    monkeypatch.setattr("sweep.grid_checks._column", lambda name: None)  # a study from before such names were refused
    grid = parse(text, "grid.toml")
    selection = select(grid, {trial.id: TrialScores("finished", 1.0, 2.0) for trial in expand(grid)}, {})
    write_selection(store, "study", frozen_table(grid, selection))
    frozen = read_selection(store, "study")
    assert {row["width"] for row in frozen.rows} == {"3", "three"}
    assert {row["mean"] for row in frozen.rows} == {1.0}  # the score, not the hyperparameter
    assert [hypers.as_dict() for _, _, hypers in frozen.chosen()] == [{"mean": 0.5, "width": 3}, {"mean": 0.5, "width": "three"}]


def test_the_basis_is_that_of_trials_and_rules_and_not_of_evaluation_seeds():
    known = basis(study(), expand(study()))
    same = [
        study(evaluate="evaluate = 30"),
        study(evaluate=""),
        study(scales="[10.0, 0.1, 1.0]"),
        study(select='by = ["across-environments", "per-environment"]\nscore = "episode_mean"'),
    ]
    assert {basis(grid, reversed(expand(grid))) for grid in same} == {known}
    other = [
        study(scales="[0.1, 1.0]"),
        study(select='by = ["per-environment"]'),
        study(select='score = "step_mean"'),
        study(select='normalizer = "cdf"'),
        study(select='diverged = "drop"'),
        study(select='for_each = ["entropy_scale"]'),
    ]
    assert len({basis(grid, expand(grid)) for grid in other} | {known}) == len(other) + 1


def test_the_basis_tells_sections_apart_that_have_the_same_trials():
    apart = STUDY.format(evaluate="", select="", scales="[0.1]")
    head, agent = apart.split("[[agent]]")
    split = head + "".join(f'[[agent]]{agent}environments = ["*-{kind}"]\n' for kind in ("CA", "DA"))
    one, two = parse(apart, "grid.toml"), parse(split, "grid.toml")
    assert {trial.id for trial in expand(one)} == {trial.id for trial in expand(two)}
    assert basis(one, expand(one)) != basis(two, expand(two))


def test_a_write_that_fails_leaves_the_earlier_selection(store, monkeypatch):
    grid = study()
    selection = choose(grid)
    write_selection(store, "study", frozen_table(grid, selection))
    before = (store.path / "studies/study/selections.parquet").read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UserError, match="the selection cannot be written to this store: No space left on device"):
        write_selection(store, "study", frozen_table(grid, selection).slice(0, 1))
    assert [file.name for file in (store.path / "studies/study").iterdir()] == ["selections.parquet"]
    assert (store.path / "studies/study/selections.parquet").read_bytes() == before


def test_a_damaged_selection_is_named(store):
    grid = study()
    write_selection(store, "study", frozen_table(grid, choose(grid)))
    file = store.path / "studies/study/selections.parquet"
    content = file.read_bytes()
    known = read_selection(store, "study").rows
    generator = random.Random(0)
    for place in generator.sample(range(len(content)), 500):
        file.write_bytes(content[:place] + bytes([content[place] ^ (1 << generator.randrange(8))]) + content[place + 1 :])
        said = ""
        try:
            rows = read_selection(store, "study").rows
        except UserError as error:
            said, rows = str(error), known
        assert rows == known  # some bytes of a Parquet file are of no consequence
        assert not said or said.startswith(f"{file}: is damaged and cannot be read: ")
    for cut in (content[:-10], b"", content[: len(content) // 2]):
        file.write_bytes(cut)
        with pytest.raises(UserError, match=r"selections\.parquet: is damaged and cannot be read"):
            read_selection(store, "study")


def test_rows_of_two_selections_in_one_file_are_damage(store):
    grid = study()
    rows = [table("study", choose(grid), name, {e: {} for e in grid.environments}) for name in ("one", "two")]
    write_selection(store, "study", pa.concat_tables(rows))
    with pytest.raises(UserError, match="its rows belong to different selections"):
        read_selection(store, "study")


def test_columns_of_another_type_are_damage(store):
    grid = study()
    selection = frozen_table(grid, choose(grid))
    for name in ("basis", "entropy_gradient"):
        position = selection.schema.get_field_index(name)
        write_selection(store, "study", selection.set_column(position, name, selection[name].cast(pa.binary())))
        with pytest.raises(UserError, match="its columns are of other types"):
            read_selection(store, "study")


def test_a_chosen_setting_that_the_agent_no_longer_takes_is_named(store):
    grid = study()
    write_selection(store, "study", frozen_table(grid, choose(grid)))
    frozen = read_selection(store, "study")
    frozen.rows[0]["hypers"]["retired"] = 1
    with pytest.raises(UserError, match=r"selections\.parquet: GreedyAC: the chosen setting is none any more: .*retired"):
        frozen.chosen()


def planned(store, *seeds, environment="Acrobot-CA", agent="SAC", **hypers):
    return [store.plan("demo", agent, environment, seed, **hypers) for seed in seeds]


class Named:
    """A trial as far as reading scores needs it."""

    def __init__(self, member):
        self.id, self.environment = member["trial"], member["environment"]


def join_shards(store):
    """Put the trials of all shards into one."""
    folders = sorted((store.path / "shards").iterdir())
    for name in ("trials.parquet", "episodes.parquet"):
        joined = pa.concat_tables([pq.ParquetFile(folder / name).read() for folder in folders])
        pq.write_table(joined, folders[0] / name)
    for folder in folders[1:]:
        shutil.rmtree(folder)


def test_scores_are_those_of_the_rows_of_the_trials_asked_for(tmp_path):
    synthetic = SyntheticStore(tmp_path / "store")
    first, second, stranger, missing = planned(synthetic, 0, 1, 2, 3)
    synthetic.finish(first, [-5], episode_mean=-1.0, step_mean=-2.0, final_mean=-3.0, best_episode=-0.5)
    synthetic.finish(second, [-6], episode_mean=None, step_mean=None, final_mean=None, best_episode=None)
    synthetic.finish(stranger, [-7])
    store = Store.open(synthetic.path)
    trials = [Named(member) for member in (first, second, missing)]
    for score, value in {"episode_mean": -1.0, "step_mean": -2.0, "final_mean": -3.0}.items():
        scores, worst = gather_scores(store, trials, score)
        assert scores == {
            first["trial"]: TrialScores("finished", value, -0.5),
            second["trial"]: TrialScores("finished", None, None),
        }
        assert worst == {}


def test_the_worst_return_is_of_completed_episodes_of_the_trials_asked_for_where_one_diverged(tmp_path):
    nan = float("nan")
    synthetic = SyntheticStore(tmp_path / "store")
    first, second, stranger = planned(synthetic, 0, 1, 2)
    (other,) = planned(synthetic, 0, environment="Pendulum-CA")
    synthetic.finish(first, [-300, -9, -4000], ["truncated", "terminated", "budget"])
    synthetic.finish(second, [-400, -float("inf"), nan])
    synthetic.finish(stranger, [-5000])
    synthetic.finish(other, [-6000])
    store = Store.open(synthetic.path)
    join_shards(store)
    scores, worst = gather_scores(store, [Named(member) for member in (first, second, other)], "episode_mean")
    assert worst == {"Acrobot-CA": -400}
    assert scores[second["trial"]] == TrialScores("diverged", None, -400.0)
    assert len(scores) == 3


def test_the_score_that_is_chosen_by_decides_the_winner(tmp_path):
    """Nine episodes of one step with return 0 and one of 991 with −1,000, against two of 500 with −500."""
    agents = '[[agent]]\nname = "SAC"\nsweep = { critic_step_size = [0.1, 0.01] }\n'
    means = {0.1: {"episode_mean": -100.0, "step_mean": -991.0}, 0.01: {"episode_mean": -500.0, "step_mean": -500.0}}
    for score, winner in {"episode_mean": 0.1, "step_mean": 0.01}.items():
        text = '[study]\nname = "s"\nenvironments = ["Acrobot-CA"]\nsteps = 1000\n[seeds]\ntune = 1\n'
        grid = parse(f'{text}[select]\nscore = "{score}"\n{agents}', "grid.toml")
        synthetic = SyntheticStore(tmp_path / score)
        for trial in expand(grid):
            member = {**synthetic.plan("s", "SAC", "Acrobot-CA", 0), "trial": trial.id}
            synthetic.finish(member, [-1], best_episode=-0.5, **means[trial.hypers.critic_step_size])
        selection = select(grid, *gather_scores(Store.open(synthetic.path), expand(grid), grid.select.score))
        assert {choice.hypers.critic_step_size for choice in selection} == {winner}
        assert {choice.score for choice in selection} == {score}


def test_a_damaged_shard_is_named(tmp_path):
    synthetic = SyntheticStore(tmp_path / "store")
    (member,) = planned(synthetic, 0)
    synthetic.finish(member, [float("nan")])
    store = Store.open(synthetic.path)
    for name in ("episodes", "trials"):
        file = next(store.path.glob(f"shards/*/{name}.parquet"))
        file.write_bytes(file.read_bytes()[:-20])
        with pytest.raises(UserError, match=rf"{name}\.parquet: is damaged"):
            gather_scores(store, [Named(member)], "episode_mean")


def test_a_shard_that_is_compacted_meanwhile_is_looked_for_again(tmp_path, monkeypatch):
    synthetic = SyntheticStore(tmp_path / "store")
    (member,) = planned(synthetic, 0)
    synthetic.finish(member, [-3], best_episode=-3.0)
    store = Store.open(synthetic.path)
    shards, moved = store.path / "shards", []

    def read(file, columns):
        if not moved:
            moved.append(file.parent.rename(shards / "elsewhere"))
        return original(file, columns)

    original = selections.read_table
    monkeypatch.setattr(selections, "read_table", read)
    scores, _ = gather_scores(store, [Named(member)], "episode_mean")
    assert scores == {member["trial"]: TrialScores("finished", -3.0, -3.0)}


def test_every_field_of_a_choice_is_a_column():
    grid = study()
    selection = choose(grid)
    columns = frozen_table(grid, selection).to_pylist()
    for row, choice in zip(columns, selection, strict=True):
        for field in fields(Choice):
            if field.name not in ("hypers", "for_each", "on_edge"):
                assert row[field.name] == getattr(choice, field.name)
        assert len(row["basis"]) == 16 and row["study"] == "study" and row["selected_at"] is not None
