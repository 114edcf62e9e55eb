-- One row per (study, by, agent, environment, for_each, step).
-- Thesis 6.1, Figures 6.1 to 6.6: mean and standard error over the chosen runs at every step (`learning_curve_changes`, spelled out). The
-- standard error is NULL with one run.
SELECT
    study,
    "by",
    agent,
    environment,
    for_each,
    CAST(UNNEST(RANGE(step, last_step + 1)) AS INTEGER) AS step,
    mean,
    standard_error,
    num_seeds
FROM learning_curve_changes
