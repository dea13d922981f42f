from arenas import arena, known_layout, place, set_native  # noqa: F401
