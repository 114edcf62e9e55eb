"""A checkpoint's file is the newest whole one, whatever happens, and never anything else than what was written."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sweep import checkpoints
from sweep.checkpoints import DamagedCheckpointError

ROOT = str(Path(__file__).parents[2])
HEADER = {"shard": "ab12", "step": 7, "trials": ["α", "b"], "seconds": 0.1, "nested": {"x": None}}


def example():
    table = np.arange(24.0).reshape(2, 3, 4)
    return {
        "name": "α",
        "table": table,
        "turned": table.transpose(2, 0, 1),
        "some": table[:, 1:, ::2],
        "nothing": np.zeros((0, 3), np.float32),
        "one": np.array(3, np.int8),
        "flags": np.array([True, False]),
        "count": 2**100,
        "share": 0.1,
        "missing": None,
        "yes": True,
        "no_number": float("nan"),
    }


@pytest.fixture
def file(tmp_path):
    return checkpoints.file_of(tmp_path, "ab12")


def test_what_was_saved_is_loaded(file):
    size = checkpoints.save(file, HEADER, example())
    assert size == file.stat().st_size
    header, state = checkpoints.load(file)
    assert header == HEADER == checkpoints.read_header(file)
    assert list(state) == list(example())
    for name, value in example().items():
        if isinstance(value, np.ndarray):
            assert state[name].dtype == value.dtype and state[name].shape == value.shape
            np.testing.assert_array_equal(state[name], value)
        else:
            assert type(state[name]) is type(value) and repr(state[name]) == repr(value)


@pytest.mark.parametrize("state", [{}, {"step": 1}, {"empty": np.zeros(0)}])
def test_a_state_without_content_is_one_too(file, state):
    checkpoints.save(file, {}, state)
    assert [*checkpoints.load(file)[1]] == [*state]


def test_large_arrays_are_written_piece_by_piece(file, monkeypatch):
    monkeypatch.setattr(checkpoints, "_PIECE", 64)
    state = {"rows": np.arange(4000).reshape(5, 40, 20)[:, :33], "turned": np.arange(4000).reshape(50, 80).T}
    checkpoints.save(file, {}, state)
    for name, value in checkpoints.load(file)[1].items():
        np.testing.assert_array_equal(value, state[name])


def test_arrays_are_read_only_and_lie_at_multiples_of_64_bytes(file):
    checkpoints.save(file, HEADER, example())
    for value in checkpoints.load(file)[1].values():
        if isinstance(value, np.ndarray):
            assert not value.flags.writeable
            assert not value.size or value.__array_interface__["data"][0] % 64 == 0


def test_a_checkpoint_replaces_the_one_before_and_what_was_loaded_of_it_stays(file, tmp_path):
    checkpoints.save(file, {"step": 1}, {"x": np.ones(1000)})
    _, before = checkpoints.load(file)
    checkpoints.save(file, {"step": 2}, {"x": np.zeros(1000)})
    assert checkpoints.load(file)[0] == {"step": 2}
    assert before["x"].tolist() == [1] * 1000
    assert list(file.parent.iterdir()) == [file] == checkpoints.files(tmp_path)


def test_the_checkpoints_of_a_store_are_listed_and_of_a_store_without_any_none(tmp_path):
    assert checkpoints.files(tmp_path) == []
    for shard in ("b", "a"):
        checkpoints.save(checkpoints.file_of(tmp_path, shard), {}, {})
    (file := checkpoints.file_of(tmp_path, "a")).with_name(f".{file.name}-1-ab").touch()
    assert checkpoints.files(tmp_path) == [tmp_path / ".checkpoints" / f"{shard}.checkpoint" for shard in "ab"]


def test_a_file_that_is_cut_anywhere_is_not_loaded(file):
    checkpoints.save(file, HEADER, example())
    content = file.read_bytes()
    for length in range(len(content)):
        file.write_bytes(content[:length])
        with pytest.raises(DamagedCheckpointError, match="ab12"):
            checkpoints.load(file)
    file.write_bytes(content + b"\0")
    with pytest.raises(DamagedCheckpointError, match="checksum"):
        checkpoints.load(file)


def test_a_file_with_a_flipped_bit_anywhere_is_not_loaded_and_its_header_never_another(file):
    checkpoints.save(file, HEADER, example())
    content, draw = bytearray(file.read_bytes()), random.Random(0)
    for place in range(len(content)):
        bit = 1 << draw.randrange(8)
        content[place] ^= bit
        file.write_bytes(content)
        content[place] ^= bit
        with pytest.raises(DamagedCheckpointError, match="ab12"):
            checkpoints.load(file)
        try:
            assert checkpoints.read_header(file) == HEADER
        except DamagedCheckpointError:
            continue


def test_a_file_of_another_kind_or_format_is_said_to_be_one(file):
    checkpoints.save(file, HEADER, {})
    file.write_bytes(file.read_bytes().replace(b"format 1", b"format 2"))
    for other in (None, b"", b"PAR1"):
        if other is not None:
            file.write_bytes(other)
        for read in (checkpoints.load, checkpoints.read_header):
            with pytest.raises(DamagedCheckpointError, match="is no checkpoint, or of a format"):
                read(file)
    file.unlink()
    with pytest.raises(FileNotFoundError):
        checkpoints.load(file)


@pytest.mark.parametrize("value", [np.array([None]), [1], (1,), np.float64(1), object(), b"", np.zeros(1, "i4,f4")])
def test_what_cannot_be_saved_is_refused_and_nothing_written(file, value):
    with pytest.raises(TypeError, match=r"x: a \w+ cannot be saved"):
        checkpoints.save(file, {}, {"x": value})
    assert not file.exists()


def test_everything_is_on_disk_before_it_gets_its_name(file, monkeypatch):
    events, fsync, replace = [], os.fsync, Path.replace

    def spy_fsync(descriptor):
        events.append(("flush", Path(os.readlink(f"/proc/self/fd/{descriptor}")).name, os.fstat(descriptor).st_size))
        fsync(descriptor)

    def spy_replace(self, target):
        events.append(("name", self.name, target.name))
        return replace(self, target)

    monkeypatch.setattr(os, "fsync", spy_fsync)
    monkeypatch.setattr(Path, "replace", spy_replace)
    size = checkpoints.save(file, HEADER, example())
    temporary = events[0][1]
    assert events[:2] == [("flush", temporary, size), ("name", temporary, file.name)]
    assert [event[:2] for event in events[2:]] == [("flush", ".checkpoints")]


@pytest.mark.parametrize("step", ["write", "fsync", "replace"])
def test_an_error_while_writing_leaves_the_checkpoint_before_and_nothing_else(file, step, monkeypatch):
    checkpoints.save(file, {"step": 1}, example())

    def fail(*arguments):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(*{"write": (checkpoints, "_pieces"), "fsync": (os, "fsync"), "replace": (Path, "replace")}[step], fail)
        with pytest.raises(OSError, match="No space left"):
            checkpoints.save(file, {"step": 2}, example())
    assert checkpoints.load(file)[0] == {"step": 1}
    assert list(file.parent.iterdir()) == [file]


def test_what_killed_processes_left_is_removed_after_an_hour_and_not_before(file):
    file.parent.mkdir()
    old, new = (file.with_name(f".other.checkpoint-1-{name}") for name in ("old", "new"))
    for leftover in (old, new):
        leftover.write_bytes(b"half")
    os.utime(old, (time.time() - 4000,) * 2)
    checkpoints.save(file, {}, {})
    assert sorted(file.parent.iterdir()) == [new, file]


SAVING = """
import sys
import numpy as np
from pathlib import Path
from sweep import checkpoints
file, number = Path(sys.argv[1]), int(sys.argv[2])
while True:
    number += 1
    checkpoints.save(file, {"number": number}, {name: np.full(200_000, number) for name in "abc"})
    print(number, flush=True)
