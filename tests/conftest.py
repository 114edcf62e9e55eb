"""One thread a process: two cores, and tests that run side by side. What was measured on this machine before is not looked up."""

import os

import pytest


@pytest.fixture(scope="session", autouse=True)
def _no_calibrations(tmp_path_factory):
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="session", autouse=True)
def _one_thread():
    import torch

    torch.set_num_threads(1)
