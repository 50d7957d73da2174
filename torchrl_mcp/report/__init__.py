"""Reports the results of many runs next to the results of the paper."""
