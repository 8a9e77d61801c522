"""What the tables of `results/` are made by: experiments, baselines, and their pages.

Nothing but the command line imports it.
"""
