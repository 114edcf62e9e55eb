"""Living with a study at the command line: status, failures, retry, run, --set, drain, two launches at once."""

import contextlib
import json
import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import pyarrow.parquet as pq
import pytest

ROOT = Path(__file__).parent.parent
GRID = """
[study]
name = "tiny"
environments = ["Pendulum-CA"]
steps = 60
cutoff = 20
[seeds]
tune = 2
evaluate = 2
[sweep]
critic_step_size = [0.01, 0.001]
[[agent]]
name = "SAC"
"""
FUNCTION = '''
import time
from pathlib import Path

def train(config, seed, report):
    """Take a while; raise for one value, as long as a file is there."""
    if config["x"] == 3 and Path("broken").exists():
        raise ValueError("x must not be 3")
    for _ in range(10):
        time.sleep(config["seconds"])
        report(config["x"] + seed / 10, config["steps"] // 10)
'''
FUNCTION_GRID = """
[study]
name = "mine"
environments = ["Pendulum-CA"]
steps = 100
[seeds]
tune = 2
[[agent]]
name = "slowly:train"
fixed = { seconds = 0.0 }
sweep = { x = [1, 2, 3] }
"""


def command(*arguments):
    return [sys.executable, "-c", "from sweep.cli import main; main()", *arguments]


def environment():
    known = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200"}
    known.pop("SWEEP_STORE", None)
    return known


def sweep(*arguments, cwd):
    return subprocess.run(command(*arguments), cwd=cwd, env=environment(), capture_output=True, text=True, timeout=300)


def launch(cwd, *arguments):
    return sweep("launch", "grid.toml", "--executor", "in-process", *arguments, cwd=cwd)


def begin(cwd, *arguments):
    """Start a launch and return it while it runs. Signals reach it as they would at a terminal."""
    return subprocess.Popen(
        command("launch", "grid.toml", "--executor", "in-process", *arguments),
        cwd=cwd,
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )


def until(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.1)
    return found


@pytest.fixture
def mine(tmp_path):
    """A folder with a study of a function of the user's own."""
    (tmp_path / "slowly.py").write_text(FUNCTION)
    (tmp_path / "grid.toml").write_text(FUNCTION_GRID)
    return tmp_path


def rows(folder, table="trials"):
    files = sorted((folder / "results").glob(f"shards/*/{table}.parquet"))
    return [row for file in files for row in pq.read_table(file, partitioning=None).to_pylist()]


