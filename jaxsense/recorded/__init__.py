"""Recordings of real sensors: reading them, other rays, the noise of a LiDAR."""

from jaxsense.recorded.looks import RecordedLooks as RecordedLooks
from jaxsense.recorded.looks import read as read
from jaxsense.recorded.noise import fit_noise as fit_noise
