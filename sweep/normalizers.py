"""Normalizers: what puts returns of several environments on one scale, so that a setting can be scored across them.

Each is made from the tuning runs of a study, environment by environment, and is fully described by its constants, which are
frozen with the selection: evaluation runs are put on the same scale, and do not move it. With p a score:

    thesis      N(p) = 1 − (G* − p) / |G*|, G* the highest return of one episode (thesis 6.2.1)
    minmax      N(p) = (p − lowest) / (highest − lowest) of the means of all settings of all agents
    percentile  N(p) = (p − 5th percentile) / (95th − 5th percentile) of the same means (Adkins, Bowling and White)
    cdf         N(p) = mean over agents of the share of the agent's runs with a score strictly below p (Patterson et al., CHS)

The first three are not bounded, and only `cdf` gives every environment the same spread: N of the worst possible score is −15.9
on Acrobot and −1.1 on Pendulum with the thesis' normalizer, so that Pendulum counts for little.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sweep.messages import UserError, suggestion


class UndefinedNormalizerError(UserError):
    """A normalizer has no value on an environment."""


@dataclass(frozen=True)
class TuningRuns:
    """What the tuning runs on one environment amount to.

    `best_return`: the highest return of one completed episode. `setting_means`: the mean score of each setting of each agent.
    `run_scores`: agent → the score of each of its runs.
    """

    best_return: float
    setting_means: Sequence[float]
    run_scores: Mapping[str, Sequence[float]]


class Normalizer(ABC):
    """Environment → constants, and the function that they are the constants of."""

    name: ClassVar[str]
    constant_names: ClassVar[tuple[str, ...]]

    def __init__(self, constants: Mapping[str, Mapping[str, Any]]) -> None:
        """Take the constants of each environment. Raises ValueError when one is missing."""
        for environment, known in constants.items():
            if set(known) != set(self.constant_names):
                raise ValueError(f"{environment}: constants of {self.name} are {', '.join(self.constant_names)}")
        self._constants = {environment: dict(known) for environment, known in constants.items()}

    @staticmethod
    def from_constants(name: str, constants: Mapping[str, Mapping[str, Any]]) -> "Normalizer":
        """Return the normalizer that `constants()` was called on. Raises UserError for an unknown name, ValueError as above."""
        if name not in NORMALIZERS:
            raise UserError(f'unknown normalizer "{name}"; {suggestion(name, NORMALIZERS)}')
        return NORMALIZERS[name](constants)

    @staticmethod
    def from_runs(name: str, runs: Mapping[str, TuningRuns]) -> "Normalizer":
        """Return the normalizer of a study from its tuning runs by environment. Raises UserError for an unknown name."""
        known = Normalizer.from_constants(name, {})
        return type(known)({environment: known.measure(here) for environment, here in runs.items()})

    def constants(self) -> dict[str, dict[str, Any]]:
        """Return environment → name → value, in plain numbers and lists: ready for JSON."""
        return {environment: dict(known) for environment, known in self._constants.items()}

    def normalize(self, environment: str, scores: Sequence[float]) -> list[float]:
        """Return N of each score. Raises UndefinedNormalizerError where N is not defined, KeyError on unknown environments."""
        return self._apply(environment, np.asarray(scores, np.float64), **self._constants[environment]).tolist()

    @abstractmethod
    def measure(self, runs: TuningRuns) -> dict[str, Any]:
        """Return the constants of one environment."""

    @abstractmethod
    def _apply(self, environment: str, scores: np.ndarray, **constants: Any) -> np.ndarray:
        """Return N of each score."""


class ThesisNormalizer(Normalizer):
    """N(p) = 1 − (G* − p) / |G*|."""

    name = "thesis"
    constant_names = ("best_return",)

    def measure(self, runs: TuningRuns) -> dict[str, Any]:
        return {"best_return": float(runs.best_return)}

    def _apply(self, environment: str, scores: np.ndarray, **constants: Any) -> np.ndarray:
        best = constants["best_return"]
        if best == 0:
            raise UndefinedNormalizerError(
                f'{environment}: normalizer "thesis" divides by |G*|, and G*, the highest return of an episode, is 0; '
                'choose "minmax", "percentile" or "cdf"'
            )
        return 1 - (best - scores) / abs(best)


class MinMaxNormalizer(Normalizer):
    """0 is the worst setting's mean, 1 the best one's."""

    name = "minmax"
    constant_names = ("low", "high")

    def measure(self, runs: TuningRuns) -> dict[str, Any]:
        return {"low": float(min(runs.setting_means)), "high": float(max(runs.setting_means))}

    def _apply(self, environment: str, scores: np.ndarray, **constants: Any) -> np.ndarray:
        low, high = constants["low"], constants["high"]
        if low == high:
            raise UndefinedNormalizerError(
                f'{environment}: normalizer "{self.name}" divides by the spread between settings, and there is none: '
                f'{self._ends} are both {low:g}; choose "thesis" or "cdf"'
            )
        return (scores - low) / (high - low)

    _ends: ClassVar[str] = "the lowest and the highest mean of a setting"


class PercentileNormalizer(MinMaxNormalizer):
    """0 is the 5th percentile of the settings' means, 1 the 95th, interpolated linearly between neighbors."""

    name = "percentile"

    def measure(self, runs: TuningRuns) -> dict[str, Any]:
        low, high = np.percentile(np.asarray(runs.setting_means, np.float64), [5, 95])
        return {"low": float(low), "high": float(high)}

    _ends: ClassVar[str] = "the 5th and the 95th percentile of the settings' means"


class CDFNormalizer(Normalizer):
    """Mean over agents of the share of the agent's runs strictly below: an agent weighs the same however large its grid."""

    name = "cdf"
    constant_names = ("run_scores",)

    def measure(self, runs: TuningRuns) -> dict[str, Any]:
        return {"run_scores": {agent: sorted(map(float, scores)) for agent, scores in sorted(runs.run_scores.items())}}

    def _apply(self, environment: str, scores: np.ndarray, **constants: Any) -> np.ndarray:
        shares = [np.searchsorted(known, scores, side="left") / len(known) for known in constants["run_scores"].values()]
        return np.array([math.fsum(column) / len(shares) for column in zip(*shares, strict=True)])


NORMALIZERS: dict[str, type[Normalizer]] = {
    normalizer.name: normalizer for normalizer in (ThesisNormalizer, MinMaxNormalizer, PercentileNormalizer, CDFNormalizer)
}
