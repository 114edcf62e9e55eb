"""How fast a store of the thesis' size answers: figure 7.1's 36,000 trials and chapter 6's 23,400, of 100,000 steps each.

    python tests/benchmarks/analysis_speed.py [--share 1.0] [--folder DIR] [--json FILE]

Every line is a process of its own, as a user starts it, with its processor time and peak memory; the seconds of a query, both,
are those of the query alone, on a connection that was just opened. The store is made up (`tests/support/full_size_store.py`), and
kept in the folder.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "support"))

from full_size_store import full_size_store  # noqa: E402

from analysis import connect  # noqa: E402

_QUERY = """
import sys, time
from analysis import connect
connection = connect(sys.argv[1])
started, worked = time.perf_counter(), time.process_time()
connection.sql(sys.argv[2]).to_arrow_table()
print(time.perf_counter() - started, time.process_time() - worked)
"""
_CURVES = [f"6.{number}" for number in range(1, 7)]


Took = tuple[float, float, float]
"""Seconds, seconds of processor time, peak memory in MB."""


def run(command: list[str]) -> tuple[Took, str, int]:
    """Return what a process took, its standard output and its exit code."""
    started = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout is not None
    said = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    took = (time.perf_counter() - started, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024)
    return took, said, os.waitstatus_to_exitcode(status)


def query(store: Path, sql: str) -> Took:
    """Return what a query took, with the memory of its process."""
    (_, _, memory), said, code = run([sys.executable, "-c", _QUERY, str(store), sql])
    if code:
        raise SystemExit(f"failed: {sql}")
    seconds, worked = map(float, said.split())
    return seconds, worked, memory


def command(store: Path, *words: str) -> Took | None:
    """Return what a command took, None where it fails."""
    took, _, code = run([str(Path(sys.executable).with_name("sweep")), *words, "--store", str(store)])
    return None if code else took


def measure(store: Path) -> dict[str, tuple[float, Took | None]]:
    """Return what was measured → the seconds it may take, and what it took."""
    connection = connect(store)
    trial = connection.execute("SELECT MIN(trial) FROM members WHERE study = 'figure-7-1' AND stage = 'tune'").fetchone()[0]
    connection.close()
    found: dict[str, tuple[float, Took | None]] = {
        "sweep sql 'SELECT 1'": (1.0, command(store, "sql", "SELECT 1")),
    }
    queries = {
        "sensitivity lines of figure 7.1": (0.5, "SELECT * FROM sensitivity_lines WHERE study = 'figure-7-1'"),
        "normalized scores": (5.0, "SELECT * FROM normalized_scores WHERE study = 'chapter-6'"),
        "changes of learning curves": (15.0, "SELECT * FROM learning_curve_changes WHERE study = 'chapter-6'"),
        "one trial": (1.0, f"SELECT * FROM trials WHERE trial = '{trial}'"),
        "its episodes": (1.0, f"SELECT * FROM episodes WHERE trial = '{trial}'"),
        "its steps": (1.0, f"SELECT * FROM steps WHERE trial = '{trial}'"),
    }
    for name, (limit, sql) in queries.items():
        found[name] = limit, query(store, sql)
    with tempfile.TemporaryDirectory() as out:
        found["sweep analyze --figure 7.1"] = 4.0, command(store, "analyze", "--figure", "7.1", "--out", out)
        words = [word for number in _CURVES for word in ("--figure", number)]
        found["sweep analyze, figures 6.1 to 6.6"] = 15.0, command(store, "analyze", *words, "--study", "chapter-6", "--out", out)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--share", type=float, default=1.0, help="of the settings")
    parser.add_argument("--folder", type=Path, help="keep the store there, and use it again")
    parser.add_argument("--json", type=Path, help="write the results there too")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        found = measure(full_size_store(folder, arguments.share))
    print(f"{'':36} {'seconds':>8} {'at most':>8} {'worked':>8} {'MB':>8}")
    for name, (limit, took) in found.items():
        print(
            f"{name:36} "
            + (f"{took[0]:8.2f} {limit:8.1f} {took[1]:8.2f} {took[2]:8.0f}" if took else "    skipped: the command failed")
        )
    if arguments.json:
        rows = {
            name: took and {"seconds": took[0], "limit": limit, "worked": took[1], "mb": took[2]}
            for name, (limit, took) in found.items()
        }
        arguments.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
