-- One row per (study, agent, environment, setting, hyperparameter).
-- Thesis chapter 5: the hyperparameters of each setting that apply on the environment, one below the other. `value` is a text,
-- `number` the same as a number (NULL for texts, lists and truth values); `is_swept` says that settings of the agent on
-- that environment differ in it.
WITH planned AS (
    SELECT study, agent, environment, setting, ANY_VALUE(COLUMNS(* EXCLUDE (study, stage, trial, setting, agent, environment, seed, steps)))
    FROM members
    GROUP BY study, agent, environment, setting
),
texts AS (
    SELECT study, agent, environment, setting, CAST(COLUMNS(* EXCLUDE (study, agent, environment, setting)) AS VARCHAR)
    FROM planned
),
long_form AS (
    UNPIVOT texts ON COLUMNS(* EXCLUDE (study, agent, environment, setting)) INTO NAME hyperparameter VALUE value
)
SELECT
    study,
    agent,
    environment,
    setting,
    hyperparameter,
    value,
    TRY_CAST(NULLIF(NULLIF(value, 'true'), 'false') AS DOUBLE) AS number,
    MIN(value) OVER same_name <> MAX(value) OVER same_name AS is_swept
FROM long_form
WINDOW same_name AS (PARTITION BY study, agent, environment, hyperparameter)
