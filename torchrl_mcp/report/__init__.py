"""The report: what came of many runs, beside the paper's figures."""
