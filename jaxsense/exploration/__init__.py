"""Missions in which robots do not know where the points of interest are."""
