-- One row per (study, environment, normalizer).
-- Thesis 6.2.1 and Table 6.1: what puts returns on an environment on a scale of their own, from the study's tuning runs.
-- thesis: G*, the highest return of one completed episode (`best_return`), and the trial that reached it, of several the
-- lowest hash. minmax: the lowest and the highest mean of a setting of any agent; percentile: the 5th and the 95th percentile
-- of these means (settings with all their planned runs). The constants that a selection was made with come first
-- (`source` is 'selection'). NULL where the runs do not give any yet.
WITH environments AS (
    SELECT DISTINCT study, environment
    FROM members
    WHERE stage = 'tune'
),
frozen AS (
    SELECT
        study,
        environment,
        normalizer,
        TRY_CAST(ANY_VALUE(constants) ->> '$.best_return' AS DOUBLE) AS best_return,
        TRY_CAST(ANY_VALUE(constants) ->> '$.low' AS DOUBLE) AS low,
        TRY_CAST(ANY_VALUE(constants) ->> '$.high' AS DOUBLE) AS high
    FROM selections
    GROUP BY study, environment, normalizer
),
best_episodes AS (
    SELECT members.study, members.environment, members.trial, trials.best_episode
    FROM members
    INNER JOIN trials ON trials.trial = members.trial
    WHERE members.stage = 'tune' AND ISFINITE(trials.best_episode)
),
means AS (
    SELECT
        study,
        environment,
        MIN(mean) AS lowest,
        MAX(mean) AS highest,
        QUANTILE_CONT(mean, 0.05) AS fifth,
        QUANTILE_CONT(mean, 0.95) AS ninety_fifth
    FROM setting_scores
    WHERE stage = 'tune' AND is_complete
    GROUP BY study, environment
),
measured AS (
    SELECT study, environment, 'thesis' AS normalizer, MAX(best_episode) AS best_return, NULL AS low, NULL AS high
    FROM best_episodes
    GROUP BY study, environment
    UNION ALL
    SELECT study, environment, 'minmax', NULL, lowest, highest
    FROM means
    UNION ALL
    SELECT study, environment, 'percentile', NULL, fifth, ninety_fifth
    FROM means
),
constants AS (
    SELECT
        environments.study,
        environments.environment,
        normalizers.normalizer,
        COALESCE(frozen.best_return, measured.best_return) AS best_return,
        COALESCE(frozen.low, measured.low) AS low,
        COALESCE(frozen.high, measured.high) AS high,
        CASE
            WHEN COALESCE(frozen.best_return, frozen.low) IS NOT NULL THEN 'selection'
            WHEN COALESCE(measured.best_return, measured.low) IS NOT NULL THEN 'computed'
        END AS source
    FROM environments
    CROSS JOIN (VALUES ('thesis'), ('minmax'), ('percentile')) AS normalizers (normalizer)
    LEFT JOIN frozen USING (study, environment, normalizer)
    LEFT JOIN measured USING (study, environment, normalizer)
)
SELECT
    constants.study,
    constants.environment,
    constants.normalizer,
    constants.best_return,
    constants.low,
    constants.high,
    constants.source,
    MIN(best_episodes.trial) AS best_trial
FROM constants
LEFT JOIN best_episodes
    ON best_episodes.study = constants.study
    AND best_episodes.environment = constants.environment
    AND best_episodes.best_episode = constants.best_return
GROUP BY ALL
