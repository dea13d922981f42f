"""`python tests/same_figures.py RUN RUN`: fails if two runs came to other figures."""

import sys
from pathlib import Path

from smoke import without_times

first, second = (without_times(Path(path)) for path in sys.argv[1:])
if first != second:
    sys.exit(f"{sys.argv[1]} and {sys.argv[2]} came to other figures: {first} and {second}")
