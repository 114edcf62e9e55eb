"""A study that is trained in a second: SAC on Pendulum, four settings on two seeds, 60 steps."""

GRID = """
[study]
name = "tiny"
environments = ["Pendulum-CA"]
steps = 60
cutoff = 25
[seeds]
tune = 2
[sweep]
critic_step_size = [0.01, 0.001]
entropy_scale = [0.1, 1]
[[agent]]
name = "SAC"
"""
