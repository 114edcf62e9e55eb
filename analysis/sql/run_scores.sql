-- One row per (study, stage, trial).
-- Thesis 6.1: the scores of each run by its study's rules; `score` is the one that the study chooses by. NULL for a run that has
-- none, and for one that diverged and that its setting does without (rule 'drop', `is_dropped`). `is_complete`: every run that
-- the study planned of the setting in that stage has a score or was dropped, and one has a score: what a setting needs in
-- order to be compared with others.
WITH ruled AS (
    SELECT
        study_trials.*,
        study_rules.score AS rule,
        study_trials.status = 'diverged' AND study_rules.diverged = 'drop' AS is_dropped
    FROM study_trials
    INNER JOIN study_rules ON study_rules.study = study_trials.study
),
counted AS (
    SELECT
        * REPLACE (
            CASE WHEN NOT is_dropped THEN episode_mean END AS episode_mean,
            CASE WHEN NOT is_dropped THEN step_mean END AS step_mean,
            CASE WHEN NOT is_dropped THEN final_mean END AS final_mean
        )
    FROM ruled
),
scored AS (
    SELECT
        * EXCLUDE (rule),
        CASE rule WHEN 'episode_mean' THEN episode_mean WHEN 'step_mean' THEN step_mean WHEN 'final_mean' THEN final_mean END AS score
    FROM counted
),
settings AS (
    SELECT study, stage, agent, environment, setting, BOOL_AND(is_dropped OR score IS NOT NULL) AND COUNT(score) > 0 AS is_complete
    FROM scored
    GROUP BY study, stage, agent, environment, setting
)
SELECT *
FROM scored
INNER JOIN settings USING (study, stage, agent, environment, setting)
