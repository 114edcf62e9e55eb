-- One row per (study).
-- The rules by which the study's settings are scored and chosen: those of its frozen selection, those of its grid (`[select]`)
-- where nothing is frozen, and the defaults. `score` names a column of `trials`; `diverged` is 'worst' or 'drop'; `by` are the
-- kinds of choices that are shown, all of them for a study without evaluation seeds.
WITH studies AS (
    SELECT DISTINCT study FROM members
),
frozen AS (
    SELECT
        study,
        MIN(score) AS score,
        MIN(normalizer) AS normalizer,
        MIN(diverged) AS diverged,
        LIST(DISTINCT selections.by ORDER BY selections.by) FILTER (WHERE selections.by IS NOT NULL) AS "by"
    FROM selections
    GROUP BY study
)
SELECT
    studies.study,
    COALESCE(frozen.score, grid_rules.score, 'episode_mean') AS score,
    COALESCE(frozen.normalizer, grid_rules.normalizer, 'thesis') AS normalizer,
    COALESCE(frozen.diverged, grid_rules.diverged, 'worst') AS diverged,
    COALESCE(frozen.by, grid_rules.by, ['across-environments', 'per-environment']) AS "by"
FROM studies
LEFT JOIN frozen ON frozen.study = studies.study
LEFT JOIN grid_rules ON grid_rules.study = studies.study
