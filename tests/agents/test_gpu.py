"""On a CUDA device: captured steps do what the CPU does. `make bench-gpu` measures their speed."""

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import gpu_speed

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]


@pytest.mark.parametrize(("algorithm", "environment"), gpu_speed.PAIRS)
def test_the_first_updates_are_those_of_the_cpu(algorithm, environment):
    with torch.no_grad():
        assert gpu_speed.difference(algorithm, environment, "cuda") < 1e-4
