"""Recordings of real sensors: reading them, other rays, the noise of a LiDAR."""

from jaxsense.recorded.scans import RecordedLooks as RecordedLooks
from jaxsense.recorded.scans import fit_noise as fit_noise
from jaxsense.recorded.scans import read as read
