-- One row per (environment, cutoff).
-- The lowest return of one completed episode, over every trial in the store with that cutoff: the score of a diverged trial
-- (rule "worst").
SELECT
    environment,
    cutoff,
    MIN(episodic_return) AS worst_return
FROM completed_episodes
GROUP BY environment, cutoff
