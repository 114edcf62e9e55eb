-- One row per (study, stage, trial).
-- What each study needs and what became of it: `status` is 'missing' where the store has no such trial yet.
-- Scores of a diverged trial are the worst return of the environment in the study's tuning trials; those of a failed or missing
-- trial are NULL, as are those of a trial that completed no episode, and scores that are not finite.
WITH scored AS (
    SELECT
        members.study,
        members.stage,
        members.trial,
        members.setting,
        members.agent,
        members.environment,
        members.seed,
        COALESCE(trials.status, 'missing') AS status,
        CASE trials.status WHEN 'finished' THEN trials.episode_mean WHEN 'diverged' THEN worst_return END AS episode_mean,
        CASE trials.status WHEN 'finished' THEN trials.step_mean WHEN 'diverged' THEN worst_return END AS step_mean,
        CASE trials.status WHEN 'finished' THEN trials.final_mean WHEN 'diverged' THEN worst_return END AS final_mean
    FROM members
    LEFT JOIN trials ON trials.trial = members.trial
    LEFT JOIN worst_returns ON worst_returns.study = members.study AND worst_returns.environment = members.environment
)
SELECT
    study,
    stage,
    trial,
    setting,
    agent,
    environment,
    seed,
    status,
    CASE WHEN ISFINITE(episode_mean) THEN episode_mean END AS episode_mean,
    CASE WHEN ISFINITE(step_mean) THEN step_mean END AS step_mean,
    CASE WHEN ISFINITE(final_mean) THEN final_mean END AS final_mean
FROM scored
