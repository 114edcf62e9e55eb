"""The pages about the sample store say what its commands print: `docs/reproduce.py` runs them all again."""

import importlib.util
from pathlib import Path

import pytest
from typer.testing import CliRunner

from analysis import connect
from sweep.cli import app
from sweep.sample import sample_store
from sweep.store import Store
from sweep.verification import verify

SCRIPT = Path(__file__).parent.parent / "docs" / "reproduce.py"
TRIALS = "```console\n$ sweep sql --store sample 'SELECT count(*) > 100 AS many\n    FROM trials'\nmany\n────\n{}\n(1 row)\n```\n"


@pytest.fixture
def script(monkeypatch):
    spec = importlib.util.spec_from_file_location("reproduce", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr("sys.argv", ["reproduce.py", "--check"])
    return module


def test_the_pages_say_what_their_commands_print_and_show_what_they_draw(script):
    script.main()


def test_a_page_that_says_something_else_is_noticed(script, tmp_path, monkeypatch, capsys):
    page = tmp_path / "page.md"
    monkeypatch.setattr(script, "PAGES", [page])
    page.write_text(TRIALS.format("true"))
    script.main()
    page.write_text(TRIALS.format("false"))
    with pytest.raises(SystemExit, match="1"):
        script.main()
    assert "-false\n+true\n" in capsys.readouterr().out
    page.write_text("![x](images/reproduction/none.png)")
    with pytest.raises(SystemExit, match=r"page.md: no command draws images/reproduction/none.png"):
        script.main()
    page.write_text("```console\n$ sweep sql --store sample nonsense\n```\n")
    with pytest.raises(SystemExit, match="syntax error"):
        script.main()


def test_the_sample_store_is_sound_and_has_every_trial_of_its_studies():
    store = Store.open(sample_store())
    assert verify(store).problems == ()
    connection = connect(store.path)
    (missing,) = connection.execute("SELECT count(*) FROM study_trials WHERE status NOT IN ('finished', 'diverged')").fetchone()
    connection.close()
    assert missing == 0
    assert sum(file.stat().st_size for file in store.path.rglob("*")) < 8_000_000


def test_a_folder_named_sample_comes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runner = CliRunner()
    assert runner.invoke(app, ["sql", "SELECT 1", "--store", "sample"]).exit_code == 0
    (tmp_path / "sample").mkdir()
    ran = runner.invoke(app, ["sql", "SELECT 1", "--store", "sample"])
    assert "sample: is not a store" in str(ran.exception)


def test_a_launch_into_a_store_of_that_name_makes_one_here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "grid.toml").write_text(
        '[study]\nname = "s"\nenvironments = ["Pendulum-CA"]\nsteps = 50\n[seeds]\ntune = 1\n[[agent]]\nname = "SAC"\n'
    )
    before = sorted(sample_store().rglob("*"))
    ran = CliRunner().invoke(app, ["launch", "grid.toml", "--store", "sample", "--executor", "in-process"])
    assert ran.exit_code == 0, ran.output
    assert (tmp_path / "sample" / "sweep-store.json").exists()
    assert sorted(sample_store().rglob("*")) == before
