"""The environment of docs/fixed_start.py is Acrobot-CA, but for where it starts."""

import importlib
from pathlib import Path

import gymnasium
import numpy as np

import agents.environments.registration  # noqa: F401

DOCS = Path(__file__).parent.parent / "docs"


def test_it_moves_like_the_built_in_one_and_starts_at_rest(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    importlib.import_module("fixed_start")
    ours, theirs = (gymnasium.make(name).unwrapped for name in ("FixedStartAcrobot-CA-v0", "sweep/Acrobot-CA-v0"))
    assert ours.reset(seed=3)[0].tolist() == [0, 0, 0, 0]
    generator = np.random.default_rng(0)
    steps = terminated = 0
    for _ in range(40):
        state = (generator.uniform(-1, 1, 4) * [np.pi, np.pi, 12, 28]).tolist()
        for environment in (ours, theirs):
            environment.reset(seed=0, options={"state": state})
        is_over = False
        while not is_over and steps % 25 < 24:
            action = generator.uniform(-1.5, 1.5, 1).astype(np.float32)
            (observation, *ended), (expected, *as_there) = (
                environment.step(given) for environment, given in ((ours, action), (theirs, action.clip(-1, 1)))
            )
            np.testing.assert_allclose(observation, expected, rtol=1e-6, atol=1e-6)
            assert ended[:3] == as_there[:3]
            is_over = ended[1]
            steps += 1
            terminated += is_over
        steps += 1
    assert steps > 100 and terminated > 5
