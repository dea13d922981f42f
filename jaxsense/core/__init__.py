"""The lowest layer: types, argument checks, networks, the supervised fit, how new a look is."""
