"""A mission as a moving picture: an SVG that any browser plays, without a script."""

from jaxsense.show.animation.film import draw as draw
from jaxsense.show.animation.film import duration_of as duration_of
