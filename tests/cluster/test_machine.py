import sys

import numpy as np
import pytest

from cluster import machine

MB = 2**20
linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads the kernel's tables")


@pytest.fixture
def system(tmp_path):
    """Folders like /proc and /sys/fs/cgroup, of a machine with 8 GB available; `limit` puts a control group into them."""
    (tmp_path / "proc" / "self").mkdir(parents=True)
    (tmp_path / "proc" / "meminfo").write_text("MemTotal: 16777216 kB\nMemFree: 1024 kB\nMemAvailable: 8388608 kB\n")
    (tmp_path / "proc" / "self" / "cgroup").write_text("0::/jobs/mine\n")

    def limit(group, most, used, inactive=0):
        folder = tmp_path / "cgroup" / group
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "memory.max").write_text(f"{most}\n")
        (folder / "memory.current").write_text(f"{used}\n")
        (folder / "memory.stat").write_text(f"anon {used - inactive}\ninactive_file {inactive}\n")

    return tmp_path, limit


def available(folder):
    return machine.available_bytes(folder / "proc", folder / "cgroup")


def test_without_a_limit_what_is_available_is_what_the_system_says(system):
    folder, limit = system
    assert available(folder) == 8 * 2**30
    limit("jobs/mine", "max", 5 * MB)
    assert available(folder) == 8 * 2**30


def test_a_limit_on_the_process_or_on_what_holds_it_counts_with_the_cached_files_it_could_give_up(system):
    folder, limit = system
    limit("jobs/mine", 1000 * MB, 300 * MB, inactive=100 * MB)
    assert available(folder) == 800 * MB
    limit("jobs", 500 * MB, 450 * MB)
    assert available(folder) == 50 * MB
    limit("others", 10 * MB, 10 * MB)
    assert available(folder) == 50 * MB
    limit("jobs", 500 * MB, 600 * MB)
    assert available(folder) == 0


def test_where_nothing_is_known_nothing_is_said(tmp_path):
    assert available(tmp_path) is None


@linux
def test_the_peak_is_that_since_the_last_reset():
    before = machine.resident_bytes()
    block = np.ones(200 * MB, dtype=np.uint8)
    del block
    assert machine.peak_bytes() >= before + 190 * MB
    machine.release_freed_memory()
    machine.reset_peak()
    assert machine.peak_bytes() < before + 100 * MB
    assert abs(machine.peak_bytes() - machine.resident_bytes()) < 20 * MB


@linux
def test_this_machine_is_the_one_we_run_on():
    here = machine.this_machine()
    assert here.cores >= 1
    assert 0 < here.available_bytes < machine.total_bytes()
