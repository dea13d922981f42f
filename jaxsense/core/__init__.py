"""The lowest layer: types, argument checks, networks and the supervised fit."""
