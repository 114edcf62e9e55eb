-- One row per (environment).
-- The lowest return of one completed episode, over every trial in the store: the score of a diverged trial (rule "worst").
SELECT
    environment,
    MIN(episodic_return) AS worst_return
FROM completed_episodes
GROUP BY environment
