-- One row per (study, by, agent, environment, for_each, step).
-- Thesis 6.1: learning curves of the chosen runs, at the steps where they change; a row holds from `step` to `last_step`. A step counts
-- the return of the episode it belongs to. The steps of the last episode, which the budget cuts off, repeat the last completed
-- return; a run that completed none has no reading. From the episode on in which a run diverged it counts the worst return of
-- the environment (rule "worst"). Sums run over differences, in whole numbers (48 bits below the largest distance from the
-- mean), so that no rounding adds up.
WITH runs AS MATERIALIZED (
    SELECT
        study,
        "by",
        agent,
        environment,
        for_each,
        trial,
        status,
        DENSE_RANK() OVER (ORDER BY study, "by", agent, environment, for_each) AS curve,
        ROW_NUMBER() OVER () AS run
    FROM chosen_runs
    WHERE status IN ('finished', 'diverged')
),
names AS (
    SELECT curve, ANY_VALUE(COLUMNS(* EXCLUDE (curve, run, trial, status)))
    FROM runs
    GROUP BY curve
),
chosen_episodes AS (
    SELECT trial, first_step, length, ending = 'budget' AS is_cut, CAST(episodic_return AS DOUBLE) AS episodic_return
    FROM episodes
    WHERE trial IN (SELECT trial FROM runs)
),
counted AS (
    SELECT
        runs.curve,
        runs.run,
        chosen_episodes.first_step AS step,
        chosen_episodes.first_step + chosen_episodes.length AS after,
        chosen_episodes.is_cut,
        CASE
            WHEN NOT ISFINITE(chosen_episodes.episodic_return) AND (runs.status = 'diverged' OR NOT chosen_episodes.is_cut)
                THEN worst_returns.worst_return
            WHEN NOT chosen_episodes.is_cut THEN chosen_episodes.episodic_return
        END AS reading
    FROM chosen_episodes
    INNER JOIN runs ON runs.trial = chosen_episodes.trial
    LEFT JOIN worst_returns ON worst_returns.study = runs.study AND worst_returns.environment = runs.environment
),
readings AS MATERIALIZED (
    SELECT
        curve,
        run,
        step,
        after,
        CASE WHEN is_cut AND reading IS NULL THEN LAG(reading) OVER (PARTITION BY run ORDER BY step) ELSE reading END AS reading
    FROM counted
),
centers AS (
    SELECT curve, ROUND(AVG(reading)) AS center, MAX(reading) AS highest, MIN(reading) AS lowest, MAX(after) AS after
    FROM readings
    GROUP BY curve
    HAVING COUNT(reading) > 0
),
scales AS (
    SELECT curve, center, after, POW(2, 48 - CEIL(LOG2(GREATEST(highest - center, center - lowest, 1)))) AS scale
    FROM centers
),
whole_numbers AS (
    SELECT
        readings.curve,
        readings.run,
        readings.step,
        CAST(readings.reading IS NOT NULL AS BIGINT) AS runs,
        COALESCE(CAST(ROUND((readings.reading - scales.center) * scales.scale) AS HUGEINT), 0) AS value
    FROM readings
    INNER JOIN scales ON scales.curve = readings.curve
),
differences AS (
    SELECT
        curve,
        step,
        runs - LAG(runs, 1, 0) OVER one_run AS runs,
        value - LAG(value, 1, 0) OVER one_run AS value,
        value * value - LAG(value * value, 1, 0) OVER one_run AS square
    FROM whole_numbers
    WINDOW one_run AS (PARTITION BY run ORDER BY step)
),
changes AS (
    SELECT curve, step, SUM(runs) AS runs, SUM(value) AS value, SUM(square) AS square
    FROM differences
    GROUP BY curve, step
    HAVING SUM(runs) <> 0 OR SUM(value) <> 0 OR SUM(square) <> 0
),
sums AS (
    SELECT
        curve,
        step,
        LEAD(step) OVER one_curve AS next_step,
        SUM(runs) OVER one_curve AS runs,
        SUM(value) OVER one_curve AS value,
        SUM(square) OVER one_curve AS square
    FROM changes
    WINDOW one_curve AS (PARTITION BY curve ORDER BY step)
)
SELECT
    names.study,
    names.by,
    names.agent,
    names.environment,
    names.for_each,
    sums.step,
    CAST(COALESCE(sums.next_step, scales.after) - 1 AS INTEGER) AS last_step,
    scales.center + CAST(sums.value AS DOUBLE) / scales.scale / sums.runs AS mean,
    CASE
        WHEN sums.runs > 1
            THEN SQRT(CAST(sums.runs * sums.square - sums.value * sums.value AS DOUBLE) / (sums.runs - 1)) / scales.scale / sums.runs
    END AS standard_error,
    CAST(sums.runs AS BIGINT) AS num_seeds
FROM sums
INNER JOIN scales ON scales.curve = sums.curve
INNER JOIN names ON names.curve = sums.curve
WHERE sums.runs > 0
