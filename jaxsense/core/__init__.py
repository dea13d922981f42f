"""What every floor builds on: types, argument checks, networks and the one supervised fit."""
