"""`sweep analyze` over its whole catalogue: the contract of every figure and table, and all of them from a trained study."""

import inspect
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pandas as pd
import pytest
from synthetic_store import SyntheticStore

from agents import demonstrations
from analysis import connect
from analysis.analyze import Entry, Result, analyze, everything, find, list_figures, list_tables, needs_store
from analysis.figures import catalogue as figures
from analysis.figures.options import NoDataError, Options
from analysis.query import run_query
from analysis.tables import catalogue as tables
from sweep.messages import UserError

ENTRIES = everything()
THESIS = ["2.1", "3.1", "3.2", "3.3", "4.2", *(f"6.{number}" for number in range(1, 7)), "7.1", "7.2"]
THESIS_TABLES = ["6.1", "A.1", "A.2", "A.3", "A.4"]
GENERIC = {"learning-curve", "sensitivity-region", "slice", "heat-map", "performance-profile", "sensitivity-plane", "importance"}
GENERIC |= {"setting-ecdf", "seed-spread"}
FROM_A_STORE = [entry for entry in ENTRIES if needs_store(entry)]


def name(entry: Entry) -> str:
    return f"{'figure' if isinstance(entry, figures.Entry) else 'table'} {entry.name}"


def demonstrate(name: str, seed: int) -> list[dict]:
    return getattr(demonstrations, name)(seed)


def made(store: Path, entry: Entry, study: str | None = None, **changes: object):
    """The drawing or the table itself."""
    own = entry.studies[0] if entry.studies else "chapter-6"
    study = study or ("chapter-3" if entry.kind == "evaluation_curve" else own)
    make = entry.load().draw if isinstance(entry, figures.Entry) else entry.load().build
    return make(connect(store), study, entry.options.but(title=entry.title, **changes))


@pytest.mark.parametrize("entry", ENTRIES, ids=name)
def test_every_figure_and_table_keeps_the_contract(entry):
    module = entry.load()
    assert len(entry.caption) > 100
    assert entry.title
    assert not inspect.getdoc(module).startswith(entry.caption)
    known = {field for field in vars(Options()) if field not in ("title", "seed")}
    assert set(module.TAKES) <= known
    if needs_store(entry):
        make = "draw" if isinstance(entry, figures.Entry) else "build"
        assert list(inspect.signature(getattr(module, make)).parameters) == ["connection", "study", "options"]
        assert list(inspect.signature(module.studies).parameters) == ["connection", "options"]
    else:
        assert callable(getattr(demonstrations, entry.demonstration))


def test_every_number_of_the_thesis_and_every_kind_is_there_and_listed():
    assert [entry.name for entry in figures.THESIS] == THESIS
    assert [entry.name for entry in tables.THESIS] == THESIS_TABLES
    assert {entry.name for entry in figures.KINDS} >= GENERIC
    assert len({name(entry) for entry in ENTRIES}) == len(ENTRIES)
    for lines, entries in ((list_figures(), figures.FIGURES), (list_tables(), tables.TABLES)):
        assert [tuple(line.split(maxsplit=1)) for line in lines] == [(entry.name, entry.title) for entry in entries.values()]


@pytest.fixture(scope="module")
def all_of_it(real_store, tmp_path_factory) -> dict[str, Result]:
    """Everything that there is to say of the trained chapter 6."""
    out = tmp_path_factory.mktemp("out")
    formats = ["csv", "sql"]
    results = analyze(real_store, ENTRIES, "chapter-6", out, formats, demonstrations=demonstrate, skip_missing=True)
    return {result.name: result for result in results}


def test_all_draws_what_has_data_and_says_of_the_rest_why_not(all_of_it):
    assert list(all_of_it) == [name(entry) for entry in ENTRIES]
    missing = {result.name: result.missing for result in all_of_it.values() if result.missing}
    assert set(missing) == {"figure 3.1", "figure 3.2", "figure 3.3", "figure 7.2", "figure evaluation-curve", "table claims"}
    assert 'study "chapter-6" has no setting with exploration_noise = gaussian' in missing["figure 3.3"]
    assert "num_action_samples" in missing["figure 7.2"]


@pytest.mark.parametrize("entry", ENTRIES, ids=name)
def test_what_is_written_has_rows_notes_and_a_query(entry, all_of_it):
    result = all_of_it[name(entry)]
    if result.missing:
        assert result.files == []
        return
    kind = name(entry).replace(" ", "-")
    assert [file.name for file in result.files] == [f"{kind}.csv", *([f"{kind}.sql"] if needs_store(entry) else [])]
    rows = pd.read_csv(result.files[0])
    assert len(rows) > 0
    assert not rows.columns.duplicated().any()
    assert result.notes or not needs_store(entry)
    assert (result.study == "chapter-6") == needs_store(entry)
    assert bool(result.text) == (not isinstance(entry, figures.Entry))


