-- One row per (study, agent, environment, hyperparameter, value).
-- Thesis 7.1: how the mean score over the tuning seeds depends on one swept hyperparameter. `at_best`: of the setting that has the value
-- and is otherwise the best one, NULL where there is none. `best_over_others`: of the best setting that has the value, which is a
-- maximum over noisy means and so too high. The best setting is sought among those with all their planned runs, if there are any.
-- What is a function of the hyperparameter on the environment (zipped or derived) changes along with it, and is none of the others;
-- what the grid derives from one swept hyperparameter has no slice of its own.
WITH scored AS (
    SELECT study, agent, environment, setting, mean, num_seeds, is_complete
    FROM setting_scores
    WHERE stage = 'tune' AND mean IS NOT NULL
),
swept AS (
    SELECT study, agent, environment, setting, hyperparameter, value, number
    FROM hyperparameters
    WHERE is_swept
),
counted AS (
    SELECT study, agent, environment, hyperparameter, COUNT(*) AS num_settings
    FROM swept
    GROUP BY study, agent, environment, hyperparameter
),
pairs AS (
    SELECT
        one.study,
        one.agent,
        one.environment,
        one.hyperparameter,
        one.value,
        another.hyperparameter AS other,
        COUNT(*) AS num_settings,
        COUNT(DISTINCT another.value) AS num_values
    FROM swept AS one
    INNER JOIN swept AS another USING (study, agent, environment, setting)
    WHERE one.hyperparameter <> another.hyperparameter
    GROUP BY one.study, one.agent, one.environment, one.hyperparameter, one.value, another.hyperparameter
),
functions AS (
    SELECT study, agent, environment, hyperparameter, pairs.other
    FROM pairs
    INNER JOIN counted USING (study, agent, environment, hyperparameter)
    GROUP BY study, agent, environment, hyperparameter, pairs.other, counted.num_settings
    HAVING MAX(pairs.num_values) = 1 AND SUM(pairs.num_settings) = counted.num_settings
),
followers AS (
    SELECT study, agent, environment, hyperparameter, LIST(other) AS names
    FROM functions
    GROUP BY study, agent, environment, hyperparameter
),
derived AS (
    SELECT DISTINCT functions.study, functions.agent, functions.environment, functions.other AS hyperparameter
    FROM functions
    INNER JOIN grid_rules ON grid_rules.study = functions.study
    WHERE LIST_CONTAINS(grid_rules.derived, functions.other) AND NOT LIST_CONTAINS(grid_rules.derived, functions.hyperparameter)
),
described AS (
    SELECT study, agent, environment, setting, LIST(STRUCT_PACK(name := hyperparameter, value := value) ORDER BY hyperparameter) AS pairs
    FROM swept
    GROUP BY study, agent, environment, setting
),
valued AS (
    SELECT
        swept.*,
        scored.mean,
        scored.num_seeds,
        scored.is_complete,
        LIST_FILTER(
            described.pairs, LAMBDA pair: pair.name <> swept.hyperparameter AND NOT LIST_CONTAINS(COALESCE(followers.names, []), pair.name)
        ) AS others
    FROM swept
    INNER JOIN scored USING (study, agent, environment, setting)
    INNER JOIN described USING (study, agent, environment, setting)
    LEFT JOIN followers USING (study, agent, environment, hyperparameter)
    ANTI JOIN derived USING (study, agent, environment, hyperparameter)
),
best AS (
    SELECT study, agent, environment, hyperparameter, FIRST(others ORDER BY is_complete DESC, mean DESC, setting ASC) AS others
    FROM valued
    GROUP BY study, agent, environment, hyperparameter
)
SELECT
    valued.study,
    valued.agent,
    valued.environment,
    valued.hyperparameter,
    valued.value,
    MIN(valued.number) AS number,
    MIN(valued.mean) FILTER (WHERE valued.others = best.others) AS at_best,
    MIN(valued.setting) FILTER (WHERE valued.others = best.others) AS at_best_setting,
    MIN(valued.num_seeds) FILTER (WHERE valued.others = best.others) AS at_best_num_seeds,
    MAX(valued.mean) AS best_over_others,
    FIRST(valued.setting ORDER BY valued.mean DESC, valued.setting ASC) AS best_over_others_setting,
    FIRST(valued.num_seeds ORDER BY valued.mean DESC, valued.setting ASC) AS best_over_others_num_seeds,
    COUNT(*) AS num_settings
FROM valued
INNER JOIN best USING (study, agent, environment, hyperparameter)
GROUP BY valued.study, valued.agent, valued.environment, valued.hyperparameter, valued.value
