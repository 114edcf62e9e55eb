-- One row per (degrees_of_freedom).
-- The 97.5 % quantile of Student's t: the half-width of a 95 % interval in standard errors. Between two rows take the
-- lower one (and beyond the last the last), which makes an interval slightly wider, never narrower.
-- After 30 the rows are those of customary numbers of seeds (35, 40, 50, 60, 80, 100, 120, 200, 500, 1000).
SELECT degrees_of_freedom, quantile
FROM (
    VALUES
        (1, 12.7062), (2, 4.3027), (3, 3.1824), (4, 2.7764), (5, 2.5706), (6, 2.4469), (7, 2.3646), (8, 2.3060),
        (9, 2.2622), (10, 2.2281), (11, 2.2010), (12, 2.1788), (13, 2.1604), (14, 2.1448), (15, 2.1314), (16, 2.1199),
        (17, 2.1098), (18, 2.1009), (19, 2.0930), (20, 2.0860), (21, 2.0796), (22, 2.0739), (23, 2.0687), (24, 2.0639),
        (25, 2.0595), (26, 2.0555), (27, 2.0518), (28, 2.0484), (29, 2.0452), (30, 2.0423), (34, 2.0322), (39, 2.0227),
        (49, 2.0096), (59, 2.0010), (79, 1.9905), (99, 1.9842), (119, 1.9801), (199, 1.9720), (499, 1.9647),
        (999, 1.9623)
) AS quantiles (degrees_of_freedom, quantile)
