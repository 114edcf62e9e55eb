-- One row per (study, agent, environment, for_each).
-- Thesis 6.2, Table A.1: the one candidate with the highest mean over all environments of the agent of the mean normalized score
-- (`normalized`, by the study's normalizer), as the setting that it is on each. A candidate is what a setting was before anything was
-- dropped that does not apply on an environment: a setting that all environments have; or two, one for either kind of
-- actions, that agree in all hyperparameters which both have. Of equals the lowest sorted hashes of a candidate's settings.
-- `source` is 'selection' where the study has frozen its choice, for each combination of the `for_each` values.
WITH frozen AS (
    SELECT
        selections.study,
        selections.agent,
        selections.environment,
        selections.for_each,
        selections.setting,
        'selection' AS source,
        selections.score,
        selections.normalizer,
        selections.normalized,
        selections.mean,
        setting_scores.standard_error,
        selections.num_seeds,
        selections.num_settings,
        selections.num_left_out,
        selections.runner_up,
        selections.runner_up_mean,
        selections.runner_up_normalized,
        selections.num_tied,
        selections.on_edge
    FROM selections
    LEFT JOIN setting_scores
        ON setting_scores.study = selections.study
        AND setting_scores.stage = 'tune'
        AND setting_scores.agent = selections.agent
        AND setting_scores.environment = selections.environment
        AND setting_scores.setting = selections.setting
    WHERE selections.by = 'across-environments'
),
places AS (
    SELECT study, agent, environment, setting, mean, standard_error, num_seeds, is_complete
    FROM setting_scores
    WHERE stage = 'tune' AND study NOT IN (SELECT study FROM frozen)
),
agents AS (
    SELECT study, agent, COUNT(DISTINCT environment) AS num_environments
    FROM places
    GROUP BY study, agent
),
settings_planned AS (
    SELECT places.study, places.agent, places.setting, LIST(environment ORDER BY environment) AS environments, num_environments
    FROM places
    INNER JOIN agents ON agents.study = places.study AND agents.agent = places.agent
    GROUP BY places.study, places.agent, places.setting, num_environments
),
pairs AS (
    SELECT DISTINCT study, agent, setting, hyperparameter AS name, value
    FROM hyperparameters
),
described AS (
    SELECT
        study,
        agent,
        setting,
        LIST(name ORDER BY name) AS names,
        LIST(STRUCT_PACK(name := name, value := value) ORDER BY name) AS pairs
    FROM pairs
    GROUP BY study, agent, setting
),
partial AS (
    SELECT settings_planned.*, described.names, described.pairs
    FROM settings_planned
    INNER JOIN described USING (study, agent, setting)
    WHERE LEN(environments) < num_environments
),
keyed AS (
    SELECT
        partial.* EXCLUDE (pairs),
        others.names AS other_names,
        LIST_FILTER(partial.pairs, LAMBDA pair: LIST_CONTAINS(others.names, pair.name)) AS shared
    FROM partial
    INNER JOIN (SELECT DISTINCT study, agent, names FROM partial) AS others
        ON others.study = partial.study AND others.agent = partial.agent AND others.names <> partial.names
),
candidates AS (
    SELECT study, agent, [setting] AS candidate, setting, UNNEST(environments) AS environment
    FROM settings_planned
    WHERE LEN(environments) = num_environments
    UNION ALL
    SELECT
        one.study,
        one.agent,
        LIST_SORT([one.setting, another.setting]) AS candidate,
        one.setting,
        UNNEST(one.environments) AS environment
    FROM keyed AS one
    INNER JOIN keyed AS another
        ON another.study = one.study
        AND another.agent = one.agent
        AND another.names = one.other_names
        AND another.other_names = one.names
        AND another.shared = one.shared
    WHERE
        LEN(one.environments) + LEN(another.environments) = one.num_environments
        AND NOT LIST_HAS_ANY(one.environments, another.environments)
),
measured AS (
    SELECT candidates.*, places.* EXCLUDE (study, agent, environment, setting), normalized_scores.score AS normalized
    FROM candidates
    INNER JOIN places USING (study, agent, environment, setting)
    INNER JOIN study_rules ON study_rules.study = candidates.study
    LEFT JOIN normalized_scores
        ON normalized_scores.study = candidates.study
        AND normalized_scores.stage = 'tune'
        AND normalized_scores.agent = candidates.agent
        AND normalized_scores.environment = candidates.environment
        AND normalized_scores.setting = candidates.setting
        AND normalized_scores.normalizer = study_rules.normalizer
),
valued AS (
    SELECT
        study,
        agent,
        candidate,
        BOOL_AND(is_complete AND normalized IS NOT NULL) AS is_compared,
        FAVG(normalized ORDER BY normalized) AS value,
        LIST(setting ORDER BY setting) AS hashes
    FROM measured
    GROUP BY study, agent, candidate
),
ranked AS (
    SELECT
        *,
        ROW_NUMBER() OVER (PARTITION BY study, agent ORDER BY is_compared DESC, value DESC, hashes ASC) AS place,
        MAX(value) FILTER (WHERE is_compared) OVER (PARTITION BY study, agent) AS highest
    FROM valued
),
compared AS (
    SELECT
        study,
        agent,
        ANY_VALUE(candidate) FILTER (WHERE place = 1) AS best,
        ANY_VALUE(candidate) FILTER (WHERE place = 2 AND is_compared) AS second,
        MIN(highest) AS normalized,
        MIN(value) FILTER (WHERE place = 2 AND is_compared) AS runner_up_normalized,
        COUNT(*) FILTER (WHERE is_compared) AS num_settings,
        COUNT(*) FILTER (WHERE NOT is_compared) AS num_left_out,
        COUNT(*) FILTER (WHERE is_compared AND value = highest) - 1 AS num_tied
    FROM ranked
    GROUP BY study, agent
    HAVING COUNT(*) FILTER (WHERE is_compared) > 0
),
computed AS (
    SELECT
        compared.* EXCLUDE (best, second),
        best.environment,
        best.setting,
        best.mean,
        best.standard_error,
        best.num_seeds,
        second.setting AS runner_up,
        second.mean AS runner_up_mean
    FROM compared
    INNER JOIN measured AS best
        ON best.study = compared.study AND best.agent = compared.agent AND best.candidate = compared.best
    LEFT JOIN measured AS second
        ON second.study = compared.study
        AND second.agent = compared.agent
        AND second.candidate = compared.second
        AND second.environment = best.environment
),
tuned AS (
    SELECT * FROM frozen
    UNION ALL BY NAME
    SELECT computed.*, '{}' AS for_each, 'computed' AS source, study_rules.score, study_rules.normalizer, setting_edges.on_edge
    FROM computed
    INNER JOIN study_rules USING (study)
    LEFT JOIN setting_edges USING (study, agent, environment, setting)
)
SELECT tuned.*, tuned.source = 'selection' AS is_frozen, setting_hyperparameters.* EXCLUDE (study, agent, environment, setting)
FROM tuned
LEFT JOIN setting_hyperparameters USING (study, agent, environment, setting)
