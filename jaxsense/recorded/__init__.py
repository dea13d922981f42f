"""Recordings of real sensors: reading them, other rays, comparing them, the noise of a LiDAR."""

from jaxsense.recorded.comparing import compare as compare
from jaxsense.recorded.noise import fit_noise as fit_noise
from jaxsense.recorded.reading import RecordedLooks as RecordedLooks
from jaxsense.recorded.reading import read as read
