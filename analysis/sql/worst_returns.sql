-- One row per (study, environment).
-- The lowest return of one completed episode, over the study's tuning trials: the score of a diverged trial (rule "worst").
-- Trials of older shards, which do not say their worst episode, are looked up in `early_episodes`.
WITH tuning AS (
    SELECT members.study, members.environment, members.trial, trials.worst_episode, trials.best_episode
    FROM members
    INNER JOIN trials ON trials.trial = members.trial
    WHERE members.stage = 'tune'
),
looked_up AS (
    SELECT unknown.trial, MIN(CAST(early_episodes.episodic_return AS DOUBLE)) AS worst_episode
    FROM early_episodes
    INNER JOIN (
        SELECT DISTINCT trial FROM tuning WHERE worst_episode IS NULL AND best_episode IS NOT NULL
    ) AS unknown ON unknown.trial = early_episodes.trial
    WHERE early_episodes.ending IN ('terminated', 'truncated') AND ISFINITE(early_episodes.episodic_return)
    GROUP BY unknown.trial
)
SELECT
    tuning.study,
    tuning.environment,
    MIN(COALESCE(tuning.worst_episode, looked_up.worst_episode)) AS worst_return
FROM tuning
LEFT JOIN looked_up ON looked_up.trial = tuning.trial
GROUP BY tuning.study, tuning.environment
HAVING worst_return IS NOT NULL
