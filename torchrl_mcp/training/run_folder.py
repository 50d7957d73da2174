"""What the files of a run folder are called."""

CONFIG = "config.yaml"
"""Every setting of the run. It is what says that a folder holds one."""

METRICS = "metrics.csv"
"""A row for every batch of training."""

EVALUATION = "evaluation.json"
"""How the policy did that training ended with."""

PROVENANCE = "origin.json"
"""Where the run comes from: command, commit, versions and machine."""

LOG = "train.log"
"""What a run of a benchmark printed."""
