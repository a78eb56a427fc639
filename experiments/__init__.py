"""The reference loop, experiments in it, and what is told about them.

Read `single_process` first. Then, each group resting on those before:

learning    environment, single_process
driving     places, choosers, traces, evaluation, routes, references, tour, evaluate
running     plan (data in plans/), recorder, probes, observer, snapshot, runner,
            experiment, commands
telling     records, runs, measures, statistics, comparisons, findings, tables, figures/, document,
            costs, report, results
beside it   baseline_dqn, sb3
"""
