"""Shows a run: the terminal, plots, the animation and the report page."""
