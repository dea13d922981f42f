"""A run on a machine: its programs, its stages, its directory, its devices, its missions."""
