"""The typed blocks of `summary.json`: makes, compares, averages and reads them."""
