-- One row per (study, agent, environment, critic_step_size).
-- Thesis 7.1, Figure 7.1: the region between the lowest and the highest line at a critic step-size, and the lines behind it.
-- Only lines with data count, so a region of few lines is narrower than it will be.
SELECT
    study,
    agent,
    environment,
    critic_step_size,
    MIN(best_mean) AS low,
    MAX(best_mean) AS high,
    COUNT(*) AS num_lines,
    LIST(
        STRUCT_PACK(entropy_scale := entropy_scale, best_mean := best_mean, setting := setting, num_seeds := num_seeds)
        ORDER BY entropy_scale
    ) AS lines
FROM sensitivity_lines
GROUP BY study, agent, environment, critic_step_size
