-- One row per (environment).
-- Thesis 6.2.1 and Table 6.1: G*, the highest return of one completed episode, over every trial in the store.
-- Where several episodes reached it: the lowest trial hash, then its earliest such episode.
WITH best AS (
    SELECT
        environment,
        MAX(best_episode) AS best_return,
        FIRST(agent ORDER BY best_episode DESC, trial ASC) AS agent,
        FIRST(trial ORDER BY best_episode DESC, trial ASC) AS trial
    FROM trials
    WHERE best_episode IS NOT NULL
    GROUP BY environment
)
SELECT
    best.environment,
    best.best_return,
    best.agent,
    best.trial,
    MIN(episodes.episode) AS episode
FROM best
INNER JOIN episodes ON episodes.trial = best.trial
WHERE episodes.ending IN ('terminated', 'truncated') AND CAST(episodes.episodic_return AS DOUBLE) = best.best_return
GROUP BY best.environment, best.best_return, best.agent, best.trial
