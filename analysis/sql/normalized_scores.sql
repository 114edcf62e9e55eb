-- One row per (study, stage, agent, environment, setting, normalizer).
-- Thesis 6.2.1: the mean over seeds of the normalized score of a run, p, by four normalizers, on the scale of the study's tuning runs:
-- thesis 1 - (G* - p) / |G*|; minmax and percentile (p - low) / (high - low); cdf the mean over agents of the share of the agent's
-- runs with a score strictly below p, of the runs that the study's selection was made with (normalizer cdf), else of those of all
-- complete settings. NULL where that is undefined: G* is 0, or settings do not differ.
-- num_seeds counts the runs with a score.
WITH runs AS MATERIALIZED (
    SELECT study, stage, agent, environment, setting, trial, score, is_complete
    FROM run_scores
),
constants AS (
    SELECT study, environment, CAST(ANY_VALUE(constants) -> '$.run_scores' AS MAP(VARCHAR, DOUBLE[])) AS run_scores
    FROM selections
    WHERE normalizer = 'cdf'
    GROUP BY study, environment
),
frozen AS (
    SELECT study, environment, known.key AS agent, UNNEST(known.value) AS score
    FROM (SELECT study, environment, UNNEST(MAP_ENTRIES(run_scores)) AS known FROM constants)
),
tuning AS (
    SELECT runs.study, runs.environment, runs.agent, runs.score
    FROM runs
    ANTI JOIN frozen ON frozen.study = runs.study AND frozen.environment = runs.environment
    WHERE runs.stage = 'tune' AND runs.is_complete AND runs.score IS NOT NULL
),
pool AS (
    SELECT study, environment, agent, score, COUNT(*) AS num_runs
    FROM (SELECT * FROM frozen UNION ALL SELECT * FROM tuning)
    GROUP BY study, environment, agent, score
),
agents AS (
    SELECT study, environment, agent, SUM(num_runs) AS num_runs
    FROM pool
    GROUP BY study, environment, agent
),
compared AS (
    SELECT scores.study, scores.environment, scores.score, agents.agent, agents.num_runs AS num_all, COALESCE(pool.num_runs, 0) AS num_equal
    FROM (
        SELECT study, environment, score FROM runs WHERE score IS NOT NULL
        UNION
        SELECT study, environment, score FROM pool
    ) AS scores
    INNER JOIN agents ON agents.study = scores.study AND agents.environment = scores.environment
    LEFT JOIN pool
        ON pool.study = scores.study
        AND pool.environment = scores.environment
        AND pool.agent = agents.agent
        AND pool.score = scores.score
),
shares AS (
    SELECT
        study,
        environment,
        score,
        (SUM(num_equal) OVER (PARTITION BY study, environment, agent ORDER BY score) - num_equal) / num_all AS share
    FROM compared
),
ranks AS (
    SELECT study, environment, score, FAVG(share ORDER BY share) AS value
    FROM shares
    GROUP BY study, environment, score
),
normalized AS (
    SELECT
        runs.* EXCLUDE (trial, is_complete),
        constants.normalizer,
        CASE
            WHEN constants.normalizer = 'thesis' AND constants.best_return <> 0
                THEN 1 - (constants.best_return - runs.score) / ABS(constants.best_return)
            WHEN constants.normalizer <> 'thesis' AND constants.low < constants.high
                THEN (runs.score - constants.low) / (constants.high - constants.low)
        END AS value
    FROM runs
    INNER JOIN normalizer_constants AS constants ON constants.study = runs.study AND constants.environment = runs.environment
    UNION ALL
    SELECT runs.* EXCLUDE (trial, is_complete), 'cdf', ranks.value
    FROM runs
    LEFT JOIN ranks
        ON ranks.study = runs.study AND ranks.environment = runs.environment AND ranks.score = runs.score
)
SELECT
    study,
    stage,
    agent,
    environment,
    setting,
    normalizer,
    FAVG(value ORDER BY value) AS score,
    COUNT(score) AS num_seeds
FROM normalized
GROUP BY study, stage, agent, environment, setting, normalizer
