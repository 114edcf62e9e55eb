-- One row per (study, stage, trial).
-- Thesis 6.1: the score of each run by its study's rules. NULL for a run that has none, and for one that diverged and that its
-- setting does without (rule 'drop', `is_dropped`). `is_complete`: every run that the study planned of the setting in
-- that stage has a score or was dropped, and one has a score: what a setting needs in order to be compared with others.
WITH scored AS (
    SELECT
        study_trials.study,
        study_trials.stage,
        study_trials.agent,
        study_trials.environment,
        study_trials.setting,
        study_trials.trial,
        study_trials.seed,
        study_trials.status,
        study_trials.status = 'diverged' AND study_rules.diverged = 'drop' AS is_dropped,
        CASE study_rules.score
            WHEN 'episode_mean' THEN study_trials.episode_mean
            WHEN 'step_mean' THEN study_trials.step_mean
            WHEN 'final_mean' THEN study_trials.final_mean
        END AS score
    FROM study_trials
    INNER JOIN study_rules ON study_rules.study = study_trials.study
),
counted AS (
    SELECT * REPLACE (CASE WHEN NOT is_dropped THEN score END AS score)
    FROM scored
)
SELECT
    *,
    BOOL_AND(is_dropped OR score IS NOT NULL) OVER same_setting AND COUNT(score) OVER same_setting > 0 AS is_complete
FROM counted
WINDOW same_setting AS (PARTITION BY study, stage, agent, environment, setting)
