-- One row per (trial, episode).
-- Episodes that reached their end (terminated) or the cutoff (truncated) with a finite return. The last episode of a trial,
-- cut by its budget, is left out: its partial return would be too good where every step costs -1.
SELECT
    trials.environment,
    trials.cutoff,
    trials.agent,
    episodes.trial,
    episodes.episode,
    episodes.length,
    CAST(episodes.episodic_return AS DOUBLE) AS episodic_return
FROM episodes
INNER JOIN trials ON trials.trial = episodes.trial
WHERE episodes.ending IN ('terminated', 'truncated') AND ISFINITE(episodes.episodic_return)
