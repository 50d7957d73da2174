"""The report: the results of many runs beside the paper's."""
