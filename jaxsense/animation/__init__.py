"""A mission as a moving picture: an SVG that any browser plays, without a script."""

from jaxsense.animation.film import write as write
