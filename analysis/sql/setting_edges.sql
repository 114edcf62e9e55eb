-- One row per (study, agent, environment, setting).
-- Thesis 6.2: the swept hyperparameters of a setting whose value is the lowest or the highest of at least three that were swept;
-- something better may lie beyond. Only numbers have edges. What the grid derives from others counts as swept here.
WITH ranges AS (
    SELECT study, agent, environment, hyperparameter, MIN(number) AS lowest, MAX(number) AS highest
    FROM hyperparameters
    GROUP BY study, agent, environment, hyperparameter
    HAVING COUNT(DISTINCT number) >= 3 AND COUNT(number) = COUNT(*)
)
SELECT
    hyperparameters.study,
    hyperparameters.agent,
    hyperparameters.environment,
    hyperparameters.setting,
    COALESCE(
        LIST(hyperparameters.hyperparameter ORDER BY hyperparameters.hyperparameter)
            FILTER (WHERE hyperparameters.number IN (ranges.lowest, ranges.highest)),
        []
    ) AS on_edge
FROM hyperparameters
LEFT JOIN ranges USING (study, agent, environment, hyperparameter)
GROUP BY hyperparameters.study, hyperparameters.agent, hyperparameters.environment, hyperparameters.setting
