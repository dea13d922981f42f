"""Recordings of real sensors: reading them, other rays, comparing them, the noise of a LiDAR."""

from jaxsense.recorded.looks import RecordedLooks as RecordedLooks
from jaxsense.recorded.looks import compare as compare
from jaxsense.recorded.looks import read as read
from jaxsense.recorded.noise import fit_noise as fit_noise
