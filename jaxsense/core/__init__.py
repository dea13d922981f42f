"""The ground floor: types, argument checks, networks and the supervised fit."""
