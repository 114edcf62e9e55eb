-- One row per (study, agent, environment, critic_step_size, entropy_scale).
-- Thesis 7.1, Figure 7.1: the best setting among those that share both values, by the mean of the study's score over the tuning seeds;
-- of equally good ones the lowest setting hash. num_seeds counts the winner's seeds, min_num_seeds those of the setting
-- with the fewest; settings without any are not considered, and combinations without any setting have no row.
-- A maximum over noisy means is too high: by about 0.2 standard deviations of a run for 6 settings and 40 seeds.
WITH planned AS (
    SELECT study, agent, environment, setting, ANY_VALUE(critic_step_size) AS critic_step_size, ANY_VALUE(entropy_scale) AS entropy_scale
    FROM members
    WHERE stage = 'tune' AND critic_step_size IS NOT NULL AND entropy_scale IS NOT NULL
    GROUP BY study, agent, environment, setting
),
candidates AS (
    SELECT planned.*, setting_scores.num_seeds, setting_scores.mean
    FROM planned
    INNER JOIN setting_scores USING (study, agent, environment, setting)
    WHERE setting_scores.stage = 'tune'
)
SELECT
    study,
    agent,
    environment,
    critic_step_size,
    entropy_scale,
    MAX(mean) AS best_mean,
    FIRST(setting ORDER BY mean DESC NULLS LAST, setting ASC) AS setting,
    FIRST(num_seeds ORDER BY mean DESC NULLS LAST, setting ASC) AS num_seeds,
    MIN(num_seeds) FILTER (WHERE num_seeds > 0) AS min_num_seeds,
    COUNT(mean) AS num_settings,
    COUNT(*) AS num_settings_planned
FROM candidates
GROUP BY study, agent, environment, critic_step_size, entropy_scale
HAVING COUNT(mean) > 0