@pytest.mark.parametrize("entry", [entry for entry in FROM_A_STORE if entry.name != "claims"], ids=name)
def test_the_query_behind_each_runs_and_gives_rows(entry, all_of_it, real_store):
    result = all_of_it[name(entry)]
    sql = result.files[1].read_text() if not result.missing else made(real_store, entry).sql
    assert run_query(real_store, sql).num_rows > 0


CA, DA = "Pendulum-CA", "Pendulum-DA"
AGENTS = ["GreedyAC", "SAC", "VanillaAC"]
CURVES = {  # figure → its panels, the axis below them, its lines
    "6.1": ([CA, DA], "Episode", AGENTS),
    "6.2": (["MountainCar-CA"], "Episode", AGENTS),
    "6.3": (["Acrobot-CA"], "Episode", AGENTS),
    "6.4": ([CA, DA], "Episode", AGENTS),
    "6.5": (["MountainCar-CA"], "Episode", AGENTS),
    "6.6": (["Acrobot-CA"], "Episode", AGENTS),
    "7.2": (["MountainCar-CA", CA], "Episode", ["10", "20", "30"]),
    "3.1": ([CA], "Environment steps", ["DDPG", "SAC-original"]),
    "3.2": ([CA], "Environment steps", ["DDPG", "SAC-original"]),
    "3.3": ([CA], "Environment steps", ["DDPG", "SAC-original"]),
}


@pytest.mark.parametrize("number", CURVES)
def test_figures_of_curves_have_the_panels_axes_and_lines_of_the_thesis(number, real_store):
    environments, below, lines = CURVES[number]
    entry = figures.find(number)
    figure = made(real_store, entry).figure
    assert [axes.get_title() for axes in figure.axes] == environments
    assert {axes.get_xlabel() for axes in figure.axes} == {below}
    assert "return" in figure.get_supylabel()
    for axes in figure.axes:
        assert [line.get_label() for line in axes.lines] == lines
        assert len(axes.collections) == len(lines)  # a band each
    assert [text.get_text() for text in figure.legends[0].get_texts()] == lines
    assert figure.get_suptitle().startswith(entry.title + "\n")
    assert ("runs a line" in figure.get_suptitle().replace("\n", " ")) and "steps" in figure.get_suptitle()


def test_figure_7_1_has_a_panel_for_each_agent_and_environment_and_a_line_for_each_entropy_scale(real_store):
    figure = made(real_store, figures.find("7.1")).figure
    assert len(figure.axes) == 6
    assert [axes.get_ylabel() for axes in figure.axes[::3]] == ["GreedyAC", "SAC"]
    assert {axes.get_xlabel() for axes in figure.axes[3:]} == {"Critic step-size"}
    assert {len(axes.lines) for axes in figure.axes} == {3}
    assert {axes.get_xscale() for axes in figure.axes} == {"log"}


@pytest.mark.parametrize("number", ["2.1", "4.2"])
def test_demonstrations_need_no_store_and_depend_on_the_seed_alone(number, tmp_path):
    entries = find([number], [])
    first, again, other = (
        analyze(None, entries, None, tmp_path / folder, ["csv"], Options(seed=seed), demonstrate)[0].files[0].read_bytes()
        for folder, seed in (("a", 3), ("b", 3), ("c", 4))
    )
    assert first == again != other


@pytest.mark.parametrize("figure", ["3.1", "6.1", "seed-spread"])
def test_the_same_data_give_the_same_bytes_in_every_format(figure, real_store, tmp_path):
    study = "chapter-3" if figure == "3.1" else "chapter-6"
    formats = ["png", "svg", "pdf", "csv", "sql"]
    first, second = (analyze(real_store, find([figure], []), study, tmp_path / folder, formats)[0].files for folder in "ab")
    assert [file.suffix for file in first] == [".png", ".svg", ".pdf", ".csv", ".sql"]
    assert [file.read_bytes() for file in first] == [file.read_bytes() for file in second]
    assert first[0].read_bytes().startswith(b"\x89PNG")
    ElementTree.parse(first[1])
    assert first[2].read_bytes().startswith(b"%PDF")


def test_a_table_is_text_and_files_in_every_format(real_store, tmp_path):
    formats = ["csv", "json", "markdown", "parquet", "sql"]
    (result,) = analyze(real_store, find([], ["A.2"]), None, tmp_path, formats)
    assert [file.name for file in result.files] == [f"table-A.2.{suffix}" for suffix in ("csv", "json", "md", "parquet", "sql")]
    assert result.study == "chapter-6"
    assert "actor_step_size_scale" in result.text.splitlines()[0]
    assert len(pd.read_parquet(result.files[3])) == len(pd.read_csv(result.files[0])) == 4


