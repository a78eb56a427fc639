"""The reference loop, experiments in it, and reports about them.

Read `single_process` first. Then, each folder resting on those before:

plans       experiments as data
drives      drives of frozen networks, of the planner and of random actions
runs        runs of plans with seeds, stopped and continued
report      figures, tables and findings of runs
"""
