-- One row per (study, by, agent, environment, for_each, trial).
-- Thesis 6.1 and 6.2: the runs that show what a choice does. They are its evaluation trials, whose seeds had no part in the
-- choice, once the study has run any; of a study without an evaluation stage its tuning trials, which are too good.
-- A study with evaluation seeds has runs by the rules that it asks for (`study_rules`), and by no other.
WITH choices AS (
    SELECT study, 'per-environment' AS "by", agent, environment, for_each, setting
    FROM tuned_per_environment
    UNION ALL
    SELECT study, 'across-environments' AS "by", agent, environment, for_each, setting
    FROM tuned_across_environments
),
stages AS (
    SELECT
        study,
        CASE WHEN BOOL_OR(stage = 'evaluate' AND status IN ('finished', 'diverged')) THEN 'evaluate' ELSE 'tune' END AS stage
    FROM study_trials
    GROUP BY study
)
SELECT
    choices.study,
    choices.by,
    choices.agent,
    choices.environment,
    choices.for_each,
    study_trials.trial,
    study_trials.stage,
    choices.setting,
    study_trials.seed,
    study_trials.status
FROM choices
INNER JOIN stages ON stages.study = choices.study
INNER JOIN study_trials
    ON study_trials.study = choices.study
    AND study_trials.stage = stages.stage
    AND study_trials.agent = choices.agent
    AND study_trials.environment = choices.environment
    AND study_trials.setting = choices.setting
INNER JOIN study_rules ON study_rules.study = choices.study
WHERE LIST_CONTAINS(study_rules.by, choices.by)