def test_formats_that_do_not_apply_give_the_customary_one(real_store, tmp_path):
    results = analyze(real_store, find(["6.1"], ["6.1"]), None, tmp_path, ["svg"])
    assert [result.files[0].name for result in results] == ["figure-6.1.svg", "table-6.1.csv"]


@pytest.mark.parametrize(
    ("figure", "table", "message"),
    [
        ("6.11", None, 'unknown figure "6.11": did you mean "6.1"'),
        ("learning-curves", None, 'unknown figure "learning-curves": did you mean "learning-curve"'),
        (None, "A.9", 'unknown table "A.9": .*Known: 6.1, A.1'),
    ],
)
def test_unknown_names_are_answered_with_the_known_ones(figure, table, message):
    with pytest.raises(UserError, match=message):
        find([figure] if figure else [], [table] if table else [])


@pytest.mark.parametrize(
    ("figure", "options", "message"),
    [
        ("6.1", Options(x="polyak"), r"figure 6.1 takes no --x; it takes: --by, --agent, --environment, --over, --band"),
        ("6.1", Options(normalizer="cdf"), "figure 6.1 takes no --normalizer"),
        ("2.1", Options(agents=("SAC",)), "figure 2.1 takes no --agent"),
        ("6.1", Options(band="sd"), 'unknown band "sd": .*Known: bootstrap, min-max, none, runs, standard-error, student'),
        ("6.1", Options(by="environment"), 'unknown by "environment": did you mean "per-environment"'),
        ("seed-spread", Options(score="mean"), 'unknown score "mean"'),
    ],
)
def test_options_that_a_figure_does_not_take_and_unknown_values_are_refused(figure, options, message, real_store, tmp_path):
    with pytest.raises(UserError, match=message):
        analyze(real_store, find([figure], []), None, tmp_path / "out", options=options)
    assert not (tmp_path / "out").exists()


def test_unknown_studies_and_formats_are_refused_before_anything_is_written(real_store, tmp_path):
    with pytest.raises(UserError, match='unknown study "chapter-66": did you mean "chapter-6"'):
        analyze(real_store, find(["6.1"], []), "chapter-66", tmp_path / "out")
    with pytest.raises(UserError, match=r'unknown format "gif": .*Known: csv, json, markdown'):
        analyze(real_store, find(["6.1"], []), None, tmp_path / "out", ["png", "gif"])
    assert not (tmp_path / "out").exists()


def test_without_a_study_the_one_that_a_figure_was_made_for_is_drawn_and_otherwise_one_must_be_named(real_store, tmp_path):
    entries = find(["3.3", "6.2", "7.1", "7.2"], ["A.1"])
    studies = [result.study for result in analyze(real_store, entries, None, tmp_path, ["csv"])]
    assert studies == ["chapter-3", "chapter-6", "figure-7-1", "figure-7-2", "chapter-6"]
    with pytest.raises(NoDataError, match=r"choose with --study: chapter-3, chapter-6, figure-7-1, figure-7-2"):
        analyze(real_store, find(["learning-curve"], []), None, tmp_path)


def test_a_study_without_the_data_is_an_error_unless_everything_was_asked_for(real_store, tmp_path):
    with pytest.raises(NoDataError, match="no setting with exploration_noise"):
        analyze(real_store, find(["3.1"], []), "chapter-6", tmp_path)
    (result,) = analyze(real_store, find(["3.1"], []), "chapter-6", tmp_path, skip_missing=True)
    assert (result.files, "exploration_noise" in result.missing) == ([], True)


@pytest.mark.parametrize("entry", FROM_A_STORE, ids=name)
def test_an_empty_store_has_nothing_to_show(entry, empty_store, tmp_path):
    with pytest.raises(NoDataError, match=f"{name(entry)}: the store has no study yet"):
        analyze(empty_store, [entry], None, tmp_path)


@pytest.mark.parametrize("state", ["planned", "one seed", "all diverged"])
def test_studies_in_every_poor_state_give_results_or_reasons(state, tmp_path):
    store = SyntheticStore(tmp_path / "store")
    for step_size in (0.1, 0.01):
        member = store.plan("demo", "SAC", "Pendulum-CA", 0, critic_step_size=step_size)
        if state != "planned":
            store.finish(member, [float("nan") if state == "all diverged" else 100 * step_size])
    results = analyze(store.write_studies(), FROM_A_STORE, "demo", tmp_path / "out", ["csv"], skip_missing=True)
    for result in results:
        assert result.missing or result.files
    made_of_it = {result.name for result in results if not result.missing}
    if state == "one seed":
        assert {"figure learning-curve", "figure seed-spread", "table best-returns", "table tuned-settings"} <= made_of_it
    else:
        assert not made_of_it & {"figure learning-curve", "figure seed-spread", "table best-returns", "table tuned-settings"}
