-- One row per (study).
-- The rules by which the study's settings are scored and chosen: those of its frozen selection, the defaults where nothing is
-- frozen (`[select]` of its grid is not known here). `score` names a column of `trials`; `diverged` is 'worst' or 'drop'.
WITH studies AS (
    SELECT DISTINCT study FROM members
)
SELECT
    studies.study,
    COALESCE(MIN(selections.score), 'episode_mean') AS score,
    COALESCE(MIN(selections.normalizer), 'thesis') AS normalizer,
    COALESCE(MIN(selections.diverged), 'worst') AS diverged
FROM studies
LEFT JOIN selections ON selections.study = studies.study
GROUP BY studies.study
