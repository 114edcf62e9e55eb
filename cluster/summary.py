"""What a launch did."""

from dataclasses import dataclass


@dataclass
class Summary:
    """What a launch did in one stage. Rates are in agent-steps a second, over wall-clock time and all workers.

    `peak_memory` is the most bytes that a worker had in memory. `trouble` is what else ended it early, in a sentence.
    """

    study: str
    trials: int
    finished_before: int
    stage: str = "tune"
    trained: int = 0
    diverged: int = 0
    failed: int = 0
    agent_steps: int = 0
    seconds: float = 0.0
    interrupted: bool = False
    already_there: int = 0
    store_is_unwritable: bool = False
    peak_memory: int = 0
    trouble: str | None = None

    @property
    def finished(self) -> int:
        """Trials of the stage that are in the store."""
        return self.finished_before + self.trained + self.already_there

    @property
    def agent_steps_per_second(self) -> float:
        """Agent-steps trained a second of the launch; 0 when nothing was trained."""
        return self.agent_steps / self.seconds if self.agent_steps else 0.0
