-- One row per (environment).
-- Thesis 6.2.1 and Table 6.1: G*, the highest return of one completed episode, over every trial in the store.
-- Where several episodes reached it: the lowest trial hash, then its earliest such episode.
SELECT
    environment,
    MAX(episodic_return) AS best_return,
    FIRST(agent ORDER BY episodic_return DESC, trial ASC, episode ASC) AS agent,
    FIRST(trial ORDER BY episodic_return DESC, trial ASC, episode ASC) AS trial,
    FIRST(episode ORDER BY episodic_return DESC, trial ASC, episode ASC) AS episode
FROM completed_episodes
GROUP BY environment
