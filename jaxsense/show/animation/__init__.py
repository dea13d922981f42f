"""A mission as a moving picture: an SVG that any browser plays, without a script."""

from jaxsense.show.animation.film import draw as draw
