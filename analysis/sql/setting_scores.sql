-- One row per (study, stage, agent, environment, setting).
-- Thesis 6.2: the mean over seeds of the score that the study chooses by (`run_scores`).
-- Sums are taken in the order of the scores: settings with the same scores have the same mean, whatever their seeds.
SELECT
    study,
    stage,
    agent,
    environment,
    setting,
    FAVG(score ORDER BY score) AS mean,
    STDDEV_SAMP(score ORDER BY score) / SQRT(COUNT(score)) AS standard_error,
    COUNT(score) AS num_seeds,
    COUNT(*) AS num_planned,
    BOOL_AND(is_complete) AS is_complete
FROM run_scores
GROUP BY study, stage, agent, environment, setting
