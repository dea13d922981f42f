"""The report of a run: one page that needs nothing but itself."""

from jaxsense.page.write import write as write
