"""What a run survives: `python -m tests.faults --help`."""
