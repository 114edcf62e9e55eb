-- One row per (study, stage, agent, environment, setting, step).
-- Thesis 3, Figures 3.1 to 3.3: deterministic evaluation beside the learning. Several episodes of a run at one step count as their
-- mean. Mean, standard error (NULL with one run), lowest and highest are over the runs with finite returns there, `num_seeds`;
-- `num_diverged` counts the others.
WITH runs AS (
    SELECT
        members.study,
        members.stage,
        members.agent,
        members.environment,
        members.setting,
        members.trial,
        evaluations.step,
        CASE WHEN BOOL_AND(ISFINITE(evaluations.episodic_return)) THEN AVG(CAST(evaluations.episodic_return AS DOUBLE)) END AS reading
    FROM evaluations
    INNER JOIN members ON members.trial = evaluations.trial
    GROUP BY members.study, members.stage, members.agent, members.environment, members.setting, members.trial, evaluations.step
)
SELECT
    study,
    stage,
    agent,
    environment,
    setting,
    step,
    AVG(reading ORDER BY reading) AS mean,
    STDDEV_SAMP(reading ORDER BY reading) / SQRT(COUNT(reading)) AS standard_error,
    MIN(reading) AS min,
    MAX(reading) AS max,
    COUNT(reading) AS num_seeds,
    COUNT(*) - COUNT(reading) AS num_diverged
FROM runs
GROUP BY study, stage, agent, environment, setting, step
