"""The report of a run: one self-contained page."""

from jaxsense.show.page.write import showing as showing
from jaxsense.show.page.write import write as write
from jaxsense.show.page.write import write_seeds as write_seeds
