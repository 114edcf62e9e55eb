"""Reinforcement-learning agents trained as populations in lock-step: `agents.train(...)`.

`agents.hypers` and `agents.registry` are torch-free; everything that needs torch is loaded on first use.
"""

from typing import Any

__all__ = ["train"]


def __getattr__(name: str) -> Any:
    if name == "train":
        from agents.training import train

        return train
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
