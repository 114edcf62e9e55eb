-- One row per (study, agent, environment, setting).
-- The hyperparameters of each setting, NULL where one does not apply on the environment. One that is named like a column of the
-- views which show hyperparameters beside results has no column here; `hyperparameters` has all.
SELECT
    study,
    agent,
    environment,
    setting,
    ANY_VALUE(COLUMNS(LAMBDA name: LOWER(name) NOT IN (
        'study', 'stage', 'trial', 'setting', 'agent', 'environment', 'seed', 'steps',
        'by', 'for_each', 'hypers', 'score', 'normalizer', 'diverged', 'constants', 'basis', 'selected_at',
        'mean', 'standard_error', 'normalized', 'num_seeds', 'num_planned', 'num_diverged', 'num_settings', 'num_left_out',
        'runner_up', 'runner_up_mean', 'runner_up_normalized', 'num_tied', 'on_edge', 'source', 'is_frozen',
        'episode_mean', 'episode_mean_standard_error', 'episode_mean_low', 'episode_mean_high',
        'step_mean', 'step_mean_standard_error', 'step_mean_low', 'step_mean_high',
        'final_mean', 'final_mean_standard_error', 'final_mean_low', 'final_mean_high'
    )))
FROM members
GROUP BY study, agent, environment, setting
