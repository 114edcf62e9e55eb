-- One row per (study, agent, environment, for_each).
-- Thesis 6.1, Tables A.2 to A.4: the setting with the highest mean score over the tuning seeds, of equals the lowest hash.
-- `source` is 'selection' where the study has frozen its choice, for each combination of the `for_each` values; else the choice
-- is computed from the tuning runs there are, among the settings that have all of theirs. `mean` is too high, as a maximum is.
WITH frozen AS (
    SELECT
        selections.study,
        selections.agent,
        selections.environment,
        selections.for_each,
        selections.setting,
        'selection' AS source,
        selections.score,
        selections.mean,
        setting_scores.standard_error,
        selections.num_seeds,
        selections.num_settings,
        selections.num_left_out,
        selections.runner_up,
        selections.runner_up_mean,
        selections.num_tied,
        selections.on_edge
    FROM selections
    LEFT JOIN setting_scores
        ON setting_scores.study = selections.study
        AND setting_scores.stage = 'tune'
        AND setting_scores.agent = selections.agent
        AND setting_scores.environment = selections.environment
        AND setting_scores.setting = selections.setting
    WHERE selections.by = 'per-environment'
),
ranked AS (
    SELECT
        *,
        ROW_NUMBER() OVER (PARTITION BY study, agent, environment ORDER BY is_complete DESC, mean DESC, setting ASC) AS place,
        MAX(mean) FILTER (WHERE is_complete) OVER (PARTITION BY study, agent, environment) AS highest
    FROM setting_scores
    WHERE stage = 'tune' AND study NOT IN (SELECT study FROM frozen)
),
computed AS (
    SELECT
        study,
        agent,
        environment,
        MIN(setting) FILTER (WHERE place = 1) AS setting,
        MIN(highest) AS mean,
        MIN(standard_error) FILTER (WHERE place = 1) AS standard_error,
        MIN(num_seeds) FILTER (WHERE place = 1) AS num_seeds,
        COUNT(*) FILTER (WHERE is_complete) AS num_settings,
        COUNT(*) FILTER (WHERE NOT is_complete) AS num_left_out,
        MIN(setting) FILTER (WHERE place = 2 AND is_complete) AS runner_up,
        MIN(mean) FILTER (WHERE place = 2 AND is_complete) AS runner_up_mean,
        COUNT(*) FILTER (WHERE is_complete AND mean = highest) - 1 AS num_tied
    FROM ranked
    GROUP BY study, agent, environment
    HAVING COUNT(*) FILTER (WHERE is_complete) > 0
),
tuned AS (
    SELECT * FROM frozen
    UNION ALL BY NAME
    SELECT computed.*, '{}' AS for_each, 'computed' AS source, study_rules.score, setting_edges.on_edge
    FROM computed
    INNER JOIN study_rules USING (study)
    LEFT JOIN setting_edges USING (study, agent, environment, setting)
)
SELECT tuned.*, tuned.source = 'selection' AS is_frozen, setting_hyperparameters.* EXCLUDE (study, agent, environment, setting)
FROM tuned
LEFT JOIN setting_hyperparameters USING (study, agent, environment, setting)