"""


def test_a_process_that_is_killed_while_it_saves_leaves_the_newest_whole_checkpoint(file):
    number, draw = 0, random.Random(1)
    for _ in range(5):
        command = [sys.executable, "-c", SAVING, str(file), str(number)]
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        process.stdout.readline()
        time.sleep(draw.uniform(0, 0.05))
        process.send_signal(signal.SIGKILL)
        said = [number + 1, *map(int, process.communicate()[0].split())]
        header, state = checkpoints.load(file)
        assert header["number"] in (said[-1], said[-1] + 1)
        assert all((state[name] == header["number"]).all() for name in "abc")
        number = header["number"]


MEASURING = """
import json, resource, sys
import numpy as np
from pathlib import Path
from sweep import checkpoints
rows = np.ones((50, 120_000, 8), np.float32)
state = {"rows": rows[:, :100_000], "more": np.ones(30_000_000, np.float32), "turned": np.ones((3_000_000, 2)).T}
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
size = checkpoints.save(Path(sys.argv[1]), {}, state)
print(json.dumps([size, 1024 * before, 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss]))
"""


def test_saving_takes_little_memory_beside_the_state(file):
    command = [sys.executable, "-c", MEASURING, str(file)]
    size, before, after = json.loads(subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout)
    assert size > 300e6
    assert after < 1.2 * before
