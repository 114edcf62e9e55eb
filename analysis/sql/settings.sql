-- One row per (study, stage, agent, environment, setting).
-- Thesis 6.2: a setting's score is the unweighted mean over seeds of a score of each trial: episode_mean (mean over its completed
-- episodes), step_mean (mean over the steps in them) or final_mean (over the last tenth of those steps). Diverged trials are among
-- the seeds, at the worst return of the environment in the study's tuning trials. num_seeds counts the seeds behind the means,
-- num_planned those that the study asks for; a setting none of whose seeds is there yet has 0 and NULL.
-- _low and _high bound a 95 % Student-t interval, which needs two seeds.
WITH conditions AS (
    SELECT study, stage, agent, environment, setting, ANY_VALUE(steps) AS steps
    FROM members
    GROUP BY study, stage, agent, environment, setting
),
summaries AS (
    SELECT
        study,
        stage,
        agent,
        environment,
        setting,
        COUNT(*) AS num_planned,
        COUNT(episode_mean) AS num_seeds,
        COUNT(*) FILTER (WHERE status = 'diverged') AS num_diverged,
        AVG(episode_mean ORDER BY seed) AS episode_mean,
        STDDEV_SAMP(episode_mean ORDER BY seed) / SQRT(COUNT(episode_mean)) AS episode_mean_standard_error,
        AVG(step_mean ORDER BY seed) AS step_mean,
        STDDEV_SAMP(step_mean ORDER BY seed) / SQRT(COUNT(step_mean)) AS step_mean_standard_error,
        AVG(final_mean ORDER BY seed) AS final_mean,
        STDDEV_SAMP(final_mean ORDER BY seed) / SQRT(COUNT(final_mean)) AS final_mean_standard_error
    FROM study_trials
    GROUP BY study, stage, agent, environment, setting
)
SELECT
    conditions.* EXCLUDE (steps),
    setting_hyperparameters.* EXCLUDE (study, agent, environment, setting),
    conditions.steps,
    summaries.num_seeds,
    summaries.num_planned,
    summaries.num_diverged,
    summaries.episode_mean,
    summaries.episode_mean_standard_error,
    summaries.episode_mean - student_quantiles.quantile * summaries.episode_mean_standard_error AS episode_mean_low,
    summaries.episode_mean + student_quantiles.quantile * summaries.episode_mean_standard_error AS episode_mean_high,
    summaries.step_mean,
    summaries.step_mean_standard_error,
    summaries.step_mean - student_quantiles.quantile * summaries.step_mean_standard_error AS step_mean_low,
    summaries.step_mean + student_quantiles.quantile * summaries.step_mean_standard_error AS step_mean_high,
    summaries.final_mean,
    summaries.final_mean_standard_error,
    summaries.final_mean - student_quantiles.quantile * summaries.final_mean_standard_error AS final_mean_low,
    summaries.final_mean + student_quantiles.quantile * summaries.final_mean_standard_error AS final_mean_high
FROM summaries
INNER JOIN conditions USING (study, stage, agent, environment, setting)
INNER JOIN setting_hyperparameters USING (study, agent, environment, setting)
ASOF LEFT JOIN student_quantiles ON student_quantiles.degrees_of_freedom <= summaries.num_seeds - 1
