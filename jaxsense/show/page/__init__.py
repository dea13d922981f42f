"""The report of a run: one page that needs nothing but itself."""

from jaxsense.show.page.write import write as write
from jaxsense.show.page.write import write_seeds as write_seeds