def test_a_whole_study_in_one_command_and_its_status(tmp_path):
    (tmp_path / "grid.toml").write_text(GRID)
    ran = launch(tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert "tiny (tune): 4 trials trained" in ran.stdout
    assert "tiny (evaluate): 2 trials trained" in ran.stdout
    ran = sweep("status", cwd=tmp_path)
    assert ran.stdout == "tiny: 6 of 6 trials done (100%)\n"
    (found,) = json.loads(sweep("status", "tiny", "--json", cwd=tmp_path).stdout)["studies"]
    assert (found["trials"], found["finished"], found["missing"], found["eta_seconds"]) == (6, 6, 0, None)
    assert [(group["stage"], group["trials"]) for group in found["groups"]] == [("tune", 4), ("evaluate", 2)]
    query = "SELECT count(*) AS n FROM selections INNER JOIN settings USING (study, agent, environment, setting)"
    ran = sweep("sql", f"{query} WHERE stage = 'evaluate'", "--format", "csv", cwd=tmp_path)
    assert ran.stdout.split() == ["n", "2"]  # per environment and across environments: the same setting


def test_a_value_of_the_grid_is_set_at_the_command_line_and_kept_with_the_study(tmp_path):
    (tmp_path / "grid.toml").write_text(GRID)
    ran = launch(tmp_path, "--set", "study.steps=50", "--set", "agent[1].fixed.batch_size=16")
    assert ran.returncode == 0, ran.stderr
    assert {(row["steps"], row["batch_size"]) for row in rows(tmp_path)} == {(50, 16)}
    trial = rows(tmp_path)[0]["trial"]
    ran = sweep("run", trial[:8], cwd=tmp_path)  # it knows what was set
    assert (ran.returncode, "50 steps" in ran.stdout) == (0, True)
    assert "The store has its rows already" in ran.stdout
    ran = launch(tmp_path, "--set", "study.stepps=50")
    assert ran.returncode == 1
    assert 'did you mean "steps"?' in ran.stderr


def test_failures_say_why_and_how_to_see_it_again_and_retry_trains_them(mine):
    (mine / "broken").touch()
    ran = launch(mine)
    assert ran.returncode == 2
    assert "mine: 4 trials trained" in ran.stdout
    assert "2 trials failed: `sweep failures` says why, `sweep retry` tries them again." in ran.stdout
    ran = sweep("failures", cwd=mine)
    assert ran.stdout.count("ValueError: x must not be 3") == 2
    assert "exception" in ran.stdout
    found = json.loads(sweep("failures", "mine", "--json", cwd=mine).stdout)
    assert [(one["agent"], one["seed"], one["reason"]) for one in found] == [
        ("slowly:train", 0, "exception"),
        ("slowly:train", 1, "exception"),
    ]
    assert 'raise ValueError("x must not be 3")' in found[0]["error"]
    assert 'raise ValueError("x must not be 3")' in sweep("failures", "--tracebacks", cwd=mine).stdout
    (status,) = json.loads(sweep("status", "--json", cwd=mine).stdout)["studies"]
    assert (status["failed"], status["missing"], status["finished"]) == (2, 0, 4)
    ran = sweep("sql", "SELECT count(*) FROM trials WHERE status = 'failed' AND x = 3", "--format", "csv", cwd=mine)
    assert ran.stdout.split()[-1] == "2"

    reproduce = found[0]["reproduce"].split()[1:]
    ran = sweep(*reproduce, cwd=mine)
    assert ran.returncode == 2
    assert "x = 3" in ran.stdout
    assert ran.stderr.rstrip().endswith("ValueError: x must not be 3")
    (mine / "broken").unlink()
    ran = sweep(*reproduce, cwd=mine)
    assert (ran.returncode, "Its rows are in the store now." in ran.stdout) == (0, True)
    ran = sweep("retry", "--executor", "in-process", cwd=mine)
    assert ran.returncode == 0, ran.stderr
    assert "1 trial trained" in ran.stdout
    assert sorted(row["x"] for row in rows(mine)) == [1, 1, 2, 2, 3, 3]
    assert sweep("failures", cwd=mine).stdout == "No trial has failed.\n"
    assert "Nothing failed, and nothing is damaged." in sweep("retry", "--executor", "in-process", cwd=mine).stdout


@pytest.mark.parametrize("table", ["trials", "episodes", "steps"])
def test_a_damaged_file_is_named_by_verify_and_healed_by_retry(mine, table):
    assert launch(mine).returncode == 0
    before = sorted(map(str, rows(mine, "episodes")))
    file = next((mine / "results" / "shards").glob(f"*/{table}.parquet"))
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0x10
    file.write_bytes(bytes(content))
    ran = sweep("verify", cwd=mine)
    assert ran.returncode == 2
    assert f"{table}.parquet" in ran.stdout
    ran = sweep("retry", "--executor", "in-process", cwd=mine)
    assert ran.returncode == 0, ran.stderr
    assert "put aside in" in ran.stderr
    assert sweep("verify", cwd=mine).returncode == 0
    assert sorted(map(str, rows(mine, "episodes"))) == before


def test_status_from_another_terminal_while_it_runs(mine):
    (mine / "grid.toml").write_text(FUNCTION_GRID.replace("seconds = 0.0", "seconds = 0.5"))
    running = begin(mine)
    try:
        until(lambda: list((mine / "results" / ".launches").glob("*.json")))

        def training():
            (found,) = json.loads(sweep("status", "--json", cwd=mine).stdout)["studies"]
            return found if found["agent_steps_per_second"] > 0 else None

        found = until(training)
        assert found["running"] > 0
        assert found["eta_seconds"] > 0
        (alive,) = found["launches"]
        assert (alive["pid"], alive["stage"]) == (running.pid, "tune")
        assert "agent-steps/s" in sweep("status", cwd=mine).stdout
    finally:
        running.kill()
        running.communicate()
    assert "No launch is under way." in sweep("status", cwd=mine).stdout


def test_an_interrupt_drains_and_a_second_one_stops(mine):
    (mine / "grid.toml").write_text(FUNCTION_GRID.replace("seconds = 0.0", "seconds = 0.3"))
    running = begin(mine)
    until(lambda: list((mine / "results" / ".progress").glob("*")))
    running.send_signal(signal.SIGINT)
    out, err = running.communicate(timeout=60)
    assert running.returncode == 3, err
    assert "Draining" in out + err
    drained = len(rows(mine))
    assert 0 < drained < 6
    running = begin(mine)
    progress = mine / "results" / ".progress"
    until(lambda: list(progress.glob("*")))
    started = time.monotonic()
    running.send_signal(signal.SIGINT)
    time.sleep(0.3)
    running.send_signal(signal.SIGINT)
    out, err = running.communicate(timeout=60)
    assert running.returncode == 3, err
    assert "Stopping" in out + err
    assert time.monotonic() - started < 2.9  # a trial takes three seconds
    assert launch(mine, "--set", "agent[1].fixed.seconds=0.3").returncode == 0
    assert len({row["trial"] for row in rows(mine)}) == len(rows(mine)) == 6


def test_two_launches_at_once_share_the_work(mine):
    (mine / "grid.toml").write_text(FUNCTION_GRID.replace("seconds = 0.0", "seconds = 0.1").replace("tune = 2", "tune = 6"))
    both = [begin(mine, "--json") for _ in range(2)]
    answers = [json.loads(one.communicate(timeout=120)[0]) for one in both]
    assert [one.returncode for one in both] == [0, 0]
    assert [answer["finished"] for answer in answers] == [18, 18]
    assert sum(answer["trained"] for answer in answers) == 18
    assert min(answer["trained"] for answer in answers) >= 3
    assert sorted((row["x"], row["seed"]) for row in rows(mine)) == [(x, seed) for x in (1, 2, 3) for seed in range(6)]


def at_a_terminal(cwd, answer, *arguments):
    """Run a command at a terminal, answer its question, and return its exit code and what it showed."""
    terminal, end = pty.openpty()
    process = subprocess.Popen(
        command(*arguments), cwd=cwd, env=environment(), stdin=end, stdout=end, stderr=end, start_new_session=True
    )
    os.close(end)
    shown = b""
    with contextlib.suppress(OSError):  # the terminal is gone with the process
        while piece := os.read(terminal, 4096):
            shown += piece
            if b"Go on?" in shown and answer:
                os.write(terminal, answer)
                answer = b""
    os.close(terminal)
    return process.wait(60), shown.decode()


def test_a_long_launch_asks_at_a_terminal_and_nothing_is_trained_without_consent(mine):
    large = ("--set", "seeds.tune=100", "--set", "study.steps=100_000")
    arguments = ("launch", "grid.toml", "--executor", "in-process", "--limit", "200", *large)
    code, shown = at_a_terminal(mine, b"n\n", *arguments)
    assert "200 trials, about 1 h 23 min. Go on?" in shown  # 20 million steps at a nominal 4,000 a second
    assert (code, rows(mine)) == (3, [])
    code, shown = at_a_terminal(mine, b"", *arguments, "--yes")
    assert ("Go on?" in shown, len(rows(mine))) == (False, 200)


def test_a_grid_to_begin_with_is_a_study_and_overwrites_nothing(tmp_path):
    ran = sweep("init", cwd=tmp_path)
    assert (ran.returncode, ran.stdout) == (0, "wrote grid.toml; change it, then: sweep plan grid.toml\n")
    found = json.loads(sweep("plan", "grid.toml", "--no-pilot", "--json", cwd=tmp_path).stdout)
    assert found["stages"]["tune"]["trials"] == (3 * 2 * 4 + 3 * 2 * 2) * 5
    (tmp_path / "grid.toml").write_text("mine")
    ran = sweep("init", cwd=tmp_path)
    assert (ran.returncode, ran.stderr) == (1, "error: grid.toml: is there already; `sweep init PATH` writes another\n")
    assert (tmp_path / "grid.toml").read_text() == "mine"
    (tmp_path / "there").mkdir()
    assert sweep("init", "there", cwd=tmp_path).returncode == 0
    assert "sweep launch there/grid.toml" in (tmp_path / "there" / "grid.toml").read_text()


@pytest.mark.parametrize("name", ["nobody", "abc"])
def test_names_that_lead_nowhere_are_told_so(mine, name):
    launch(mine)
    for arguments in (("status", name), ("failures", name), ("retry", name), ("run", name)):
        ran = sweep(*arguments, cwd=mine)
        assert ran.returncode == 1, arguments
        assert ran.stderr.startswith("error: ") and ran.stderr.count("\n") == 1
        assert name in ran.stderr
