-- One row per (study, stage, agent, environment).
-- Numbers of trials: planned = finished + diverged + failed + missing.
SELECT
    study,
    stage,
    agent,
    environment,
    COUNT(*) AS planned,
    COUNT(*) FILTER (WHERE status = 'finished') AS finished,
    COUNT(*) FILTER (WHERE status = 'diverged') AS diverged,
    COUNT(*) FILTER (WHERE status = 'failed') AS failed,
    COUNT(*) FILTER (WHERE status = 'missing') AS missing
FROM study_trials
GROUP BY study, stage, agent, environment
