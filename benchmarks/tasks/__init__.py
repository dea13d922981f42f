"""The scoreboard of the frozen tasks: `python -m benchmarks.tasks` makes it again.

A learner is a value with a name and a method `train`, see `learner`; `learners` lists them, a row
of each table for each. `record` takes learning curves while they train, `board` turns scores into
tables, and `plot` draws the curves.
"""
